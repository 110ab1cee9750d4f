"""After a fault: since when do vehicles move, and have routes, again. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from swarm.wire.fields import column
from swarm.wire.messages.vehicles import Fleet, VehicleState

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
        """Whether every vehicle has been heard of."""
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
        """When the last vehicle was routed again; None while one is not."""
        return self._last_of(self._routed_s)

    def moving_s(self) -> float | None:
        """When the last vehicle moved again; None while one does not."""
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
