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

from planner_service.kernels.compile import kernel
from planner_service.kernels.layout import BOX, INF, check_cells

WindowBound = tuple[NDArray[np.float32], tuple[int, int, int, int], NDArray[np.int64], NDArray[np.float64]]
"""What a window around the root costs on its own, a lower bound on every way that stays inside: (part, box, rim,
rim_cost).

part      float32  (cells,)  s; cost of the window's cells as a padded grid of its own; exact inside it
box       (row0, col0, row1, col1) of the window
rim       int64    (m,)      padded cells of the window, in the whole grid, from which a step leads out of it; empty
                             if there is no window
rim_cost  float64  (m,)      s; the window's own cost of each cell of the rim
"""


@kernel(f"(f4[::1], i8, i8, f4[::1], {BOX}, i8[::1], f8[::1], i8[::1], f8[::1], f8, f8[::1])")
def bound_by_heuristic(heuristic, root, stride, part, box, rim, rim_cost, starts, rounding, most, bound):
    """bound := the larger of itself and what a heuristic and the window around the padded root prove.

    part, box, rim, rim_cost  a `WindowBound`, in parts: a single route feels what a nested tuple takes to read
    rounding                  float64 (n,), relative; what float32 may add to labels on the best way from each
    most                      the same of the best way from any cell of the rim
    """
    if heuristic.size > 0:
        check_cells(starts, heuristic.size)
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    known = heuristic.size > 0
    at_root = np.inf
    if known:
        at_root = np.float64(heuristic[root])
    nearest = np.inf
    highest = -np.inf
    for j in range(rim.size):
        inner = rim_cost[j] * (1.0 - most)
        nearest = min(nearest, inner)
        if known:
            highest = max(highest, np.float64(heuristic[rim[j]]) - inner)
    for i in range(starts.size):
        v = starts[i]
        own = 0.0
        if known and heuristic[v] < INF:
            own = np.float64(heuristic[v]) * (1.0 - rounding[i])
        way = nearest
        if known and rim.size:
            way = max(way, own - highest)
        row = v // stride - 1
        col = v % stride - 1
        if row0 <= row < row1 and col0 <= col < col1:
            inner = np.float64(part[(row - row0 + 1) * width + col - col0 + 1])
            if inner < np.inf:
                way = min(way, inner * (1.0 - rounding[i]))
        # A route was found, so that no bound is infinite; a rim that leads nowhere would be.
        if way == np.inf:
            way = 0.0
        bound[i] = max(bound[i], max(own - at_root, way))
