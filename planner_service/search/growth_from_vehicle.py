"""Ways from a vehicle to where it is to look, on the cell costs of a planner's tree. Pure."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import Climbs
from planner_service.kernels.layout import NONE, step_offsets
from planner_service.kernels.queue_heap import arrivals
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.growth import turned_round
from shared_map.array_files import Floats
from swarm.grid import GridSpec, walk
from swarm.wire.route_columns import SEARCHING, RouteBatch

_MOST_CELLS = 1 << 21
"""Largest map over which arrivals are found exactly, in some tenths of a second, once each time a target is
lost."""


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A whole way.

    cells       from the vehicle to the goal
    directions  uint8, of the steps between them
    """

    cells: tuple[int, ...]
    directions: NDArray[np.uint8]


class Ways:
    """Grows from vehicles' cells. Holds room for one growth, which is made with the first."""

    def __init__(self, costs: CostGrid) -> None:
        self._costs = costs
        self._cost: Floats = np.empty(0, np.float32)
        self._parent: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._root = -1
        self._back_climbs: Climbs | None = None
        """Climbs of the way back. None before they are asked for."""

    @property
    def grid(self) -> GridSpec:
        return self._costs.grid

    def passable(self, cell: int) -> bool:
        """Returns True if a vehicle can be on a cell of the grid."""
        return self._costs.passable(cell)

    def grow(self, cell: int) -> None:
        """Finds the cheapest ways from a passable cell to all others."""
        if not self._cost.size:
            self._cost = np.empty(self._costs.size, np.float32)
            self._parent = np.empty(self._costs.size, np.uint8)
        self._parent.fill(NONE)
        self._back.grow(self._costs.pad(cell), self._cost, self._parent)
        self._root = cell

    @property
    def _back(self) -> CostGrid:
        """Returns the current cell costs for reversed driving: trees lead to their root, and vehicles away from
        it."""
        climbs = self._costs.climbs
        if climbs is None:
            return self._costs
        if self._back_climbs is None:
            self._back_climbs = turned_round(climbs)
        back = copy.copy(self._costs)
        back.climbs = self._back_climbs
        return back

    @property
    def diagonal_steps_s(self) -> Floats:
        """float32 (rows, cols), s: what a diagonal step into each cell takes; inf into a lethal one."""
        costs = self._costs
        into = costs.cell_cost.reshape(self.grid.rows + 2, costs.stride)[1:-1, 1:-1]
        steps_s: Floats = into * np.float32(costs.diagonal)
        return steps_s

    def arrivals_s(self, cell: int) -> Floats:
        """Returns float32 (rows, cols), s: for each cell, the earliest time at which something that starts on
        `cell`, which must be passable, can be there.

        For large maps and direction-dependent costs it returns a lower bound, computed from paths in the reverse
        direction. A reverse path charges each cell for a different step, which can be diagonal instead of straight,
        so the cost is divided by sqrt(2). It also charges the start cell, so one diagonal step there is subtracted
        first.
        """
        costs, grid = self._costs, self.grid
        if costs.climbs is None and costs.size <= _MOST_CELLS:
            cost = np.empty(costs.size, np.float32)
            keys, items = np.empty(costs.size, np.float32), np.empty(costs.size, np.int64)
            heap = keys, items, np.full(costs.size, -1, np.int32)
            offsets = step_offsets(costs.stride)
            arrivals(costs.cell_cost, offsets, float(costs.diagonal), costs.pad(cell), cost, heap)
            sooner_s: Floats = cost.reshape(grid.rows + 2, costs.stride)[1:-1, 1:-1]
            return sooner_s
        self.grow(cell)
        first_s = float(costs.cell_cost[costs.pad(cell)] * costs.diagonal)
        bound_s: Floats = np.maximum(self.costs_s - np.float32(first_s), 0.0) / np.float32(math.sqrt(2))
        return bound_s

    @property
    def costs_s(self) -> Floats:
        """float32 (rows, cols), s: from the cell of the last growth to all others; inf where there is no path."""
        grid = self.grid
        costs_s: Floats = self._cost.reshape(grid.rows + 2, self._costs.stride)[1:-1, 1:-1]
        return costs_s

    def way_to(self, goal: int) -> Way:
        """The way from the cell of the last growth to one that is not inf by `costs_s`."""
        costs = self._costs
        starts = np.array([costs.pad(goal)], np.int64)
        back = costs.walk(self._parent, costs.pad(self._root), starts, 0, costs.time_cost).directions
        directions = (back[::-1] ^ 4).astype(np.uint8)
        return Way(tuple(walk(self.grid, self._root, directions.tobytes())), directions)

    def route(self, way: Way, at: int, max_cells: int) -> RouteBatch:
        """The rest of a way from the cell with this number, or its next `max_cells` steps (0 is all), as one route
        whose status is SEARCHING: nothing is proven of it."""
        costs = self._costs
        rest = way.directions[at:]
        on_way = costs.pad_all(np.array(way.cells[at:], np.int64))
        parent = self._parent
        parent.fill(NONE)
        parent[on_way[:-1]] = rest
        root, starts = int(on_way[-1]), on_way[:1]
        walks = costs.walk(parent, root, starts, max_cells, costs.time_cost)
        rests = costs.rests(parent, root, walks.last, costs.time_cost)
        if walks.ends[0] < 0:
            raise AssertionError("a way does not end at its goal")
        cost_s = walks.driven + rests
        if not np.isfinite(cost_s).all():
            return RouteBatch.none(np.array(way.cells[at : at + 1], np.int64), SEARCHING)
        begun, statuses = np.array(way.cells[at : at + 1], np.int64), np.array([SEARCHING], np.uint8)
        unproven = np.zeros(1)
        return RouteBatch(statuses, begun, walks.directions, walks.ends, cost_s, unproven, walks.length, rests)
