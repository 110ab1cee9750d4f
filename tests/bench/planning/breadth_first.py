"""A breadth-first search over the arrays of the planner's kernels: what no growth can be faster than."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner_service.kernels.decorators import kernel
from planner_service.kernels.layout import GRID, INF, WALL


@kernel(f"({GRID}, f4[::1], i8, u4[::1])")
def breadth_first(grid: Any, cost: Any, root: Any, queue: Any) -> Any:
    """Steps from every cell to the root over 8 neighbours, whatever they cost: what no growth can be faster than.
    Returns how many cells have a way; `cost` is written whole, and WALL stays on lethal cells. `queue` has room for
    all cells."""
    cell_cost, offsets, _, _, _ = grid
    for i in range(cell_cost.size):
        cost[i] = INF if cell_cost[i] < INF else WALL
    cost[root] = np.float32(0.0)
    queue[0] = root
    first = 0
    last = 1
    while first < last:
        u = np.int64(queue[first])
        first += 1
        key = cost[u] + np.float32(1.0)
        for k in range(8):
            v = u + offsets[k]
            if cost[v] == INF:
                cost[v] = key
                queue[last] = v
                last += 1
    return last
