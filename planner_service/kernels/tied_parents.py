"""Parents in a tree whose costs float32 does not tell apart.

Where a step costs less than the rounding of the way behind it, a cell may cost what its parent does, and parents
that follow from costs alone may lead in a circle. Such cells get others: from where costs do tell them onward, over
steps that cost exactly what their cells differ by. Every cell with a way has such steps all the way to the root:
its cost is what one neighbour offered it, which cost less, or as much and was served before it.

Arrays, beside those of `layout` and `climbs`:
    queue  uint32  (2 * size,)  padded cells that need another parent; behind them, those that have got one
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.climbs import CLIMBS, offered
from planner_service.kernels.compile import helper, step_kernel
from planner_service.kernels.layout import GRID, INF, LABELS, NONE, RULE_FOUR, step_length


@helper
def _leads(grid, climbs, labels, v, k):
    """Whether a cell's step in direction k is one of its cheapest, and leads to a cell whose parent is right."""
    cell_cost, offsets, _, rule, corners = grid
    cost, parent, root = labels
    odd = k & 1
    u = v + offsets[k]
    if (odd and rule == RULE_FOUR) or not cost[u] < INF or (parent[u] == NONE and u != root):
        return False
    if odd and not corners and max(cell_cost[v + offsets[k - 1]], cell_cost[v + offsets[(k + 1) & 7]]) == INF:
        return False
    return offered(cost[u], cell_cost[u], climbs, v, u, k, step_length(rule, odd)) == cost[v]


@step_kernel(f"({GRID}, CLIMBS, {LABELS}, u4[::1])", CLIMBS)
def untie_parents(grid, climbs, labels, queue):
    """Of exact costs, and of parents that follow from them: replace those that cost as much as their cells."""
    offsets = grid[1]
    cost, parent, root = labels
    count = 0
    for v in range(cost.size):
        if cost[v] < INF and parent[v] != NONE and not cost[v + offsets[parent[v]]] < cost[v]:
            queue[count] = v
            count += 1
    for i in range(count):
        parent[queue[i]] = NONE
    done = count
    for i in range(count):
        v = np.int64(queue[i])
        for k in range(8):
            if parent[v] == NONE and _leads(grid, climbs, labels, v, k):
                parent[v] = k
                queue[done] = v
                done += 1
    while count < done:
        u = np.int64(queue[count])
        count += 1
        for k in range(8):
            v = u - offsets[k]
            if parent[v] == NONE and v != root and cost[v] < INF and _leads(grid, climbs, labels, v, k):
                parent[v] = k
                queue[done] = v
                done += 1
