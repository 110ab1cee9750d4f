"""How soon something that begins on a cell can be on each other one, by Dijkstra's algorithm with a binary heap.

The trees of this package lead to their root: a step is priced by the cell that it enters on the way there. Whoever
drives away from a cell pays for those that he enters on the way out, which no tree knows. Arrays:
    cell_cost  float32  (n,)  padded; inf is lethal, and the border
    offsets    int64    (8,)  of `layout.step_offsets`
    cost       float32  (n,)  as `cell_cost`, from the start to each cell; inf where there is no way
    heap       (keys float32, items int64, place int32), each (n,), as `heap`; place is -1 everywhere
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import kernel
from planner_service.kernels.heap import heap_lower, heap_pop
from planner_service.kernels.layout import INF


@kernel("void(f4[::1], i8[::1], f8, i8, f4[::1], Tuple((f4[::1], i8[::1], i4[::1])))")
def arrivals(cell_cost, offsets, diagonal, start, cost, heap):
    """Write `cost`. Corners of lethal cells are cut: nothing comes sooner than this."""
    keys, items, place = heap
    for i in range(cost.size):
        cost[i] = INF
    cost[start] = np.float32(0.0)
    size = heap_lower(keys, items, place, 0, cost[start], start)
    while size:
        u, at = items[0], np.float64(cost[items[0]])
        heap_pop(keys, items, place, size)
        size -= 1
        for k in range(8):
            v = u + offsets[k]
            if cell_cost[v] == INF:
                continue
            offered = np.float32(at + np.float64(cell_cost[v]) * (diagonal if k & 1 else 1.0))
            if offered < cost[v]:
                cost[v] = offered
                size = heap_lower(keys, items, place, size, offered, v)
