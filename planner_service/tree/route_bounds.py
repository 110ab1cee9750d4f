"""Proven lower bounds on the time to the target: docs/method/certificates.md says why they hold.

An earlier root's exact costs are a consistent heuristic: the landmark bound of ALT (A. V. Goldberg, C. Harrelson,
"Computing the shortest path: A* search meets graph theory", SODA 2005) with one landmark. No path from a cell to
the root costs less than the heuristic falls between the two. A window around the root adds that a way either stays
inside, or comes in over the window's rim for the last time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.repair import repair
from planner_service.kernels.route_kernels import OK
from planner_service.tree.cost_changes import Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import NO_WINDOW, CostToGoTree, WindowBound
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
        cost = tree.cost_at(starts) if cost is None else cost
        found = cost < np.inf
        known_s = np.where(found, cost, 0.0)
        rounding = self._grid.rounding.at(known_s)
        if tree.exact:
            own, by_rounding = tree.slack
            bound = known_s - known_s * np.minimum(own + by_rounding * rounding, 1.0)
        else:
            bound = self._beside(tree.window_bound or NO_WINDOW, self._grid.pad(tree.root), starts, rounding)
        # Of the optimum only the share that is travel time counts.
        return np.where(found, bound, 0.0) * self._grid.time_share

    def _beside(
        self, window: WindowBound, root: int, starts: NDArray[np.int64], rounding: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The larger of what the heuristic and the window around the padded root prove.

        rounding  relative, of a cost at each start
        """
        part, (row0, col0, row1, col1), rim, rim_cost = window
        inner = rim_cost * (1.0 - self._grid.rounding.at(rim_cost.max(initial=0.0)))
        way = np.full(starts.size, inner.min(initial=np.inf))
        fall = np.zeros(starts.size)
        if (heuristic := self._heuristic) is not None:
            own = heuristic[starts].astype(np.float64)
            own = np.where(own < np.inf, own, 0.0) * (1.0 - rounding)
            fall = np.maximum(own - float(heuristic[root]), 0.0)
            if rim.size:
                way = np.maximum(way, own - (heuristic[rim] - inner).max())
        rows, cols = np.divmod(starts, self._grid.stride)
        inside = np.flatnonzero((rows > row0) & (rows <= row1) & (cols > col0) & (cols <= col1))
        within = part[(rows[inside] - row0) * (col1 - col0 + 2) + cols[inside] - col0].astype(np.float64)
        inside, within = inside[within < np.inf], within[within < np.inf]
        way[inside] = np.minimum(way[inside], within * (1.0 - rounding[inside]))
        # A route was found, so that no bound is infinite; a rim that leads nowhere would be.
        return np.maximum(fall, np.where(way < np.inf, way, 0.0))


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
