"""Lower bounds on the optimum, for many cells at once; docs/method/certificates.md proves them.

`_by_heuristic` is the landmark bound of ALT (A. V. Goldberg, C. Harrelson, "Computing the shortest path: A* search
meets graph theory", SODA 2005) with one landmark, an earlier root: its exact costs are a consistent heuristic, so
that no path from v to the root costs less than the heuristic falls between the two. A window around the root adds
that a way either stays inside, or comes in over the window's rim for the last time.

Arrays, beside those of `layout`:
    starts     int64    (n,)     padded cells
    cost       float64  (n,)     s; the cost driven from each start, or inf
    bound      float64  (n,)     s; proven lower bound on the cost from each start
    heuristic  float32  (size,)  s; as `cost`; no step costs less than it falls by. Size 0 if there is none
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.decorators import helper, kernel
from planner_service.kernels.layout import BOX, INF, check_cells

WindowBound = tuple[NDArray[np.float32], tuple[int, int, int, int], NDArray[np.int64], NDArray[np.float64]]
"""Lower bound of a window around the root on every path that stays inside: (part, box, rim, rim_cost).

part      float32  (cells,)  s; cost of the window's cells as a padded grid of its own; exact inside it
box       (row0, col0, row1, col1) of the window
rim       int64    (m,)      padded cells of the window, in the whole grid, from which a step leads out of it; empty
                             if there is no window
rim_cost  float64  (m,)      s; the window's own cost of each cell of the rim
"""


_CHEAPEST = "Tuple((f8[::1], f8[::1]))"
_HEURISTIC = "Tuple((f4[::1], i8, i8))"
_WINDOW = f"Tuple((f4[::1], {BOX}, i8[::1], f8[::1]))"


@helper
def _rounding(cheapest, cost):
    """float64: as `tree.cost_changes.Rounding.at`, bit for bit, which says why."""
    costs, counts = cheapest
    last = costs.size - 1
    if cost >= costs[last]:
        steps = counts[last]
    else:
        low, high = 0, last  # costs[low] <= cost < costs[high]
        while high - low > 1:
            middle = (low + high) // 2
            if costs[middle] <= cost:
                low = middle
            else:
                high = middle
        steps = counts[low]
        if costs[low] != cost:
            slope = (counts[low + 1] - counts[low]) / (costs[low + 1] - costs[low])
            steps = slope * (cost - costs[low]) + counts[low]
    return min((steps + 8.0) * 2.0**-24, 1.0)


@helper
def _by_heuristic(heuristic, window, cost, starts, cheapest, bound):
    """bound := the larger of what a heuristic and the window around the root prove."""
    potential, root, stride = heuristic
    part, box, rim, rim_cost = window
    known = potential.size > 0
    if known:
        check_cells(starts, potential.size)
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    at_root = np.inf
    if known:
        at_root = np.float64(potential[root])
    farthest = 0.0
    for j in range(rim.size):
        farthest = max(farthest, rim_cost[j])
    most = _rounding(cheapest, farthest)
    nearest = np.inf
    highest = -np.inf
    for j in range(rim.size):
        inner = rim_cost[j] * (1.0 - most)
        nearest = min(nearest, inner)
        if known:
            highest = max(highest, np.float64(potential[rim[j]]) - inner)
    for i in range(starts.size):
        v = starts[i]
        rounding = _rounding(cheapest, cost[i])
        own = 0.0
        if known and potential[v] < INF:
            own = np.float64(potential[v]) * (1.0 - rounding)
        way = nearest
        if known and rim.size:
            way = max(way, own - highest)
        row = v // stride - 1
        col = v % stride - 1
        if row0 <= row < row1 and col0 <= col < col1:
            inner = np.float64(part[(row - row0 + 1) * width + col - col0 + 1])
            if inner < np.inf:
                way = min(way, inner * (1.0 - rounding))
        # A route was found, so that no bound is infinite; a rim that leads nowhere would be.
        if way == np.inf:
            way = 0.0
        bound[i] = max(0.0, max(own - at_root, way))


@kernel(f"(f8[::1], i8[::1], {_CHEAPEST}, UniTuple(f8, 2), {_HEURISTIC}, {_WINDOW}, f8, f8[::1])")
def bound_costs(cost, starts, cheapest, slack, heuristic, window, share, bound):
    """bound := proven lower bounds; 0 where `cost` is inf.

    cheapest   (costs, counts) as `tree.cost_changes.Rounding.cheapest` says
    slack      as an exact tree's `slack`; of one that is not, the first is negative
    heuristic  (heuristic, padded root, stride); not looked at where the tree is exact
    window     a `WindowBound`; as above
    share      what part of any cost counts
    """
    own, by_rounding = slack
    if own < 0.0:
        _by_heuristic(heuristic, window, cost, starts, cheapest, bound)
    for i in range(starts.size):
        if not cost[i] < np.inf:
            bound[i] = 0.0
            continue
        if own >= 0.0:
            rounding = _rounding(cheapest, cost[i])
            bound[i] = cost[i] - cost[i] * min(own + by_rounding * rounding, 1.0)
        bound[i] *= share
