"""Proven lower bounds on the time to the target: docs/certificates.md says why they hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import lower_bounds as kernels
from planner_service.kernels.repair import lower
from planner_service.tree.cost_grid import Changes, Ground
from planner_service.tree.cost_to_go import NOWHERE, CostToGoTree
from shared_map.arrays import Floats

LOWER_SHARE = 16
"""A potential is lowered by visiting at most one cell in so many; beyond, the bound waits for a full growth."""


class LowerBounds:
    """What is known of the optimum while the tree itself is not exact.

    The potential is the exact cost of an earlier root, lowered where the map became cheaper: no step costs less
    than it falls by.
    """

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._potential: Floats | None = None

    def take(self, exact_cost: Floats) -> None:
        """Go by this exact padded cost from now on; nobody may write to it any more."""
        self._potential = exact_cost

    def learn(self, changes: Changes) -> None:
        """The ground changed: lower the potential where ways became cheaper."""
        if self._potential is None or not changes.any_lower:
            return
        ground = self._ground
        limit = ground.grid.cells // LOWER_SHARE + 1024
        done = lower(
            ground.weight,
            self._potential,
            ground.stride,
            ground.rule,
            ground.corners,
            changes.cells,
            changes.before,
            *ground.buckets,
            limit,
        )
        if done < 0:
            self._potential = None

    def at(self, tree: CostToGoTree, starts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Proven lower bounds on the time from padded cells to the target now."""
        ground = self._ground
        low, most = ground.low, ground.grid.cells
        bound = np.zeros(starts.size)
        if tree.exact:
            kernels.by_exact(tree.cost, starts, low, most, bound)
        else:
            near = NOWHERE if tree.near is None else tree.near
            potential = _NONE if self._potential is None else self._potential
            kernels.by_potential(
                potential,
                ground.pad(tree.root),
                near.cost,
                near.box,
                ground.stride,
                near.rim,
                near.rim_cost,
                starts,
                low,
                most,
                bound,
            )
        if ground.length_weight_s:
            # Of the key's optimum only the share that is travel time counts, at least 1 - lambda / smallest weight.
            bound *= 1.0 - ground.length_weight_s / ground.low
        return bound


_NONE: Floats = np.empty(0, np.float32)
