"""Proven lower bounds on the time to the target: docs/method/certificates.md says why they hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import lower_bounds as kernels
from planner_service.kernels.repair import repair
from planner_service.kernels.route_kernels import OK
from planner_service.tree.cost_changes import Changes
from planner_service.tree.cost_grid import NO_COSTS, CostGrid
from planner_service.tree.cost_to_go import NO_WINDOW, CostToGoTree
from planner_service.tree.partitioned_tree import PartitionedTree
from shared_map.array_files import Floats
from swarm.wire.route_columns import RouteBatch

LOWER_SHARE = 16
"""A heuristic is lowered by visiting at most one cell in this number; beyond, the bound waits for a full search."""


class LowerBounds:
    """Lower bounds on the optimum while the tree itself is not exact."""

    def __init__(self, cost_grid: CostGrid) -> None:
        self._grid = cost_grid
        self._heuristic: Floats | None = None
        """float32, padded, s: the exact cost of an earlier root, lowered where the map became cheaper. A consistent
        heuristic: no step costs less than it falls by. `take` sets it, `learn` lowers it, or drops it (None) where
        that would visit too many cells."""

    def take(self, exact_cost: Floats) -> None:
        """Uses this exact padded cost from now on, which must not be written to any more."""
        self._heuristic = exact_cost

    def forget(self) -> None:
        """The map changed, and nothing is to be known of the optimum until `take`."""
        self._heuristic = None

    def learn(self, changes: Changes) -> None:
        """Lowers the heuristic after the map changed, where paths became cheaper. Costlier cells leave it
        consistent."""
        if self._heuristic is None or not changes.any_lower:
            return
        grid = self._grid
        limit = grid.grid.cells // LOWER_SHARE + 1024
        lowered, _ = repair(
            *(grid.padded, grid.climbs, (self._heuristic, _NO_PARENTS, 0), changes.cells, changes.before),
            *(grid.buckets, (0, 0, limit), grid.repair_scratch),
        )
        if lowered < 0:
            self._heuristic = None

    def at(
        self,
        tree: CostToGoTree | PartitionedTree,
        starts: NDArray[np.int64],
        cost: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Proven lower bounds, s, on the time from padded cells to the target now.

        cost  float64 (n,), what `tree.cost_at` says of these cells, where that is known; of those with inf, nothing
              is proven
        Raises ValueError where a start is no padded cell.
        """
        grid = self._grid
        cost = tree.cost_at(starts) if cost is None else cost
        heuristic = NO_COSTS if self._heuristic is None else self._heuristic
        bound = np.empty(starts.size)
        kernels.bound_costs(
            *(cost, starts, grid.rounding.cheapest, tree.slack if tree.exact else _NOT_EXACT),
            *((heuristic, grid.pad(tree.root), grid.stride), tree.window_bound or NO_WINDOW),
            *(grid.time_share, bound),  # of the optimum only the share that is travel time counts
        )
        return bound


_NOT_EXACT = (-1.0, 0.0)
"""In place of a tree's slack, which is 0 or more."""
_NO_PARENTS: NDArray[np.uint8] = np.empty(0, np.uint8)


def read_routes(
    tree: CostToGoTree | PartitionedTree, bounds: LowerBounds, asked: NDArray[np.int64], max_cells: int
) -> RouteBatch:
    """Routes from the cells, in order. Failures are statuses, not exceptions. `max_cells` 0: whole routes."""
    grid = tree.cost_grid
    starts, statuses = asked.copy(), np.empty(asked.size, np.uint8)
    walks = grid.walk(tree.parent, grid.pad(tree.root), starts, max_cells, grid.time_cost, statuses)
    rests = np.zeros(asked.size)  # of a whole route, which ends at the root
    if max_cells:
        tree.tighten(walks.last)
        rests = tree.time_at(walks.last)
    cost_s = walks.driven + rests
    bound_s = bounds.at(tree, starts, None if grid.length_weight_s else cost_s)
    if grid.length_weight_s:
        bound_s[statuses != OK] = 0.0
    return RouteBatch(statuses, asked, walks.directions, walks.ends, cost_s, bound_s, walks.length, rests)
