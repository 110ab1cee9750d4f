"""Lower bounds on the optimum, for many cells at once; docs/certificates.md proves them.

`bound_by_heuristic` is the landmark bound of ALT (A. V. Goldberg, C. Harrelson, "Computing the shortest path: A*
search meets graph theory", SODA 2005) with one landmark, an earlier root: its exact costs are a consistent
heuristic, so that no way from v to the root costs less than it falls between the two. A window around the root adds
that a way either stays inside, or comes in over the window's rim for the last time.

Arrays, beside those of `layout`:
    starts     int64    (n,)     padded cells
    bound      float64  (n,)     s; proven lower bound on the cost from each start
    heuristic  float32  (size,)  s; as `cost`; no step costs less than it falls by. Size 0 if there is none
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.layout import BOX, INF, check_cells

ROUNDING = 2.0**-23
"""Relative error of one float32 step, doubled for the sum over a route's steps."""


WindowBound = tuple[NDArray[np.float32], tuple[int, int, int, int], NDArray[np.int64], NDArray[np.float64]]
"""What a window around the root costs on its own, a lower bound on every way that stays inside: (part, box, rim,
rim_cost).

part      float32  (cells,)  s; cost of the window's cells as a padded grid of its own; exact inside it
box       (row0, col0, row1, col1) of the window
rim       int64    (m,)      padded cells of the window, in the whole grid, from which a step leads out of it; empty
                             if there is no window
rim_cost  float64  (m,)      s; the window's own cost of each cell of the rim
"""


@helper
def _rounding(cost, lowest, most):
    """How far float32 may have put this cost off, relatively: no optimal route has more steps than its cost has
    lowest cell costs, or than there are cells (`most`)."""
    return min((min(cost / lowest, most) + 4.0) * ROUNDING, 1.0)


@kernel(f"(f4[::1], i8, i8, f4[::1], {BOX}, i8[::1], f8[::1], i8[::1], f8, i8, f8[::1])")
def bound_by_heuristic(heuristic, root, stride, part, box, rim, rim_cost, starts, lowest, most, bound):
    """bound := the larger of itself and what a heuristic and the window around the padded root prove.

    part, box, rim, rim_cost  a `WindowBound`, in parts: a single route feels what a nested tuple takes to read
    lowest, most              lowest cell cost, s, and cells of the grid: they bound a route's steps, and so its
                              rounding
    """
    if heuristic.size > 0:
        check_cells(starts, heuristic.size)
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    known = heuristic.size > 0
    at_root = np.inf
    if known:
        at_root = np.float64(heuristic[root])
        at_root *= 1.0 + _rounding(at_root, lowest, most)
    nearest = np.inf
    highest = -np.inf
    for j in range(rim.size):
        inner = rim_cost[j] * (1.0 - _rounding(rim_cost[j], lowest, most))
        nearest = min(nearest, inner)
        if known:
            at_rim = np.float64(heuristic[rim[j]])
            highest = max(highest, at_rim * (1.0 + _rounding(at_rim, lowest, most)) - inner)
    for i in range(starts.size):
        v = starts[i]
        own = 0.0
        if known and heuristic[v] < INF:
            own = np.float64(heuristic[v])
            own *= 1.0 - _rounding(own, lowest, most)
        way = nearest
        if known and rim.size:
            way = max(way, own - highest)
        row = v // stride - 1
        col = v % stride - 1
        if row0 <= row < row1 and col0 <= col < col1:
            inner = np.float64(part[(row - row0 + 1) * width + col - col0 + 1])
            if inner < np.inf:
                way = min(way, inner * (1.0 - _rounding(inner, lowest, most)))
        # A route was found, so that no bound is infinite; a rim that leads nowhere would be.
        if way == np.inf:
            way = 0.0
        bound[i] = max(bound[i], max(own - at_root, way))
