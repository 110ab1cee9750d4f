"""Alarms of a run: one list for the view, the table, `swarm status` and the report. Pure.

The process concerned publishes an alarm (`swarm.runtime.membership`) with each `Stats`, so that late subscribers
know it. Alarms that a process cannot raise itself are found here: that it has ended or is silent, and that a target
is lost.

An old tree is no alarm: later changes are repaired in it.

An observer opens an alarm only if it also receives the messages which close it, for as long as the run lasts
(`Kind.opened_by`). Otherwise a launcher that receives only a part of the run would show an alarm for ever.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec

from launch_scripts.observe.latest_messages import LatestState
from launch_scripts.plain_text import format_duration, format_time, plain
from swarm.clock import NS_PER_S
from swarm.peers import job_of
from swarm.wire.messages.processes import Alarm as WireAlarm
from swarm.wire.topics import STATS

SILENT_NS = 4 * NS_PER_S
"""Every process publishes its counts once a second: one that has not done so for this time hangs, or is cut off."""
_OLD_NS = 30 * NS_PER_S
"""Evidence that is older is said to be so. Clocks of machines in one swarm differ by less."""
STARTING_S = 30.0
"""A process that has not been seen yet is no alarm in the first seconds of a run."""


class Kind(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row of `alarms.toml`, which explains the fields."""

    label: str
    meaning: str = ""
    serious: bool = False
    of_many: str = ""
    opened_by: frozenset[str] = frozenset({STATS.name})


KINDS = msgspec.convert(
    tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")), dict[str, Kind]
)


def kind_of(word: str) -> Kind:
    """The kind of an alarm by its word; one that is not in the table is called by the word."""
    return KINDS.get(word) or Kind(word)


@dataclass(frozen=True, slots=True)
class Alarm:
    """One thing that went wrong.

    kind        a key of `KINDS`, or another word that a process said
    about       the process, target, author or vehicle that it is about; a process as `planner-t3`
    text        a sentence
    target      the target that it concerns
    cell        where it is, as it was told; None if it has no place
    since_s     time of the run at which it began; None if the watcher came later
    over_s      time of the run at which it was over; None while it lasts
    heard_s     time of the run of its last evidence
    began_ns    time when the run began, from which these count; None if it is not known
    row, col    of the cell; None if it has no place, or names one that is not in the grid, as a tracker may
    is_old      whether the last evidence was over 30 s old when the observer looked
    """

    kind: str
    about: str
    text: str
    since_s: float | None
    over_s: float | None = None
    cell: int | None = None
    target: str | None = None
    heard_s: float | None = None
    began_ns: int | None = None
    row: int | None = None
    col: int | None = None
    is_old: bool = False

    @property
    def lasts(self) -> bool:
        return self.over_s is None

    @property
    def serious(self) -> bool:
        return kind_of(self.kind).serious

    @property
    def label(self) -> str:
        return kind_of(self.kind).label

    @property
    def lasted_s(self) -> float | None:
        """Seconds from its beginning to its end, or to its last evidence; None if they are not known."""
        end_s = self.heard_s if self.over_s is None else self.over_s
        return None if self.since_s is None or end_s is None else max(end_s - self.since_s, 0.0)

    @property
    def when(self) -> str:
        """In words: `for 19 min`, `at 14:22:10`, `at 14:22:10, for 86 s`."""
        lasted = None if self.lasted_s is None else format_duration(self.lasted_s)
        if self.over_s is not None:
            if self.since_s is None:
                return f"until {self._at(self.over_s)}"
            return f"at {self._at(self.since_s)}" + (f", for {lasted}" if self.over_s > self.since_s else "")
        last = f"last report at {self._at(self.heard_s)}" if self.is_old and self.heard_s is not None else ""
        return ", ".join(filter(None, ("" if lasted is None else f"for {lasted}", last)))

    def _at(self, run_s: float) -> str:
        if self.began_ns is None:
            return f"{format_duration(run_s)} of the run"
        return format_time(self.began_ns + round(run_s * NS_PER_S))

    @property
    def where(self) -> str:
        """In words: `row 40, col 200`; empty if it has no place."""
        return "" if self.row is None else f"row {self.row}, col {self.col}"

    @property
    def line(self) -> str:
        """All of it in one line."""
        return ", ".join(part for part in (f"{self.label}: {self.text}", self.where, self.when) if part)

    def fields(self) -> dict[str, object]:
        """For a report."""
        return {name: value for name, value in asdict(self).items() if name != "is_old"}


def alarms_of(latest: LatestState, targets: Iterable[str], now_ns: int) -> tuple[Alarm, ...]:
    """Returns all alarms of a run at an instant: open ones, the serious first, then closed ones, the newest
    first."""
    began_ns, wanted = latest.plan.started_ns or 0, list(targets)
    by_tokens = ((each, now_ns) for each in (*_missing(latest, wanted, now_ns), *_silent(latest, now_ns)))
    found = (*by_tokens, *_lost(latest, wanted, now_ns), *_stated_by_processes(latest))

    def seconds(stamp_ns: int | None) -> float | None:
        return None if stamp_ns is None else max(stamp_ns - began_ns, 0) / NS_PER_S

    def place(cell: int | None) -> tuple[int | None, int | None]:
        return (None, None) if cell is None or not 0 <= cell < latest.grid.cells else latest.grid.row_col(cell)

    received = {topic.name for topic in latest.hears}
    alarms = [
        Alarm(
            plain(alarm.kind),
            plain(alarm.about),
            plain(alarm.text),
            None if alarm.since_ns == _UNKNOWN_NS else seconds(alarm.since_ns),
            seconds(alarm.over_ns),
            alarm.cell,
            alarm.target,
            seconds(received_ns),
            began_ns,
            *place(alarm.cell),
            is_old=now_ns - received_ns > _OLD_NS,
        )
        for alarm, received_ns in found
        if kind_of(alarm.kind).opened_by <= received
    ]
    lasting = sorted((a for a in alarms if a.lasts), key=lambda a: (not a.serious, a.since_s or 0.0, a.about))
    over = sorted((a for a in alarms if not a.lasts), key=lambda a: (-(a.over_s or 0.0), a.kind, a.about))
    return (*lasting, *over)


_UNKNOWN_NS = -1
"""Beginning of an alarm whose beginning is unknown. No message can say so."""


def _stated_by_processes(latest: LatestState) -> Iterator[tuple[WireAlarm, int]]:
    """Returns alarms published by processes, each with the time of its last evidence. Alarms that were open when a
    process ended are left out."""
    for (role, id), stats in latest.newest().items():
        for alarm in stats.alarms:
            if alarm.over_ns is not None or latest.is_well(role, id):
                yield alarm, stats.stamp_ns


def starts(latest: LatestState, role: str, id: str, now_ns: int) -> bool:
    """Returns True if a process has not been seen yet, and is not overdue."""
    began_ns = latest.plan.started_ns
    began = began_ns is not None and now_ns - began_ns < STARTING_S * NS_PER_S
    return began and not latest.knows(role, id)


def _missing(latest: LatestState, targets: list[str], now_ns: int) -> Iterator[WireAlarm]:
    for role, id in latest.plan.crew_now(targets):
        if latest.fills(role, id) or starts(latest, role, id, now_ns):
            continue
        leads = next((ranked for each, ranked in latest.up() if (each, job_of(ranked)) == (role, job_of(id))), None)
        instead = f"; {role}-{leads} does its work" if leads is not None and role != "agent" else ""
        state = "is gone" if latest.knows(role, id) else "has not come up yet"
        yield _of_process("down", role, id, f"{state}{instead}", _counted_ns(latest, role, id, _UNKNOWN_NS))


def _silent(latest: LatestState, now_ns: int) -> Iterator[WireAlarm]:
    for role, id, received_ns in latest.silent(now_ns - SILENT_NS):
        yield _of_process("silent", role, id, "is alive, but silent", _counted_ns(latest, role, id, received_ns))
    for (role, id), (began_ns, over_ns) in sorted(latest.silences.items()):
        yield _of_process("silent", role, id, "was silent", began_ns, over_ns)


def _counted_ns(latest: LatestState, role: str, id: str, otherwise_ns: int) -> int:
    """Time when a process has said last what it counts."""
    stats = latest.newest_stats(role, id)
    return otherwise_ns if stats is None else stats.stamp_ns


def _of_process(kind: str, role: str, id: str, what: str, since_ns: int, over_ns: int | None = None) -> WireAlarm:
    name, target = f"{role}-{id}", job_of(id) if role == "planner" else None
    return WireAlarm(
        kind=kind, about=name, text=f"{name} {what}", since_ns=since_ns, over_ns=over_ns, target=target
    )


def _lost(latest: LatestState, targets: list[str], now_ns: int) -> Iterator[tuple[WireAlarm, int]]:
    poses = latest.poses
    for id in sorted(latest.lost(now_ns).intersection(targets)):
        status, pose = latest.planner_status(id), poses.get(id)
        since_ns, cell, received_ns = _UNKNOWN_NS, None if pose is None else pose.cell, now_ns
        if status is not None and status.pose_age_s is not None:
            # When the planner heard the last pose: the same whenever it is asked.
            since_ns, cell = status.stamp_ns - int(status.pose_age_s * NS_PER_S), status.target_cell
            received_ns = status.stamp_ns
        elif pose is not None:
            since_ns = pose.stamp_ns
        text = f"no tracker publishes {id}; routes lead to its last place"
        yield (
            WireAlarm(kind="target-lost", about=id, text=text, since_ns=since_ns, cell=cell, target=id),
            received_ns,
        )
