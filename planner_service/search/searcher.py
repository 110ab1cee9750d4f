"""The search for one target that nobody sees: what is believed, and which vehicle is to look where. Pure.

Places are drawn in proportion to belief / (cost + `OFFSET_S`): taking the best of all dithers around the vehicle
and sends all to the same place, drawing spreads them without negotiation. Times are seconds on the terrain.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.search.belief import Belief
from planner_service.search.blocks import Blocks, blocks_of
from planner_service.search.ways import Way, Ways
from planner_service.tree.cost_grid import CostGrid
from shared_map.arrays import Bools, Floats
from swarm.wire.routes import LETHAL_START, OUTSIDE, SEARCHING, UNREACHABLE, RouteBatch

OFFSET_S = 900.0
"""Places that cost less than this differ little: near ones are preferred, but not for every scrap of belief."""
APART_BLOCKS = 3
"""Around a place that a vehicle has been given, no other is given one."""
KEPT_SHARE = 0.3
"""A place is given up when no more than this share of the belief around it is left."""
STEP_S = 30.0
"""Of the belief, at most; less where blocks are small."""
MOST_GOALS = 4096
"""Vehicles with a place at once; of more, those that were given one first lose it."""
_GROWN_CELLS = 1 << 20
"""Cells that may be grown between two ticks: so many decisions are taken, the rest wait."""
_MOST_DECISIONS = 8


@dataclass(slots=True, eq=False)
class _Goal:
    """Where one vehicle is to look.

    mass         belief of the block and those around it when it was given
    map_version  which the way was found on
    """

    block: tuple[int, int]
    way: Way
    mass: float
    map_version: int


class Searcher:
    """Searches while it is `active`.

    Parameters
    ----------
    costs : the cell costs of the planner's tree, kept up to date by their owner
    range_m : how far vehicles see a target
    slowness : how many times as long as a vehicle the target takes for a cell
    seed : decides what is drawn
    """

    def __init__(self, costs: CostGrid, range_m: float, slowness: float, seed: str) -> None:
        self.belief: Belief | None = None
        """None while it does not search."""
        self.decisions = 0
        """Places given since the beginning."""
        self._range_m = range_m
        self._slowness = slowness
        self._chance = random.Random(seed)
        self._ways = Ways(costs)
        self._goals: dict[str, _Goal] = {}
        """Vehicle -> where it is to look."""
        self._waited_s = 0.0
        self._left = self._most = max(1, min(_GROWN_CELLS // costs.grid.cells, _MOST_DECISIONS))

    @property
    def active(self) -> bool:
        return self.belief is not None

    @property
    def goals(self) -> dict[str, int]:
        """Vehicle -> the cell at which it is to look."""
        return {id: goal.way.cells[-1] for id, goal in self._goals.items()}

    def begin(self, pace_s_per_m: Floats, cell: int | None, age_s: float) -> None:
        """Search from now on.

        Parameters
        ----------
        pace_s_per_m : (rows, cols) float32, the map as it is now
        cell : where the target was last; None if it never was seen, or may be anywhere
        age_s : how long ago
        """
        blocks = blocks_of(self._ways.grid, pace_s_per_m, self._range_m)
        if not blocks.open.any():
            return
        self._goals.clear()
        self._waited_s = 0.0
        at = arrival_s = None
        if cell is not None and self._ways.passable(cell):
            at = blocks.of_cell(cell)
            arrival_s = self._arrivals(blocks, cell, at)
        self.belief = Belief(blocks, self._slowness, at, arrival_s, age_s)

    def _arrivals(self, blocks: Blocks, cell: int, at: tuple[int, int]) -> NDArray[np.float64]:
        """(rows, cols), s after the target was on a cell when it can be in each block at the earliest: it need not
        come to the middle."""
        self._ways.grow(cell)
        reach_s = self._ways.costs_s(blocks.places).astype(np.float64)
        reach_s -= blocks.pace_s_per_m * (blocks.side_m * math.sqrt(0.5))
        with np.errstate(invalid="ignore"):
            arrival_s: NDArray[np.float64] = np.maximum(reach_s, 0.0) * self._slowness
        arrival_s[np.isnan(arrival_s)] = 0.0
        arrival_s[at] = 0.0
        return arrival_s

    def end(self) -> None:
        """The target is seen again."""
        self.belief = None
        self._goals.clear()

    def tick(self, elapsed_s: float, places_m: Sequence[tuple[float, float]]) -> None:
        """So many seconds have passed, and vehicles look from these places, (east, south) in m from the corner."""
        self._left = self._most
        belief = self.belief
        if belief is None:
            return
        self._waited_s += max(elapsed_s, 0.0)
        if self._waited_s < min(belief.step_s, STEP_S):
            return
        belief.predict(self._waited_s)
        self._waited_s = 0.0
        belief.seen(places_m, self._range_m)
        for id in [id for id, goal in self._goals.items() if belief.near(goal.block) < KEPT_SHARE * goal.mass]:
            del self._goals[id]

    def wants_place(self, vehicle: str) -> bool:
        """Whether a vehicle has no place to look at."""
        return vehicle not in self._goals

    @property
    def may_decide(self) -> bool:
        """Whether another place may be given before the next tick."""
        return self._left > 0

    def forget_all_but(self, vehicles: Iterable[str]) -> None:
        """Others look for another target now."""
        kept = set(vehicles)
        self._goals = {id: goal for id, goal in self._goals.items() if id in kept}

    def route(self, vehicle: str | None, cell: int, max_cells: int, map_version: int) -> RouteBatch:
        """One route to the place where a vehicle on a cell is to look: SEARCHING, with an infinite cost and no
        steps where it has to ask again.

        vehicle  None for somebody who only asks, and keeps no place
        """
        asked = np.array([cell], np.int64)
        grid = self._ways.grid
        if not 0 <= cell < grid.cells:
            return RouteBatch.none(asked, OUTSIDE)
        if not self._ways.passable(cell):
            return RouteBatch.none(asked, LETHAL_START)
        goal = None if vehicle is None else self._goals.get(vehicle)
        if goal is not None and goal.map_version == map_version and cell in goal.way.cells[:-1]:
            return self._ways.route(goal.way, goal.way.cells.index(cell), max_cells)
        if self.belief is None or self._left <= 0:
            return RouteBatch.none(asked, SEARCHING)
        self._left -= 1
        self._ways.grow(cell)
        cost_s = self._ways.costs_s(self.belief.blocks.places)
        if goal is not None and 0 < cost_s[goal.block] < np.inf:
            block, mass = goal.block, goal.mass
        else:
            drawn = self._draw(vehicle, cell, cost_s)
            if drawn is None:
                return RouteBatch.none(asked, UNREACHABLE)
            block, mass = drawn, self.belief.near(drawn)
            self.decisions += 1
        way = self._ways.way_to(int(self.belief.blocks.places[block]))
        if vehicle is not None:
            self._goals.pop(vehicle, None)
            if len(self._goals) >= MOST_GOALS:
                del self._goals[next(iter(self._goals))]
            self._goals[vehicle] = _Goal(block, way, mass, map_version)
        return self._ways.route(way, 0, max_cells)

    def _draw(self, vehicle: str | None, cell: int, cost_s: Floats) -> tuple[int, int] | None:
        """The block where to look: not the vehicle's own, and apart from the others' if there is another. None
        where no way leads to any."""
        belief = self.belief
        assert belief is not None
        blocks = belief.blocks
        there = (cost_s > 0.0) & (cost_s < np.inf)
        there[blocks.of_cell(cell)] = False
        weights = np.where(there, belief.total / (cost_s.astype(np.float64) + OFFSET_S), 0.0)
        apart = weights * ~self._taken(blocks, vehicle)
        anywhere = np.where(there, blocks.share, 0.0) / (np.where(there, cost_s, 0.0) + OFFSET_S)
        for each in (apart, weights, anywhere):
            sums = np.cumsum(each.reshape(-1), dtype=np.float64)
            if sums[-1] > 0.0:
                at = int(np.searchsorted(sums, self._chance.random() * sums[-1], side="right"))
                row, col = divmod(min(at, int(np.flatnonzero(each.reshape(-1))[-1])), blocks.shape[1])
                return row, col
        return None

    def _taken(self, blocks: Blocks, vehicle: str | None) -> Bools:
        """bool (rows, cols): around the places of other vehicles."""
        taken: Bools = np.zeros(blocks.shape, np.bool_)
        for id, goal in self._goals.items():
            if id != vehicle:
                row, col = goal.block
                side_m = blocks.side_m
                rows, cols, inside = blocks.within(
                    (col + 0.5) * side_m, (row + 0.5) * side_m, APART_BLOCKS * side_m
                ) or (slice(0), slice(0), np.zeros((0, 0), np.bool_))
                taken[rows, cols] |= inside
        return taken
