"""The referee: finds collisions and lethal entries in what vehicles report. Pure.

A report of a vehicle holds from its stamp until the vehicle's next report. Where reports between two are missing
(the sequence number jumps) and the vehicle moved meanwhile, the older one is known to hold at its stamp only.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.world.body_referee import BodyHit as BodyHit
from launch_scripts.world.body_referee import BodyReferee, Stay
from swarm.clock import NS_PER_S
from swarm.config.classes import GROUND
from swarm.grid import GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.bodies import Body
from swarm.wire.messages.vehicles import Fleet

_SKEW_NS = NS_PER_S // 200
"""Shorter overlaps are no collision: the clocks of two processes may differ by as much."""
_REMEMBER_NS = 5 * NS_PER_S
_APART_NS = 2 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Collision:
    """Two vehicles on one cell at one time; reported once per encounter."""

    first: str
    second: str
    cell: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class LethalEntry:
    """A vehicle entered a cell which is lethal in truth to its class."""

    vehicle: str
    cell: int
    stamp_ns: int


Broken = Collision | LethalEntry | BodyHit


@dataclass(slots=True)
class _Vehicle:
    stay: Stay
    author: str
    seq: int
    stamp_ns: int


class Referee:
    """Turns reports into broken laws. Repeated and late reports change nothing.

    truths  class of vehicles -> float32 (rows, cols), s/m; inf is lethal. One that is not there is as "ground"
    aloft   classes that fly: they meet each other, and nothing that drives
    """

    def __init__(
        self, truths: Mapping[str, NDArray[np.float32]], grid: GridSpec, aloft: Collection[str] = ()
    ) -> None:
        self._aloft = frozenset(aloft)
        self._air = Referee(truths, grid) if aloft else None
        self._truths = {name: truth.reshape(-1) for name, truth in truths.items()}
        self._cells = grid.cells
        self._vehicles: dict[str, _Vehicle] = {}
        self._stays: dict[int, list[Stay]] = {}
        self._encounters: dict[tuple[str, str], int] = {}
        self._swept_ns = 0
        self._bodies = BodyReferee(grid)

    @property
    def cells(self) -> NDArray[np.int64]:
        """Last known cell of every vehicle."""
        own = np.fromiter((vehicle.stay.cell for vehicle in self._vehicles.values()), dtype=np.int64)
        return own if self._air is None else np.concatenate((own, self._air.cells))

    def hear_body(self, body: Body, now_ns: int) -> None:
        """Take in where a body is."""
        self._bodies.hear(body, now_ns)

    def hear(self, fleet: Fleet) -> list[Broken]:
        """Returns the laws that a report proves broken. Cells outside the grid are ignored."""
        if self._air is not None and fleet.vehicle_class in self._aloft:
            return self._air.hear(fleet)
        broken: list[Broken] = []
        for id, cell in zip(fleet.ids, column(fleet.cells, "<u4").tolist(), strict=True):
            if cell < self._cells:
                self._report(id, cell, fleet, broken)
        if fleet.stamp_ns - self._swept_ns > NS_PER_S:
            self._sweep(fleet.stamp_ns)
        return broken

    def _report(self, id: str, cell: int, fleet: Fleet, broken: list[Broken]) -> None:
        stamp_ns = fleet.stamp_ns
        since_ns = 0
        known = self._vehicles.get(id)
        if known is not None:
            if stamp_ns <= known.stamp_ns:
                return
            gapless = fleet.author == known.author and fleet.seq <= known.seq + 1
            since_ns = stamp_ns if gapless else known.stamp_ns
            known.author, known.seq, known.stamp_ns = fleet.author, fleet.seq, stamp_ns
            stay = known.stay
            if cell == stay.cell or gapless:
                stay.end_ns = stamp_ns
                if self._bodies.covers(stay.cell) or len(self._stays.get(stay.cell, ())) > 1:
                    broken.extend(self._meetings(stay))
            if cell == stay.cell:
                return
        entered = Stay(id, cell, stamp_ns, stamp_ns, since_ns)
        self._stays.setdefault(cell, []).append(entered)
        if known is None:
            self._vehicles[id] = _Vehicle(entered, fleet.author, fleet.seq, stamp_ns)
        else:
            known.stay = entered
        truth = self._truths.get(fleet.vehicle_class, self._truths[GROUND])
        if not truth.item(cell) < math.inf:
            broken.append(LethalEntry(id, cell, stamp_ns))

    def _meetings(self, stay: Stay) -> Iterator[Collision | BodyHit]:
        yield from self._bodies.check(stay)
        for other in self._stays.get(stay.cell, ()):
            overlap_ns = min(stay.end_ns, other.end_ns) - max(stay.begin_ns, other.begin_ns)
            if other.vehicle == stay.vehicle or overlap_ns <= _SKEW_NS:
                continue
            first, second = sorted((stay.vehicle, other.vehicle))
            last_ns = self._encounters.get((first, second))
            until_ns = min(stay.end_ns, other.end_ns)
            self._encounters[first, second] = max(until_ns, last_ns or 0)
            if last_ns is None or until_ns - last_ns > _APART_NS:
                yield Collision(first, second, stay.cell, until_ns)

    def _sweep(self, now_ns: int) -> None:
        """Forgets stays that ended long ago. A vehicle's last stay is kept: it still stands there."""
        self._swept_ns = now_ns
        for cell in list(self._stays):
            kept = [
                stay
                for stay in self._stays[cell]
                if now_ns - stay.end_ns <= _REMEMBER_NS or self._vehicles[stay.vehicle].stay is stay
            ]
            if kept:
                self._stays[cell] = kept
            else:
                del self._stays[cell]
