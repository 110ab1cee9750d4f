"""Ground where uphill is not downhill: the same weights, other floods. docs/decisions says what that costs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.directed_growth import flood_directed
from planner_service.kernels.route_walk import step_offsets
from planner_service.tree.cost_grid import Ground, Walks
from shared_map.arrays import Floats
from shared_map.terrain.climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec

_WIDTH = 2.0
"""Width of a bucket in smallest weights: fewer buckets, and few cells are taken twice. Measured from 1 to 40."""
_RING = 1 << 12


class DirectedGround(Ground):
    """As `Ground`: a cell's weight is the cheapest straight step into it, and each step costs by its climb too.

    Only whole trees are grown on it: windows, repairs and skeletons know one cost per cell.
    """

    directed = True

    def __init__(self, grid: GridSpec, config: PlannerConfig, climb: Climb) -> None:
        super().__init__(grid, config)
        self._climb = climb
        self._lowest = climb.lowest
        self._metres = np.float32(grid.resolution_m * self._lowest)
        self._factors = climb.factors / np.float32(self._lowest)
        self._highest = float(self._factors.max())
        self._scale = np.array(climb.per_metre, np.float32)
        height = np.zeros((grid.rows + 2, self.stride), np.float32)
        height[1:-1, 1:-1] = climb.elevation_m
        self._height = height.reshape(-1)

    def grow(self, root: int, cost: Floats, parent: NDArray[np.uint8]) -> float:
        dearest = self.high * self.diagonal * self._highest
        width = max(self.low * _WIDTH, dearest / (_RING - 4))
        ring = 1 << math.ceil(math.log2(dearest / width + 3))
        return float(
            flood_directed(
                self.weight,
                self._height,
                self._factors,
                self._scale,
                cost,
                parent,
                self.stride,
                root,
                self.rule,
                self.corners,
                width,
                ring,
            )
        )

    def walk(
        self, parent: NDArray[np.uint8], root: int, starts: NDArray[np.int64], most: int, weight: Floats
    ) -> Walks:
        """As on any ground; what is driven is recomputed step by step."""
        walks = super().walk(parent, root, starts, most, weight)
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
        driven = np.concatenate(([0.0], np.cumsum(weight[heads].astype(np.float64) * factors * length)))
        return walks._replace(driven=driven[walks.ends] - driven[walks.ends - steps])


def ground_of(grid: GridSpec, config: PlannerConfig, climb: Climb | None) -> Ground:
    return Ground(grid, config) if climb is None else DirectedGround(grid, config, climb)
