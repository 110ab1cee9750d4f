"""A binary heap whose items know their place in it, so that a key can be lowered: it needs room for each item once.

keys   float32  the lowest first
items  int64    indices into `place`
place  int32    where each item is in the heap; -1 where it is not
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.decorators import helper, kernel
from planner_service.kernels.layout import INF


@helper
def heap_pop(keys, items, place, size):
    """Removes the first of `size` elements."""
    place[items[0]] = -1
    size -= 1
    if size == 0:
        return
    key = keys[size]
    item = items[size]
    hole = 0
    while True:
        child = 2 * hole + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[hole] = keys[child]
        items[hole] = items[child]
        place[items[hole]] = hole
        hole = child
    keys[hole] = key
    items[hole] = item
    place[item] = hole


@helper
def heap_lower(keys, items, place, size, key, item):
    """Gives an item a lower key; one that is not in the heap of `size` elements comes in. Returns its size."""
    hole = place[item]
    if hole < 0:
        hole = size
        size += 1
    while hole > 0:
        above = (hole - 1) >> 1
        if keys[above] <= key:
            break
        keys[hole] = keys[above]
        items[hole] = items[above]
        place[items[hole]] = hole
        hole = above
    keys[hole] = key
    items[hole] = item
    place[item] = hole
    return size


@kernel("void(f4[::1], i8[::1], f8, i8, f4[::1], Tuple((f4[::1], i8[::1], i4[::1])))")
def arrivals(cell_cost, offsets, diagonal, start, cost, heap):
    """Writes how soon something that begins on a cell can be on each other one, by Dijkstra's algorithm.

    cell_cost  float32 (n,), padded; inf is lethal, and the border
    cost       float32 (n,), written, from the start to each cell; inf where there is no path
    heap       (keys, items, place), each (n,); place is -1 everywhere
    Trees lead to their root: a step is priced by the cell that it enters on the way there. A path away from a cell
    pays for the cells entered on the way out, which no tree knows. Corners of lethal cells are cut: nothing comes
    sooner than this.
    """
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
