"""The table of facts: what people are shown of a run, in which words and units. Pure.

Every display of a fact takes its label and its text from here, so that it reads the same everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from launch_scripts.observe.alarms import OF_MANY, SERIOUS, Alarm
from launch_scripts.observe.run_state import RunState, TargetLine
from launch_scripts.observe.summed_counts import CertifiedGap, gap_text, percent
from launch_scripts.plain_text import Duration, first_of, number_of
from swarm.config.vehicle_classes import GROUND
from swarm.grid import GridSpec

NONE = "-"
"""Text for an unknown value."""


Of = TypeVar("Of", RunState, TargetLine)


@dataclass(frozen=True, slots=True)
class Fact(Generic[Of]):
    """One fact of a run, or of each target: then it is a column.

    name     in the report, and for programs
    label    what people call it
    text     its value in words; None where it is not known
    of       the field that holds it, where that has another name
    always   whether every table of targets has it; else `swarm status` alone
    """

    name: str
    label: str
    text: Callable[[Any], str]
    of: str = ""
    always: bool = True

    def value(self, state: Of) -> Any:
        """The fact at an instant; None where it is not known."""
        return getattr(state, self.of or self.name)

    def shown(self, state: Of) -> str:
        """The fact in words, as people see it."""
        return self.text(self.value(state))

    def labelled(self, state: Of) -> str:
        """The same after its label."""
        return f"{self.label} {self.shown(state)}"


def count(value: float | None) -> str:
    """12,345"""
    return NONE if value is None else f"{value:,.0f}"


def seconds(value: float | None) -> str:
    """34 s, 19 min"""
    return NONE if value is None else str(Duration(value))


def distance(value_m: float | None) -> str:
    """480 m, 1.2 km"""
    if value_m is None:
        return NONE
    return f"{value_m:.0f} m" if value_m < 999.5 else f"{value_m / 1000:.1f} km"


def duration(milliseconds: float | None) -> str:
    """1.2 ms, 3.4 s"""
    if milliseconds is None:
        return NONE
    return f"{milliseconds:.1f} ms" if milliseconds < 999.95 else f"{milliseconds / 1000:.1f} s"


def of_all(value: tuple[int, int]) -> str:
    """15 of 16"""
    return f"{value[0]:,} of {value[1]:,}"


def each(value: Mapping[str, int]) -> str:
    """17 following, 1 arrived"""
    return ", ".join(f"{number:,} {name}" for name, number in value.items() if number) or "none"


def factors(value: Mapping[str, float]) -> str:
    """grass x 2.9, forest x 0.63"""
    return ", ".join(f"{name} x {factor:.2g}" for name, factor in value.items()) or "nothing"


def _gap(value: CertifiedGap | Mapping[str, float | None]) -> str:
    return gap_text(value.fields() if isinstance(value, CertifiedGap) else value)


def _word(value: str | None) -> str:
    return NONE if value is None else value


FACTS: tuple[Fact[RunState], ...] = (
    Fact("elapsed_s", "time", seconds),
    Fact("vehicles_driven", "vehicles", of_all, of="driven"),
    Fact("states", "of these", each),
    Fact("classes", "classes", each),
    Fact("following", "assigned", count),
    Fact("sent", "sent to places", each),
    Fact("external", "external vehicles", first_of),
    Fact("captures", "captures", count),
    Fact("marks", "marks", count),
    Fact("reroute_requests", "re-route requests", count),
    Fact("routes_served", "routes served", count),
    Fact("certified_gap", "certified gap", _gap),
    Fact("learned", "learned", factors),
    Fact("collisions", "collisions", count),
    Fact("lethal_entries", "lethal cells entered", count),
    Fact("driven_into", "obstacles driven into", count),
    Fact("hit_by_obstacles", "vehicles hit by obstacles", count),
    Fact("processes_well", "needed processes", of_all, of="well"),
    Fact("processes_ended", "of these ended as asked", count, of="ended"),
    Fact("restarts", "restarts", count),
    Fact("messages_now_per_s", "messages/s", count, of="messages_per_s"),
    Fact("payloads_dropped", "payloads dropped", count),
)
"""Facts of a run, which every report has; `LINES`, `IF_ANY` and `MUST_BE_ZERO` place them in the lines for people.
The docstring of `RunState` says what each means."""

TARGET_FACTS: tuple[Fact[TargetLine], ...] = (
    Fact("target", "target", _word, of="title"),
    Fact("chased_by", "chased by", count, of="following"),
    Fact("nearest_m", "nearest", distance),
    Fact("captures", "captures", count),
    Fact("certified_gap", "certified gap", lambda gap: NONE if gap is None else percent(gap.mean), of="gap"),
    Fact("re_plans", "re-plans", count, of="growths"),
    Fact("growth_ms", "tree", duration),
    Fact("routes_served", "served", count, always=False),
    Fact("strategy", "strategy", _word, always=False),
    Fact("pose_age_s", "seen", seconds, always=False),
    Fact("tracker", "tracker", _word, always=False),
)
"""Facts on show of each target, the most important first: a narrow panel cuts off the end."""

fact = {fact.name: fact for fact in FACTS}.__getitem__
"""A fact of the table by its name. Raises KeyError on a name that is none."""


def table(state: RunState, *, always: bool = True) -> tuple[list[str], list[list[str]]]:
    """The labels of the columns that every table of targets has, or of the target and the others; and the rows."""
    columns = [column for column in TARGET_FACTS if column.always == always or column is TARGET_FACTS[0]]
    rows = [[column.shown(line) for column in columns] for line in state.targets]
    return [column.label for column in columns], rows


LINES: tuple[tuple[str, ...], ...] = (
    ("vehicles_driven", "states", "following"),
    ("captures", "marks", "reroute_requests", "routes_served"),
    ("certified_gap",),
    ("processes_well", "restarts", "messages_now_per_s"),
)
"""Lines in which the facts of a run are set."""
IF_ANY = ("learned", "sent", "external", "processes_ended")
"""Facts that have a line of their own, where there is anything to say."""
MUST_BE_ZERO = ("collisions", "lethal_entries", "driven_into", "hit_by_obstacles", "payloads_dropped")
"""Facts that are shown only where they are not 0."""


def lines(state: RunState) -> list[str]:
    """The facts of a run but its time, in lines for people: `label text` with two spaces between facts."""
    found = ["  ".join(fact(name).labelled(state) for name in names) for names in LINES]
    if list(state.classes) not in ([], [GROUND]):
        found.insert(1, fact("classes").labelled(state))
    found += [fact(name).labelled(state) for name in IF_ANY if fact(name).value(state)]
    if wrong := [fact(name).labelled(state) for name in MUST_BE_ZERO if fact(name).value(state)]:
        found.append("  ".join(wrong))
    return found


_SAID_SINGLY = 2
"""Beyond this number alarms of one kind share one line: on a slow machine every process is behind."""


def alarm_lines(state: RunState, most: int, *, over: bool = False) -> list[str]:
    """The alarms that last, the most serious first, in lines for people; then how many lines are left out.

    over  also closed alarms
    """
    return lines_of(state.alarms if over else state.standing_alarms, state.grid, most)


def lines_of(alarms: Iterable[Alarm], grid: GridSpec, most: int) -> list[str]:
    """Alarms in lines for people, and how many lines are left out."""
    found = [line for line, _ in grouped(alarms, grid)]
    return [*found[:most], f"... {len(found) - most} more"] if len(found) > most else found


def grouped(alarms: Iterable[Alarm], grid: GridSpec) -> list[tuple[str, list[str]]]:
    """Lines for people, and the lines that each sums up. Many alarms of a kind, all over or all not, are in one
    line; among its own lines, many alarms of one process are in one, too."""
    return [
        (line, [own for own, _ in _summed(of_kind, lambda alarm: alarm.about, grid)] if len(of_kind) > 1 else [])
        for line, of_kind in _summed(alarms, lambda alarm: (alarm.kind, alarm.lasts), grid)
    ]


def _summed(
    alarms: Iterable[Alarm], key: Callable[[Alarm], Hashable], grid: GridSpec
) -> Iterator[tuple[str, list[Alarm]]]:
    """Returns lines and the alarms of each: many alarms of one key are in one line."""
    keys: dict[Hashable, list[Alarm]] = {}
    for alarm in alarms:
        keys.setdefault(key(alarm), []).append(alarm)
    for some in keys.values():
        if len(some) > _SAID_SINGLY:
            yield together(some), some
        else:
            yield from ((each.line(grid), [each]) for each in some)


def together(alarms: Sequence[Alarm]) -> str:
    """Many alarms of one kind in a line."""
    longest = max(alarms, key=lambda alarm: alarm.lasted_s or 0.0)
    names = list(dict.fromkeys(alarm.about for alarm in alarms))
    cause = f" ({OF_MANY[longest.kind]})" if longest.kind in OF_MANY and len(names) > _SAID_SINGLY else ""
    when = f"the longest {longest.when or 'now'}{cause}"
    return f"{longest.label}: {len(alarms):,} times, {first_of(names)}, {when}"


def for_report(state: RunState) -> dict[str, Any]:
    """Every fact by its name, for a report, and every alarm."""
    return {
        **{each.name: each.value(state) for each in FACTS},
        "certified_gap": state.certified_gap.fields(),
        "alarms": [alarm.fields(state.grid) for alarm in state.alarms],
    }


def left_behind(report: Mapping[str, Any]) -> list[str]:
    """Returns unfinished business of vehicles, in sentences without a full stop, from the report of a run."""
    vehicles, routed = report["vehicles"], report.get("vehicles_routed")
    found = (
        (report.get("lost"), "lost at the end"),
        (report.get("stranded"), "stranded at the end"),
        (0 if routed is None else vehicles - routed, "without any route"),
    )
    return [f"{count(number)} of {count(vehicles)} vehicles {words}" for number, words in found if number]


def verdict(report: Mapping[str, Any], failures: Sequence[str] = ()) -> str:
    """The outcome of a run: what it reached, and whether all went well or what did not, from its report.

    failures  what its launcher says of processes, in sentences without a full stop

    An overload comes first: it explains the other faults.
    """
    captures, collisions = report.get("captures"), report.get("collisions")
    reached = [f"{count(report.get('vehicles_routed') or 0)} of {count(report['vehicles'])} vehicles routed"]
    reached += [] if captures is None else [number_of(captures, "capture")]
    reached += [] if collisions is None else [number_of(collisions, "collision")]
    forbidden = [f"{fact(name).label} {count(report[name])}" for name in MUST_BE_ZERO[:-1] if report.get(name)]
    serious = [
        alarm["text"] + (f" for {Duration(alarm['over_s'] - alarm['since_s'])}" if alarm["over_s"] else "")
        for alarm in report.get("alarms") or []
        if alarm["kind"] in SERIOUS and (alarm["over_s"] is None or alarm["kind"] == "silent")
    ]
    late = (report.get("ticks_late") or 0) / (report.get("ticks") or math.inf)
    overload = [f"overloaded machine, {late:.0%} of ticks were late"] if late > _LATE_SHARE else []
    wrong = list(dict.fromkeys([*overload, *failures, *forbidden, *serious, *left_behind(report)]))
    more = f"; and {len(wrong) - _FAULTS} more" if len(wrong) > _FAULTS else ""
    how = f"Not all went well: {'; '.join(wrong[:_FAULTS])}{more}." if wrong else WELL
    return f"{', '.join(reached)}. {how}"


_FAULTS = 3
"""Most faults that a verdict names."""
_LATE_SHARE = 0.2
"""Share of late ticks from which on a run is overloaded, as in the alert `SwarmTicksLate`."""
WELL = "All went well."
