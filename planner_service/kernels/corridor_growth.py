"""Which cells carry the traffic, and new costs spreading over them only.

`mark_levels` counts how many shortest paths pass each cell of a tree. `grow_corridors` is a label-correcting search
(Dijkstra's with a binary heap, cells being re-entered when they get cheaper; E. W. Dijkstra 1959, D. P. Bertsekas
1993) over the cells so marked. It needs an order by cost that may fall back: a cell's cost is first recomputed
along its parents, and may turn out to be less than what was served last, which bucket queues and radix heaps rule
out.

Arrays, beside those of `layout`:
    level  uint8  (size,)  traffic of each cell; 0 for none, 1 from `least` paths on, one more for each four times
                           that
    stamp  uint8  (size,)  whether a cost has been recomputed: `now` or `now + 1` if it has, less if not; `now + 1`
                           on cells that were offered a cost by this growth
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import (
    INF,
    NONE,
    RULE_FOUR,
    RULE_OCTILE,
    SQRT2,
    check_cells,
    enlarged,
    step_offsets,
)


@njit
def _heap_pop(keys, items, size):
    """Restore a binary heap of `size` elements after its top was read: keys[size] takes its place and sinks."""
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
        hole = child
    keys[hole] = key
    items[hole] = item


@njit
def _heap_push(keys, items, size, key, item):
    hole = size
    while hole > 0:
        above = (hole - 1) >> 1
        if keys[above] <= key:
            break
        keys[hole] = keys[above]
        items[hole] = items[above]
        hole = above
    keys[hole] = key
    items[hole] = item


@njit
def mark_levels(parent, stride, least, level):
    """Raise `level` to 1 where the paths of `least` cells pass in a tree given by its parents, to 2 where those of
    4 * least do, and so on. What drains an area four times as large is twice as far from its like."""
    offsets = step_offsets(stride)
    children = np.zeros(parent.size, np.uint8)
    traffic = np.ones(parent.size, np.uint32)
    for i in range(parent.size):
        if parent[i] != NONE:
            children[i + offsets[parent[i]]] += 1
    for i in range(parent.size):
        v = i
        # A cell is done once all its children are; then it hands on what passes through it.
        while parent[v] != NONE and children[v] == 0:
            children[v] = NONE
            rest = np.int64(traffic[v])
            found = 0
            while rest >= least:
                found += 1
                rest >>= 2
            if found > level[v]:
                level[v] = found
            u = v + offsets[parent[v]]
            traffic[u] += traffic[v]
            children[u] -= 1
            v = u


@njit
def _tighten(cell_cost, cost, parent, stamp, now, offsets, rule, v, trail):
    """As `tighten`, for one padded cell. Returns (cells visited, the trail, which may have been enlarged)."""
    many = 0
    while stamp[v] < now and parent[v] != NONE:
        if many == trail.size:
            trail = enlarged(trail, many, 2 * many)
        trail[many] = v
        many += 1
        v += offsets[parent[v]]
    if stamp[v] < now:  # no way leads from here
        return 0, trail
    for j in range(many - 1, -1, -1):
        v = trail[j]
        k = parent[v]
        u = v + offsets[k]
        driven = cost[u] + (cell_cost[u] * SQRT2 if rule == RULE_OCTILE and k & 1 else cell_cost[u])
        cost[v] = min(cost[v], driven)
        stamp[v] = now
    return many, trail


@njit
def tighten(cell_cost, stride, rule, labels, stamp, now, cells):
    """Lower costs, which are upper bounds, to what is driven along the parents, less the tree's offset: of `cells`
    (int64, padded) and of all on their ways to the root.

    They stay at least what the parent offers. Cells whose stamp is `now` or more are taken to be right, and those
    that become so are stamped `now`. Returns cells visited. Raises ValueError where one is no padded cell.
    """
    check_cells(cells, stamp.size)
    cost, parent, root = labels
    offsets = step_offsets(stride)
    trail = np.empty(1024, np.int64)
    visited = 0
    stamp[root] = now
    for i in range(cells.size):
        many, trail = _tighten(cell_cost, cost, parent, stamp, now, offsets, rule, cells[i], trail)
        visited += many
    return visited


@njit
def grow_corridors(grid, labels, level, stamp, now, box, inner):
    """Let the costs on the rim of a window around the root spread outward over the cells that carry the traffic.

    box    the window, whose costs are new
    inner  cells: level 1 or more takes part up to so far from the root, level 2 or more up to twice as far, level 3
           up to four times, ...
    A cell is tightened before it is offered anything: an old way from far off is often better than its cost says,
    and than the way through the corridors. Only what gets cheaper is rewritten, with its parent, so that costs stay
    upper bounds and grow strictly along every way. Returns cells visited.
    """
    cell_cost, stride, rule, corners = grid
    cost, parent, root = labels
    offsets = step_offsets(stride)
    keys, items, size = _rim_heap(cost, stride, box)
    root_row = root // stride
    root_col = root % stride
    trail = np.empty(1024, np.int64)
    stamp[root] = now
    visited = 0
    while size > 0:
        key = keys[0]
        u = items[0]
        size -= 1
        _heap_pop(keys, items, size)
        if key > cost[u]:
            continue
        visited += 1
        if size + 16 > keys.size:
            keys, items = enlarged(keys, size, 2 * keys.size), enlarged(items, size, 2 * keys.size)
        away = max(abs(u // stride - root_row), abs(u % stride - root_col))
        least = 1
        while away > inner:
            away >>= 1
            least += 1
        straight = key + cell_cost[u]
        diagonal = key + (cell_cost[u] * SQRT2 if rule == RULE_OCTILE else cell_cost[u])
        for k in range(0, 8, 2 if rule == RULE_FOUR else 1):
            v = u + offsets[k]
            offer = diagonal if k & 1 else straight
            if level[v] < least or not cell_cost[v] < INF or not (stamp[v] <= now or offer < cost[v]):
                continue
            shut = max(cell_cost[u + offsets[k - 1]], cell_cost[u + offsets[(k + 1) & 7]]) == INF
            if k & 1 and not corners and shut:
                continue
            if stamp[v] < now:
                many, trail = _tighten(cell_cost, cost, parent, stamp, now, offsets, rule, v, trail)
                visited += many
            stamp[v] = now + 1
            if offer < cost[v]:
                cost[v] = offer
                parent[v] = (k + 4) & 7
            _heap_push(keys, items, size, cost[v], v)
            size += 1
    return visited


@njit
def _rim_heap(cost, stride, box):
    """A heap of the cells on the border of a window that have a way: keys (float32), items (int64), how many."""
    row0, col0, row1, col1 = box
    capacity = 4096 + 4 * (row1 - row0 + col1 - col0)
    keys = np.empty(capacity, np.float32)
    items = np.empty(capacity, np.int64)
    size = np.int64(0)  # a literal would have `_heap_push` compiled twice
    for row in range(row0, row1):
        across = 1 if row == row0 or row == row1 - 1 else max(1, col1 - col0 - 1)
        for col in range(col0, col1, across):
            v = (row + 1) * stride + col + 1
            if cost[v] < INF:
                _heap_push(keys, items, size, cost[v], v)
                size += 1
    return keys, items, size
