"""Parents of a tree whose costs float32 does not tell apart.

Where a step costs less than the rounding of the way behind it, a cell may cost what its parent does, and parents
that follow from costs alone could lead in a circle. So they are found from the root outward, over steps that cost
exactly what their cells differ by. Every cell with a way has such steps all the way to the root: its cost is what
one neighbour offered it, which cost less, or as much and was served before it.

Arrays, beside those of `layout` and `climbs`:
    queue  uint32  (size,)  padded cells that have their parents, in the order in which they got them
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.climbs import CLIMBS, offered
from planner_service.kernels.compile import step_kernel
from planner_service.kernels.layout import GRID, INF, LABELS, NONE, RULE_FOUR, step_length


@step_kernel(f"({GRID}, CLIMBS, {LABELS}, u4[::1])", CLIMBS)
def find_parents_from_root(grid, climbs, labels, queue):
    """parent, written whole, of exact costs to a padded root."""
    cell_cost, offsets, _, rule, corners = grid
    cost, parent, root = labels
    for i in range(parent.size):
        parent[i] = NONE
    every = 2 if rule == RULE_FOUR else 1
    queue[0] = root
    first, last = 0, 1
    while first < last:
        u = np.int64(queue[first])
        first += 1
        for k in range(0, 8, every):
            v = u + offsets[k]
            if parent[v] != NONE or v == root or not cost[v] < INF:
                continue
            odd = k & 1
            if (
                odd
                and not corners
                and max(cell_cost[u + offsets[k - 1]], cell_cost[u + offsets[(k + 1) & 7]]) == INF
            ):
                continue
            if offered(cost[u], cell_cost[u], climbs, v, u, odd, step_length(rule, odd)) == cost[v]:
                parent[v] = (k + 4) & 7
                queue[last] = v
                last += 1
