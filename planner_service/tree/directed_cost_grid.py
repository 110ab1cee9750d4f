"""A cost grid where uphill is not downhill: the same cell costs, another growth. docs/decisions says what that
costs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.directed_growth import Climbs, grow_directed
from planner_service.kernels.layout import step_offsets
from planner_service.tree.cost_grid import CostGrid, Walks
from shared_map.arrays import Floats
from shared_map.terrain.step_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec

_WIDTH = 2.0
"""Width of a bucket in lowest cell costs: fewer buckets, and few cells are taken twice. Measured from 1 to 40."""
_BUCKETS = 1 << 12


class DirectedCostGrid(CostGrid):
    """As `CostGrid`: a cell's cost is the cheapest straight step into it, and each step costs by its climb, too.

    Only whole trees are grown on it: windows, repairs and corridors know one cost per cell.
    """

    directed = True

    def __init__(self, grid: GridSpec, config: PlannerConfig, climb: Climb) -> None:
        super().__init__(grid, config)
        self._climb = climb
        self._lowest = climb.lowest
        self._metres = grid.resolution_m * self._lowest
        factors = climb.factors / np.float32(self._lowest)
        self._highest = climb.highest / self._lowest
        height = np.zeros((grid.rows + 2, self.stride), np.float32)
        height[1:-1, 1:-1] = climb.elevation_m
        self._climbs: Climbs = (height.reshape(-1), factors, np.array(climb.per_metre, np.float32))

    def _grow(self, root: int, cost: Floats, parent: NDArray[np.uint8]) -> float:
        dearest = self.highest_cell_cost * self.diagonal * self._highest
        width = max(self.lowest_cell_cost * _WIDTH, dearest / (_BUCKETS - 4))
        count = 1 << math.ceil(math.log2(dearest / width + 3))
        links, first = np.empty((self.size, 2), np.int32), np.empty(count, np.int32)
        labels = (cost, parent, root)
        return float(grow_directed(self.padded, labels, self._climbs, (width, count), links, first))

    def walk(
        self, parent: NDArray[np.uint8], root: int, starts: NDArray[np.int64], most: int, cell_cost: Floats
    ) -> Walks:
        """As on any cost grid; what is driven is recomputed step by step."""
        walks = super().walk(parent, root, starts, most, cell_cost)
        if (walks.ends < 0).any() or not walks.directions.size:
            return walks
        steps = np.diff(walks.ends, prepend=0)
        moves = step_offsets(self.stride)[walks.directions]
        # Where each step starts: what was moved before it on its own route, from that route's start.
        moved = np.cumsum(moves) - moves
        first = np.repeat(walks.ends - steps, steps)
        tails = np.repeat(starts, steps) + moved - moved[first]
        heads = tails + moves
        factors = self._climb.along(self.unpad_all(tails), self.unpad_all(heads)) / np.float32(self._lowest)
        length = np.where(walks.directions & 1, self.diagonal, 1.0)
        driven = np.concatenate(([0.0], np.cumsum(cell_cost[heads].astype(np.float64) * factors * length)))
        return walks._replace(driven=driven[walks.ends] - driven[walks.ends - steps])


def cost_grid_of(grid: GridSpec, config: PlannerConfig, climb: Climb | None) -> CostGrid:
    """Directed where there is a climb."""
    return CostGrid(grid, config) if climb is None else DirectedCostGrid(grid, config, climb)
