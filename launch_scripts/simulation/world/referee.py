"""The referee: finds collisions and lethal entries in what vehicles report. Pure.

A report of a vehicle holds from its stamp until the vehicle's next report. Where reports between two are missing
(the sequence number jumps) and the vehicle moved meanwhile, the older one is known to hold at its stamp only.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.simulation.world.body_referee import BodyHit as BodyHit
from launch_scripts.simulation.world.body_referee import BodyReferee, Stay
from swarm.clock import NS_PER_S
from swarm.config.classes import GROUND
from swarm.grid import GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.vehicles import Body, Fleet

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
    """row  in the column of all cells"""

    stay: Stay
    author: str
    seq: int
    stamp_ns: int
    row: int


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
        self._at: NDArray[np.int64] = np.empty(64, np.int64)
        """Last known cell of each vehicle, in the order in which they were first heard of; behind them room."""
        self._stays: dict[int, list[Stay]] = {}
        self._left: list[tuple[int, int, Stay]] = []
        """Heap of (when it ended, number, stay) of those which their vehicles have left."""
        self._encounters: dict[tuple[str, str], int] = {}
        self._entered = 0
        self._swept_ns = 0
        self._bodies = BodyReferee(grid)

    @property
    def cells(self) -> NDArray[np.int64]:
        """Last known cell of every vehicle."""
        own = self._at[: len(self._vehicles)].copy()
        return own if self._air is None else np.concatenate((own, self._air.cells))

    def hear_body(self, body: Body, now_ns: int) -> None:
        """Take in where a body is."""
        self._bodies.hear(body, now_ns)

    def hear(self, fleet: Fleet) -> list[Broken]:
        """Returns the laws that a report proves broken. Cells outside the grid are ignored."""
        if self._air is not None and fleet.vehicle_class in self._aloft:
            return self._air.hear(fleet)
        broken: list[Broken] = []
        author, seq, stamp_ns = fleet.author, fleet.seq, fleet.stamp_ns
        vehicles, stays, covered = self._vehicles, self._stays, self._bodies.covered
        # In one loop: each vehicle reports in every tick, and all that most of them have to say is that they are
        # still where they were.
        for id, cell in zip(fleet.ids, column(fleet.cells, "<u4").tolist(), strict=True):
            if cell >= self._cells:
                continue
            known = vehicles.get(id)
            if known is None:
                self._enter(Stay(id, cell, stamp_ns, stamp_ns, 0), fleet, None, broken)
                continue
            before_ns = known.stamp_ns
            if stamp_ns <= before_ns:
                continue
            gapless = author == known.author and seq <= known.seq + 1
            known.author, known.seq, known.stamp_ns = author, seq, stamp_ns
            stay = known.stay
            stands = cell == stay.cell
            if stands or gapless:
                stay.end_ns = stamp_ns
                if stay.cell in covered or len(stays[stay.cell]) > 1:
                    broken.extend(self._meetings(stay))
            if not stands:
                since_ns = stamp_ns if gapless else before_ns
                self._enter(Stay(id, cell, stamp_ns, stamp_ns, since_ns), fleet, known, broken)
        if stamp_ns - self._swept_ns > NS_PER_S:
            self._sweep(stamp_ns)
        return broken

    def _enter(self, entered: Stay, fleet: Fleet, known: _Vehicle | None, broken: list[Broken]) -> None:
        """A vehicle comes onto a cell."""
        self._stays.setdefault(entered.cell, []).append(entered)
        if known is None:
            row = len(self._vehicles)
            if row == len(self._at):
                self._at = np.concatenate((self._at, self._at))
            known = self._vehicles[entered.vehicle] = _Vehicle(
                entered, fleet.author, fleet.seq, fleet.stamp_ns, row
            )
        else:
            self._entered += 1
            heapq.heappush(self._left, (known.stay.end_ns, self._entered, known.stay))
            known.stay = entered
        self._at[known.row] = entered.cell
        truth = self._truths.get(fleet.vehicle_class, self._truths[GROUND])
        if not truth.item(entered.cell) < math.inf:
            broken.append(LethalEntry(entered.vehicle, entered.cell, fleet.stamp_ns))

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
        while self._left and now_ns - self._left[0][0] > _REMEMBER_NS:
            stay = heapq.heappop(self._left)[2]
            here = self._stays[stay.cell]
            here.remove(stay)
            if not here:
                del self._stays[stay.cell]
