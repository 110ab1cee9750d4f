"""The results of a run under faults: recovery after each, resource use of the processes, and the laws. Pure."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import msgspec

from chaos.fault_schedule import CALM
from swarm.wire.fields import column
from swarm.wire.messages.vehicles import Fleet, VehicleState

LAUNCHER = "launcher"
GROWTH_LIMIT = 0.05
"""Memory, threads and files may grow by this share once a run has settled."""
SETTLED_S = 600.0
LONG_S = 1200.0
"""From this length on a run is held to `GROWTH_LIMIT`; before, start-up dominates."""
QUICK_S = 2.0
"""Recovered so soon is as it should be; slower ones are counted."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """One fault and what followed. Seconds count from it; of a hang or burst, from its end.

    back_s    until every killed process ran again
    routed_s  until every vehicle had a route; None: not while it was watched
    moving_s  until every vehicle moved or had arrived
    late      vehicles that did not
    """

    at_s: float
    kind: str
    whom: tuple[str, ...] = ()
    lasts_s: float = 0.0
    messages: int = 0
    back_s: float = 0.0
    routed_s: float | None = None
    moving_s: float | None = None
    late: tuple[str, ...] = ()

    @property
    def recovered_s(self) -> float | None:
        return None if self.routed_s is None or self.moving_s is None else max(self.routed_s, self.moving_s)


class Ended(msgspec.Struct, frozen=True, kw_only=True):
    """A process that ended without being killed."""

    at_s: float
    name: str
    reason: str


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """Resource use at one time, when no process was missing.

    rss_mb    memory by process; threads and open files of all together
    disk_mb   size of the run's folder
    captures  of all targets until then
    """

    at_s: float
    rss_mb: dict[str, float]
    threads: int
    files: int
    disk_mb: float = 0.0
    captures: int = 0


class Results(msgspec.Struct, kw_only=True):
    """Outcomes and samples of a whole run."""

    scenario: str
    seed: int
    within_s: float
    spared: tuple[str, ...] = (LAUNCHER,)
    seconds: float = 0.0
    outcomes: list[Outcome] = []
    ended: list[Ended] = []
    samples: list[Sample] = []
    messages: dict[str, int] = {}
    collisions: list[str] = []
    lethal_entries: list[str] = []
    left_behind: list[str] = []
    """Processes that still ran after the launcher had ended."""

    def broken(self) -> list[str]:
        """A sentence per law that broke."""
        found = [f"{each.name} ended by itself at {each.at_s:.0f} s: {each.reason}" for each in self.ended]
        for each in self.outcomes:
            if each.kind == CALM:
                continue
            if each.recovered_s is None:
                late = f"{len(each.late)} vehicles, such as {', '.join(each.late[:3])}"
                found.append(f"after {name_of(each)} at {each.at_s:.0f} s not recovered: {late}")
            elif each.recovered_s > self.within_s:
                found.append(f"after {name_of(each)} at {each.at_s:.0f} s recovered after {each.recovered_s:.1f} s")
        found += [f"collision: {text}" for text in self.collisions]
        found += [f"lethal entry: {text}" for text in self.lethal_entries]
        found += [f"{name} was left behind" for name in self.left_behind]
        if self.seconds >= LONG_S:
            for what, growth in self.growth().items():
                if growth is not None and growth > GROWTH_LIMIT:
                    found.append(f"{what} grew by {100 * growth:.1f} %")
        return found

    def growth(self) -> dict[str, float | None]:
        """By which share memory of the launcher and of each spared process, threads and files grew: the last fifth
        of the run over the fifth after it had settled. None without samples of both."""
        settled_s = SETTLED_S if self.seconds >= LONG_S else self.seconds / 3
        fifth_s = (self.seconds - settled_s) / 5
        first = [each for each in self.samples if settled_s <= each.at_s < settled_s + fifth_s]
        last = [each for each in self.samples if each.at_s >= self.seconds - fifth_s]

        def grew(value: Callable[[Sample], float]) -> float | None:
            if not first or not last:
                return None
            return statistics.median(map(value, last)) / statistics.median(map(value, first)) - 1

        memory = {f"rss_mb of {name}": grew(lambda each, name=name: each.rss_mb[name]) for name in self.spared}  # type: ignore[misc]
        return {**memory, "threads": grew(lambda each: each.threads), "files": grew(lambda each: each.files)}

    def minutes(self) -> list[dict[str, Any]]:
        """A row per minute: memory by role, and the rest of its last sample."""
        rows = []
        for minute, some in groupby(self.samples, lambda each: int(each.at_s / 60)):
            *_, last = some
            roles = {name: name.partition("-")[0] for name in last.rss_mb}
            memory = {f"{role}_mb": 0.0 for role in sorted({*roles.values()})}
            for name, rss_mb in last.rss_mb.items():
                memory[f"{roles[name]}_mb"] += rss_mb
            struck = sum(each.kind != CALM and each.at_s < last.at_s for each in self.outcomes)
            rest = {
                "threads": last.threads,
                "files": last.files,
                "disk_mb": last.disk_mb,
                "captures": last.captures,
            }
            rows.append({"minute": minute, **memory, **rest, "faults": struck})
        return rows

    def rows(self) -> list[dict[str, Any]]:
        """Per kind of fault: how many, and seconds until all had recovered."""
        rows = []
        for kind in dict.fromkeys(each.kind for each in self.outcomes):
            some = [each for each in self.outcomes if each.kind == kind]
            took = sorted(each.recovered_s for each in some if each.recovered_s is not None)
            routed = sorted(each.routed_s for each in some if each.routed_s is not None)
            rows.append(
                {
                    "kind": kind,
                    "blows": len(some),
                    "routed_p50_s": _quantile(routed, 0.5),
                    "routed_max_s": _quantile(routed, 1.0),
                    "moving_p50_s": _quantile(took, 0.5),
                    "moving_max_s": _quantile(took, 1.0),
                    "slower_than_2_s": sum(each > QUICK_S for each in took),
                    "never": len(some) - len(took),
                }
            )
        return rows

    def report(self) -> dict[str, Any]:
        """All of it, for chaos.json."""
        fields = msgspec.to_builtins(self)
        return {
            **fields,
            "rows": self.rows(),
            "minutes": self.minutes(),
            "growth": self.growth(),
            "broken": self.broken(),
        }


def name_of(outcome: Outcome) -> str:
    """Such as "kill of agent-a1, planner-t0"."""
    of = f" of {', '.join(outcome.whom)}" if outcome.whom else ""
    lasts = f" for {outcome.lasts_s:g} s" if outcome.lasts_s else ""
    many = f", {outcome.messages} messages" if outcome.messages else ""
    return f"{outcome.kind}{of}{lasts}{many}"


def _quantile(values: Sequence[float], share: float) -> float | None:
    return values[min(int(share * len(values)), len(values) - 1)] if values else None


# --- recovery ---------------------------------------------------------------------------------------------------

_ROUTED = frozenset({VehicleState.FOLLOWING, VehicleState.ARRIVED, VehicleState.STRANDED, VehicleState.SEARCHING})
_RESTING = frozenset({VehicleState.ARRIVED, VehicleState.STRANDED})
"""A vehicle at its target, or without any way to one, has nowhere to drive."""


@dataclass(frozen=True, slots=True)
class _Report:
    at_s: float
    place: tuple[float, float]
    state: VehicleState


class Recovery:
    """Watches the vehicles of a run.

    Times are seconds on one clock. A fault ends at `over`; a vehicle is routed again with the first report from
    then on which says that it follows a route or has arrived, and moves again with the first one from another
    place.
    """

    def __init__(self, vehicles: Iterable[str]) -> None:
        self._vehicles = tuple(vehicles)
        self._last: dict[str, _Report] = {}
        self._over_s: float | None = None
        self._stood: dict[str, tuple[float, float]] = {}
        """Vehicle -> its place in the first report since the fault was over."""
        self._routed_s: dict[str, float] = {}
        self._moved_s: dict[str, float] = {}

    @property
    def reported(self) -> bool:
        """True if every vehicle has reported."""
        return len(self._last) >= len(self._vehicles)

    def over(self, at_s: float) -> None:
        """The fault is over: count from now."""
        self._over_s = at_s
        self._stood.clear()
        self._routed_s.clear()
        self._moved_s.clear()

    def hear(self, fleet: Fleet, at_s: float) -> None:
        east_m, south_m = column(fleet.east_m, "<f4").tolist(), column(fleet.south_m, "<f4").tolist()
        for id, east, south, state in zip(fleet.ids, east_m, south_m, fleet.states, strict=True):
            report = _Report(at_s, (east, south), VehicleState(state))
            self._last[id] = report
            if self._over_s is None or at_s < self._over_s:
                continue
            if report.state in _ROUTED:
                self._routed_s.setdefault(id, at_s)
            stood = self._stood.setdefault(id, report.place)
            if report.state in _RESTING or stood != report.place:
                self._moved_s.setdefault(id, at_s)

    def routed_s(self) -> float | None:
        """Time at which the last vehicle was routed again; None while one is not."""
        return self._last_of(self._routed_s)

    def moving_s(self) -> float | None:
        """Time at which the last vehicle moved again; None while one does not."""
        return self._last_of(self._moved_s)

    def standing(self) -> list[str]:
        """Vehicles that have not moved since."""
        return [id for id in self._vehicles if id not in self._moved_s]

    def unrouted(self) -> list[str]:
        """Vehicles that have no route since."""
        return [id for id in self._vehicles if id not in self._routed_s]

    def _last_of(self, times_s: dict[str, float]) -> float | None:
        if self._over_s is None or any(id not in times_s for id in self._vehicles):
            return None
        return max(times_s[id] for id in self._vehicles)
