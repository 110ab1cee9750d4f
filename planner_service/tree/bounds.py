"""Proven lower bounds on the time to the target: docs/certificates.md says why they hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import lower_bounds as kernels
from planner_service.kernels.repair import repair
from planner_service.tree.changes import Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import NO_WINDOW, CostToGoTree
from planner_service.tree.pieces import PieceTree
from planner_service.tree.rounding import Rounding
from shared_map.arrays import Floats

LOWER_SHARE = 16
"""A heuristic is lowered by visiting at most one cell in so many; beyond, the bound waits for a full growth."""


class LowerBounds:
    """What is known of the optimum while the tree itself is not exact."""

    def __init__(self, cost_grid: CostGrid) -> None:
        self._grid = cost_grid
        self._heuristic: Floats | None = None
        """float32, padded, s: the exact cost of an earlier root, lowered where the map became cheaper. A consistent
        heuristic: no step costs less than it falls by. `take` sets it, `learn` lowers it, or drops it (None) where
        that would visit too many cells."""
        self._rim: tuple[Rounding, NDArray[np.float64], float] | None = None
        """Of which map and rim `_rounding_of_rim` was asked last, and what it said: each query asks again."""

    def take(self, exact_cost: Floats) -> None:
        """Go by this exact padded cost from now on; nobody may write to it any more."""
        self._heuristic = exact_cost

    def forget(self) -> None:
        """The map changed, and nothing is to be known of the optimum until `take`."""
        self._heuristic = None

    def learn(self, changes: Changes) -> None:
        """The map changed: lower the heuristic where ways became cheaper. Dearer cells leave it consistent."""
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
        self, tree: CostToGoTree | PieceTree, starts: NDArray[np.int64], cost: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Proven lower bounds, s, on the time from padded cells to the target now.

        cost  float64 (n,), what `tree.cost_at` says of these cells, where that is known
        Raises ValueError where a start is no padded cell.
        """
        grid = self._grid
        cost = tree.cost_at(starts) if cost is None else cost
        rounding = grid.rounding.at(cost)
        if tree.exact:
            bound = cost - tree.slack(cost, rounding)
        else:
            bound = np.zeros(starts.size)
            part, box, rim, rim_cost = NO_WINDOW if tree.window_bound is None else tree.window_bound
            heuristic = _NONE if self._heuristic is None else self._heuristic
            root = grid.pad(tree.root)
            most = self._rounding_of_rim(rim_cost)
            kernels.bound_by_heuristic(
                heuristic, root, grid.stride, part, box, rim, rim_cost, starts, rounding, most, bound
            )
        # Of the optimum only the share that is travel time counts.
        return bound * grid.time_share

    def _rounding_of_rim(self, rim_cost: NDArray[np.float64]) -> float:
        """How far float32 may put the window's own costs of its rim off, relatively."""
        rounding = self._grid.rounding
        if self._rim is None or self._rim[0] is not rounding or self._rim[1] is not rim_cost:
            most = float(rounding.at(rim_cost.max(initial=0.0)))
            self._rim = rounding, rim_cost, most
        return self._rim[2]


_NONE: Floats = np.empty(0, np.float32)
_NO_PARENTS: NDArray[np.uint8] = np.empty(0, np.uint8)
