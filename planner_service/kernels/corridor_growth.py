"""Which cells carry the traffic, and new costs spreading over them only.

`mark_levels` counts how many shortest paths pass each cell of a tree. `grow_corridors` is a label-correcting search
(Dijkstra's with a binary heap, cells being re-entered when they get cheaper; E. W. Dijkstra 1959, D. P. Bertsekas
1993) over the cells so marked. It needs an order by cost that may fall back: a cell's cost is first recomputed
along its parents, and may turn out to be less than what was served last, which bucket queues rule
out.

Arrays, beside those of `layout`:
    level  uint8  (size,)  traffic of each cell; 0 for none, 1 from `least` paths on, one more for each four times
                           that
    stamp  uint8  (size,)  whether a cost has been recomputed: `now` or `now + 1` if it has, less if not; `now + 1`
                           on cells that were offered a cost by this growth
    trail  uint32 (size,)  the cells of a way
    heap   (keys, items)   float32, int64: a binary heap of costs (s) and padded cells
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, offered
from planner_service.kernels.compile import helper, kernel, step_kernel
from planner_service.kernels.layout import BOX, GRID, INF, LABELS, NONE, RULE_FOUR, check_cells, step_length

Heap = tuple[NDArray[np.float32], NDArray[np.int64]]


@helper
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


@helper
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


@kernel("(u1[::1], i8[::1], i8, u1[::1], u1[::1], u4[::1])")
def mark_levels(parent, offsets, least, level, children, traffic):
    """Raise `level` to 1 where the paths of `least` cells pass in a tree given by its parents, to 2 where those of
    4 * least do, and so on. What drains an area four times as large is twice as far from its like. `children` and
    `traffic` have room for all cells."""
    for i in range(parent.size):
        children[i] = 0
        traffic[i] = 1
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


@helper
def _tighten(cell_cost, climbs, cost, parent, stamp, now, offsets, rule, v, trail):
    """As `tighten`, for one padded cell. Returns cells visited."""
    many = 0
    while stamp[v] < now and parent[v] != NONE:
        trail[many] = v
        many += 1
        v += offsets[parent[v]]
    if stamp[v] < now:  # no way leads from here
        return 0
    for j in range(many - 1, -1, -1):
        v = np.int64(trail[j])
        k = parent[v]
        u = v + offsets[k]
        odd = np.int64(k & 1)
        driven = offered(cost[u], cell_cost[u], climbs, v, u, odd, step_length(rule, odd))
        cost[v] = min(cost[v], driven)
        stamp[v] = now
    return many


@step_kernel(f"({GRID}, CLIMBS, {LABELS}, u1[::1], i8, i8[::1], u4[::1])", CLIMBS)
def tighten(grid, climbs, labels, stamp, now, cells, trail):
    """Lower costs, which are upper bounds, to what is driven along the parents, less the tree's offset: of `cells`
    (int64, padded) and of all on their ways to the root.

    They stay at least what the parent offers. Cells whose stamp is `now` or more are taken to be right, and those
    that become so are stamped `now`. Returns cells visited. Raises ValueError where one is no padded cell.
    """
    check_cells(cells, stamp.size)
    cell_cost, offsets, _, rule, _ = grid
    cost, parent, root = labels
    visited = 0
    stamp[root] = now
    for i in range(cells.size):
        visited += _tighten(cell_cost, climbs, cost, parent, stamp, now, offsets, rule, cells[i], trail)
    return visited


def make_heap(box: tuple[int, int, int, int]) -> Heap:
    """An empty heap, for a growth around a window."""
    row0, col0, row1, col1 = box
    room = 4096 + 4 * (row1 - row0 + col1 - col0)
    return np.empty(room, np.float32), np.empty(room, np.int64)


def larger_heap(heap: Heap) -> Heap:
    """The same heap with twice the room."""
    keys, items = heap
    return np.concatenate((keys, np.empty_like(keys))), np.concatenate((items, np.empty_like(items)))


@step_kernel(
    f"({GRID}, CLIMBS, {LABELS}, u1[::1], u1[::1], i8, {BOX}, i8, Tuple((f4[::1], i8[::1])), i8, u4[::1])", CLIMBS
)
def grow_corridors(grid, climbs, labels, level, stamp, now, box, inner, heap, waiting, trail):
    """Let the costs on the rim of a window around the root spread outward over the cells that carry the traffic.

    box    the window, whose costs are new
    inner  cells: level 1 or more takes part up to so far from the root, level 2 or more up to twice as far, level 3
           up to four times, ...
    waiting  -1 to begin; to go on, how many wait in the heap
    A cell is tightened before it is offered anything: an old way from far off is often better than its cost says,
    and than the way through the corridors. Only what gets cheaper is rewritten, with its parent, so that costs stay
    upper bounds and grow strictly along every way. Returns (cells visited, how many wait in the heap): where any
    do, it has no room for more, and a larger one that begins as it does is to be handed in to go on.
    """
    cell_cost, offsets, stride, rule, corners = grid
    cost, parent, root = labels
    keys, items = heap
    size = _fill_from_rim(cost, stride, box, keys, items) if waiting < 0 else waiting
    root_row = root // stride
    root_col = root % stride
    stamp[root] = now
    visited = 0
    while size > 0 and size + 16 <= keys.size:
        key = keys[0]
        u = items[0]
        size -= 1
        _heap_pop(keys, items, size)
        if key > cost[u]:
            continue
        visited += 1
        away = max(abs(u // stride - root_row), abs(u % stride - root_col))
        least = 1
        while away > inner:
            away >>= 1
            least += 1
        for k in range(0, 8, 2 if rule == RULE_FOUR else 1):
            v = u + offsets[k]
            odd = k & 1
            offer = offered(key, cell_cost[u], climbs, v, u, odd, step_length(rule, odd))
            if (
                not offer < INF
                or level[v] < least
                or not cell_cost[v] < INF
                or not (stamp[v] <= now or offer < cost[v])
            ):
                continue
            shut = max(cell_cost[u + offsets[k - 1]], cell_cost[u + offsets[(k + 1) & 7]]) == INF
            if odd and not corners and shut:
                continue
            if stamp[v] < now:
                visited += _tighten(cell_cost, climbs, cost, parent, stamp, now, offsets, rule, v, trail)
            stamp[v] = now + 1
            if offer < cost[v]:
                cost[v] = offer
                parent[v] = (k + 4) & 7
            _heap_push(keys, items, size, cost[v], v)
            size += 1
    return visited, size


@helper
def _fill_from_rim(cost, stride, box, keys, items):
    """Begin a heap with the cells on the border of a window that have a way. Returns how many."""
    row0, col0, row1, col1 = box
    size = np.int64(0)  # a literal would have `_heap_push` compiled twice
    for row in range(row0, row1):
        across = 1 if row == row0 or row == row1 - 1 else max(1, col1 - col0 - 1)
        for col in range(col0, col1, across):
            v = (row + 1) * stride + col + 1
            if cost[v] < INF:
                _heap_push(keys, items, size, cost[v], v)
                size += 1
    return size
