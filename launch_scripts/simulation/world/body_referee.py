"""Who drove into whom: the referee of vehicles and bodies. Pure.

A report of a body holds from when it was heard until the next one or the end of its lease. Vehicles tell when they
were on a cell by their agents' clocks, bodies are timed by the referee's: overlaps that late messages explain count
for nothing.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass, field

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import MOST_M_PER_S, MOST_RADIUS_M, Body
from vehicle_agent.bodies import MOST_BODIES, REACTION_S, capsule_of

IN_TIME_NS = NS_PER_S // 5
"""Two ticks of an agent: a cell that a body has closed for so long is closed to every vehicle."""
_LATE_NS = 3 * NS_PER_S // 20
"""Shorter overlaps are no hit: the referee and an agent may hear of the same report so long after each other."""
_REMEMBER_NS = 5 * NS_PER_S
_APART_NS = 2 * NS_PER_S


@dataclass(frozen=True, slots=True)
class BodyHit:
    """A vehicle and a body on one cell at one time; reported once per encounter.

    by_vehicle  the vehicle is at fault: it entered the cell, though the body had closed it in time
    said_s      how long the body had closed the cell when the vehicle entered it; negative if the vehicle was first
    """

    vehicle: str
    body: str
    cell: int
    stamp_ns: int
    by_vehicle: bool
    said_s: float

    @property
    def sentence(self) -> str:
        if self.by_vehicle:
            return f"{self.vehicle} drove into body {self.body}, which had closed the cell for {self.said_s:.1f} s"
        if self.said_s < 0.0:
            return f"body {self.body} drove into {self.vehicle}, which was there first"
        return f"body {self.body} met {self.vehicle}, {self.said_s:.2f} s after it first told of the cell"


@dataclass(slots=True, eq=False)
class Stay:
    """A vehicle on a cell, from the first to the last time at which it is known to be there.

    since_ns  the earliest time at which it may have come there
    """

    vehicle: str
    cell: int
    begin_ns: int
    end_ns: int
    since_ns: int


@dataclass(slots=True, eq=False)
class _Cover:
    """A body on a cell. `closed_ns` is since when it has closed the cell, `end_ns` None while it is there."""

    body: str
    begin_ns: int
    closed_ns: int
    until_ns: int
    end_ns: int | None = None


@dataclass(slots=True, eq=False)
class _Record:
    seq: int = -1
    until_ns: int = 0
    covers: dict[int, _Cover] = field(default_factory=dict)
    closed_ns: dict[int, int] = field(default_factory=dict)
    """Cell -> since when it has been closed, of those that the newest report closes."""


class BodyReferee:
    """Finds vehicles and bodies on one cell."""

    def __init__(self, grid: GridSpec) -> None:
        self._grid = grid
        self._records: dict[tuple[str, int], _Record] = {}
        self._covers: dict[int, list[_Cover]] = {}
        self._met: dict[tuple[str, str], int] = {}
        self._swept_ns = 0

    def hear(self, body: Body, now_ns: int) -> None:
        """Take in a report; one that is no news, or that no agent would avoid, changes nothing."""
        key = body.id, body.incarnation
        record = self._records.get(key)
        if record is None:
            if len(self._records) >= MOST_BODIES:
                return
            record = self._records[key] = _Record()
        elif body.seq <= record.seq and now_ns < record.until_ns:
            return
        if body.radius_m > MOST_RADIUS_M or body.speed_m_per_s > MOST_M_PER_S:
            return
        began_ns = min(now_ns, record.until_ns)
        fresh = now_ns < record.until_ns and body.lease_s > 0.0
        before = record.covers if fresh else {}
        closed_before = record.closed_ns if fresh else {}
        record.seq, record.until_ns = body.seq, now_ns + int(body.lease_s * NS_PER_S)
        covered = capsule_of(body, self._grid, 0.0).cells(self._grid) if body.lease_s > 0.0 else []
        closed = capsule_of(body, self._grid, body.speed_m_per_s * REACTION_S).cells(self._grid) if covered else []
        record.closed_ns = {cell: closed_before.get(cell, now_ns) for cell in closed}
        ended, record.covers = record.covers, {}
        for cell in covered:
            cover = before.get(cell)
            if cover is None:
                cover = _Cover(body.id, now_ns, record.closed_ns.get(cell, now_ns), 0)
                self._covers.setdefault(cell, []).append(cover)
            cover.until_ns = record.until_ns
            record.covers[cell] = cover
        for cell, cover in ended.items():
            if record.covers.get(cell) is not cover:
                cover.end_ns = began_ns
        if not 0 <= now_ns - self._swept_ns < NS_PER_S:
            self._sweep(now_ns)

    @property
    def covered(self) -> Container[int]:
        """The cells on which a body was lately; goes on being them."""
        return self._covers

    def check(self, stay: Stay) -> Iterator[BodyHit]:
        """What a vehicle's stay on a cell proves."""
        for cover in self._covers.get(stay.cell, ()):
            end_ns = min(stay.end_ns, cover.until_ns if cover.end_ns is None else cover.end_ns)
            if end_ns - max(stay.begin_ns, cover.begin_ns) <= _LATE_NS:
                continue
            met_ns = self._met.get((stay.vehicle, cover.body))
            self._met[stay.vehicle, cover.body] = end_ns
            if met_ns is None or end_ns - met_ns > _APART_NS:
                said_ns = stay.since_ns - cover.closed_ns
                yield BodyHit(
                    stay.vehicle, cover.body, stay.cell, end_ns, said_ns >= IN_TIME_NS, said_ns / NS_PER_S
                )

    def _sweep(self, now_ns: int) -> None:
        """Forget what ended long ago."""
        self._swept_ns = now_ns
        for cell in list(self._covers):
            kept = [
                cover
                for cover in self._covers[cell]
                if now_ns - (cover.until_ns if cover.end_ns is None else cover.end_ns) <= _REMEMBER_NS
            ]
            if kept:
                self._covers[cell] = kept
            else:
                del self._covers[cell]
        for key in [key for key, record in self._records.items() if now_ns - record.until_ns > _REMEMBER_NS]:
            del self._records[key]
        for pair in [pair for pair, met_ns in self._met.items() if now_ns - met_ns > 2 * _REMEMBER_NS]:
            del self._met[pair]
