"""Kernels of the skeleton and the rings: which cells carry the traffic, and new costs spreading along them.

Arrays are laid out as `rules` says.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import INF, NONE, RULE_FOUR, RULE_OCTILE, SQRT2


@njit
def _longer(array, count, size):
    """Room for `size` elements, the first `count` copied. By a loop: assigning to a slice would bring along what
    numba needs for the text of its error, which takes longer to compile than any kernel here."""
    longer = np.empty(size, array.dtype)
    for i in range(count):
        longer[i] = array[i]
    return longer


@njit
def _sink(keys, items, size):
    """Restore a binary heap after its last element, keys[size], was taken from the end to replace the top."""
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
def _rise(keys, items, size, key, item):
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
def step_offsets(stride):
    """What each direction code 0..7 adds to a padded cell index."""
    return np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))


@njit
def mark_levels(parent, stride, least, level):
    """Raise `level` (uint8) to 1 where the ways of `least` cells pass in a tree given by its parents, to 2 where
    those of 4 * least do, and so on. What drains an area four times as large is twice as far from its like."""
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
def _tighten(weight, cost, parent, stamp, now, offsets, rule, v, trail):
    """As `tighten`, for one cell. Returns (cells visited, the trail, which may have grown)."""
    many = 0
    while stamp[v] < now and parent[v] != NONE:
        if many == trail.size:
            trail = _longer(trail, many, 2 * many)
        trail[many] = v
        many += 1
        v += offsets[parent[v]]
    if stamp[v] < now:  # no way leads from here
        return 0, trail
    for j in range(many - 1, -1, -1):
        v = trail[j]
        k = parent[v]
        u = v + offsets[k]
        driven = cost[u] + (weight[u] * SQRT2 if rule == RULE_OCTILE and k & 1 else weight[u])
        cost[v] = min(cost[v], driven)
        stamp[v] = now
    return many, trail


@njit
def tighten(weight, cost, parent, stamp, now, stride, rule, root, cells):
    """cost := what is driven along the parents, less the tree's offset, on the ways from `cells` to the root.

    stamp  uint8  `now` or one more on cells that are known to be right, and on those that become so; less elsewhere
    Costs only fall, and stay at least what the parent offers. Returns cells visited.
    """
    offsets = step_offsets(stride)
    trail = np.empty(1024, np.int64)
    visited = 0
    stamp[root] = now
    for i in range(cells.size):
        many, trail = _tighten(weight, cost, parent, stamp, now, offsets, rule, cells[i], trail)
        visited += many
    return visited


@njit
def spread(weight, cost, parent, stamp, now, level, stride, rule, corners, root, box, inner):
    """Let the costs on the rim of a window around the root spread outward over the cells that carry the traffic.

    level  uint8  which cells take part: of level 1 or more up to `inner` cells from the root, of 2 or more up to
                  twice as far, of 3 up to four times, ...
    box    (row0, col0, row1, col1) of the window, whose costs are new
    stamp, now  as in `tighten`, which a cell is before it is offered anything: an old way from far off is often
                better than its cost says, and than the way over the skeleton. One more than `now` where it was
    Only what gets cheaper is rewritten, with its parent, so that costs stay upper bounds and grow strictly along
    every way. Returns cells visited.
    """
    offsets = step_offsets(stride)
    row0, col0, row1, col1 = box
    capacity = 4096 + 4 * (row1 - row0 + col1 - col0)
    keys = np.empty(capacity, np.float32)
    items = np.empty(capacity, np.int64)
    size = 0
    for row in range(row0, row1):
        across = 1 if row == row0 or row == row1 - 1 else max(1, col1 - col0 - 1)
        for col in range(col0, col1, across):
            v = (row + 1) * stride + col + 1
            if cost[v] < INF:
                _rise(keys, items, size, cost[v], v)
                size += 1
    root_row = root // stride
    root_col = root % stride
    trail = np.empty(1024, np.int64)
    stamp[root] = now
    visited = 0
    while size > 0:
        key = keys[0]
        u = items[0]
        size -= 1
        _sink(keys, items, size)
        if key > cost[u]:
            continue
        visited += 1
        if size + 16 > capacity:
            capacity *= 2
            keys = _longer(keys, size, capacity)
            items = _longer(items, size, capacity)
        away = max(abs(u // stride - root_row), abs(u % stride - root_col))
        ring = 1
        while away > inner:
            away >>= 1
            ring += 1
        straight = key + weight[u]
        diagonal = key + (weight[u] * SQRT2 if rule == RULE_OCTILE else weight[u])
        for k in range(0, 8, 2 if rule == RULE_FOUR else 1):
            v = u + offsets[k]
            offer = diagonal if k & 1 else straight
            if level[v] < ring or not weight[v] < INF or not (stamp[v] <= now or offer < cost[v]):
                continue
            shut = max(weight[u + offsets[k - 1]], weight[u + offsets[(k + 1) & 7]]) == INF
            if k & 1 and not corners and shut:
                continue
            if stamp[v] < now:
                many, trail = _tighten(weight, cost, parent, stamp, now, offsets, rule, v, trail)
                visited += many
            stamp[v] = now + 1
            if offer < cost[v]:
                cost[v] = offer
                parent[v] = (k + 4) & 7
            _rise(keys, items, size, cost[v], v)
            size += 1
    return visited
