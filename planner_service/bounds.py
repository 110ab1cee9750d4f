"""Proven lower bounds on the time to the target: docs/certificates.md says why they hold."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner_service.ground import Changes, Ground
from planner_service.kernels.repair import lower
from planner_service.tree import CostToGoTree
from shared_map.arrays import Floats

LOWER_SHARE = 16
"""A potential is lowered by visiting at most one cell in so many; beyond, the bound waits for a full growth."""
ROUNDING = 2.0**-23
"""Relative error of one float32 step, doubled for the sum over a route's steps."""


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
            limit,
        )
        if done < 0:
            self._potential = None

    def at(self, tree: CostToGoTree, starts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Proven lower bounds on the time from padded cells to the target now."""
        ground = self._ground
        if tree.exact:
            own = tree.cost[starts].astype(np.float64)
            bound = own * (1.0 - self._rounding(own))
        else:
            bound = self._shifted(tree, starts)
        if ground.length_weight_s:
            # Of the key's optimum only the share that is travel time counts, at least 1 - lambda / smallest weight.
            bound = bound * (1.0 - ground.length_weight_s / ground.low)
        return np.maximum(bound, 0.0)

    def _shifted(self, tree: CostToGoTree, starts: NDArray[np.int64]) -> NDArray[np.float64]:
        """No way to the target is cheaper than the potential falls along it; and it either stays in the window
        around the target, or comes in over its rim for the last time and costs from there what the window says."""
        ground = self._ground
        potential = self._potential
        own = np.zeros(starts.size)
        at_target = math.inf
        if potential is not None:
            own = potential[starts].astype(np.float64)
            own[~np.isfinite(own)] = 0.0
            own = own * (1.0 - self._rounding(own))
            at_target = float(potential[ground.pad(tree.root)])
            at_target *= 1.0 + float(self._rounding(np.asarray(at_target)))
        bound = np.maximum(own - at_target, 0.0)
        near = tree.near
        if near is None:
            return bound
        rim_cost = near.rim_cost * (1.0 - self._rounding(near.rim_cost))
        outside = np.full(starts.size, rim_cost.min(initial=math.inf))
        if potential is not None and near.rim.size:
            at_rim = potential[near.rim].astype(np.float64)
            at_rim = at_rim * (1.0 + self._rounding(at_rim))
            outside = np.maximum(outside, own - (at_rim - rim_cost).max())
        rows, cols = np.divmod(starts, ground.stride)
        rows, cols = rows - 1 - near.window.row0, cols - 1 - near.window.col0
        height, width = near.cost.shape
        within = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
        inside = np.full(starts.size, math.inf)
        own_way = near.cost[rows[within], cols[within]].astype(np.float64)
        known = np.where(np.isfinite(own_way), own_way, 0.0)
        inside[within] = own_way * (1.0 - self._rounding(known))
        found = np.minimum(inside, outside)
        # A route was found, so that no bound is infinite; a rim that leads nowhere would be.
        return np.maximum(bound, np.where(np.isfinite(found), found, 0.0))

    def _rounding(self, costs: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far float32 may have put these costs off, relatively: no optimal route has more steps than this."""
        steps = np.minimum(costs / self._ground.low, self._ground.grid.cells) + 4.0
        return np.minimum(np.asarray(steps * ROUNDING), 1.0)
