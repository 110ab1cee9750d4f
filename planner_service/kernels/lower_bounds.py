"""Lower bounds on the optimum, for many cells at once: docs/certificates.md says why they hold.

Arrays are laid out as `rules` says; `bound` is float64, s, one a start.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import INF

_ROUNDING = 2.0**-23
"""Relative error of one float32 step, doubled for the sum over a route's steps."""


@njit
def _rounding(cost, low, most):
    """How far float32 may have put this cost off, relatively: no optimal route has more steps than its cost has
    smallest weights, or than there are cells (`most`)."""
    return min((min(cost / low, most) + 4.0) * _ROUNDING, 1.0)


@njit
def by_exact(cost, starts, low, most, bound):
    """bound := what an exact tree says."""
    for i in range(starts.size):
        own = np.float64(cost[starts[i]])
        bound[i] = own * (1.0 - _rounding(own, low, most))


@njit
def by_potential(potential, root, part, box, stride, rim, rim_cost, starts, low, most, bound):
    """bound := the larger of itself and what a potential and the window around the root prove.

    potential  as `cost`; no step costs less than it falls by. Empty if there is none
    part, box  the window's own costs, padded, and where it lies; rim: int64, its cells from which a step leads out
               of it; rim_cost: float64, their own costs. Empty if there is no window
    No way to the root is cheaper than the potential falls along it; and it either stays in the window, or comes in
    over its rim for the last time and costs from there what the window says.
    """
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    known = potential.size > 0
    at_root = np.inf
    if known:
        at_root = np.float64(potential[root])
        at_root *= 1.0 + _rounding(at_root, low, most)
    nearest = np.inf
    highest = -np.inf
    for j in range(rim.size):
        inner = rim_cost[j] * (1.0 - _rounding(rim_cost[j], low, most))
        nearest = min(nearest, inner)
        if known:
            at_rim = np.float64(potential[rim[j]])
            highest = max(highest, at_rim * (1.0 + _rounding(at_rim, low, most)) - inner)
    for i in range(starts.size):
        v = starts[i]
        own = 0.0
        if known and potential[v] < INF:
            own = np.float64(potential[v])
            own *= 1.0 - _rounding(own, low, most)
        way = nearest
        if known and rim.size:
            way = max(way, own - highest)
        row = v // stride - 1
        col = v % stride - 1
        if row0 <= row < row1 and col0 <= col < col1:
            inner = np.float64(part[(row - row0 + 1) * width + col - col0 + 1])
            if inner < np.inf:
                way = min(way, inner * (1.0 - _rounding(inner, low, most)))
        # A route was found, so that no bound is infinite; a rim that leads nowhere would be.
        if way == np.inf:
            way = 0.0
        bound[i] = max(bound[i], max(own - at_root, way))
