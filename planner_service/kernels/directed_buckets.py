"""Exact growth where a step also costs by what it climbs, with a bucket queue (Dial 1969).

Neighbours of a cell are offered different keys, so that a cell's first offer is not its least, as it is in
`bucket_queue`. But a bucket is narrower than the cheapest step: once it is served, no cell in it is offered less.
So a cell waits under its own cost, once for each time that it fell, and is served the first time that its turn
comes. Parents follow from the costs.

Arrays, beside those of `layout` and `climbs`:
    touched  uint32  (8 * _PIECE + 1,) padded cells whose cost has fallen
    chosen   int32   (8 * _PIECE + 1,) their buckets
    batch    uint32  (8 * size + _AHEAD,) padded cells of the bucket that is being served
    steps    float32, int32 (8 * _PIECE,)  of the steps into a piece's cells, a row for each direction: rise, m;
                                           entry of `prices`
    queue    as of `chunked_buckets`

While growing, the cost of a cell that was served is negative, so that no offer lowers it, and WALL on lethal cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.chunked_buckets import QUEUE, Queue, empty, make_queue, put, take
from planner_service.kernels.climbs import CLIMBS, find_entries
from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.layout import BUCKETS, GRID, INF, RULE_FOUR, TOO_FINE, WALL
from planner_service.kernels.prefetch import prefetch

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_TWO, _THREE, _FOUR, _FIVE, _SIX, _SEVEN = (np.uint64(n) for n in range(2, 8))
_ZERO32 = np.float32(0.0)
_AHEAD = 8
"""Cells of a batch between asking for one's memory and using it."""
_PIECE = np.uint64(1 << 6)
"""Cells that make their offers before what these touched is put into the queue."""
WIDTH = 0.9
"""Of a bucket, in cheapest steps. A cell in a bucket that is being served must not be offered less by another,
whatever the rounding: of the sum, of the product that finds the bucket, and of its factor, each at most 2^-24
of the cost. Up to `_MOST_BUCKETS` that is a tenth of a bucket."""
_MOST_BUCKETS = 1 << 19
_SCRATCH = f"Tuple((u4[::1], i4[::1], u4[::1], Tuple((f4[::1], i4[::1])), {QUEUE}))"

Steps = tuple[NDArray[np.float32], NDArray[np.int32]]
Scratch = tuple[NDArray[np.uint32], NDArray[np.int32], NDArray[np.uint32], Steps, Queue]


def make_scratch(size: int, buckets: int) -> Scratch:
    """(touched, chosen, batch, steps, queue) for a growth over `size` padded cells, for the worst case."""
    room = 8 * int(_PIECE) + 8
    batch = np.empty(8 * size + _AHEAD, np.uint32)
    steps = np.empty(room, np.float32), np.empty(room, np.int32)
    return np.empty(room, np.uint32), np.empty(room, np.int32), batch, steps, make_queue(8 * size, buckets)


@helper
def _serve_once(cost, batch, n):
    """Keep those cells of a batch that were not served yet, and mark them. Returns how many."""
    kept = _ZERO
    for p in range(n):
        ahead = np.uint64(batch[p + np.uint64(_AHEAD)])
        prefetch(cost, ahead)
        u = np.uint64(batch[p])
        c = cost[u]
        batch[kept] = u
        kept += np.uint64(c >= _ZERO32)
        cost[u] = -abs(c)
    return kept


@helper
def _find_rises(height, s, straight_only, batch, first, n, rises):
    """rises := m, of the steps into `n` cells of a batch from their neighbours, direction by direction."""
    for i in range(n):
        ahead = np.uint64(batch[first + i + np.uint64(_AHEAD)])
        prefetch(height, ahead - s)
        prefetch(height, ahead)
        prefetch(height, ahead + s)
        u = np.uint64(batch[first + i])
        own = height[u]
        rises[i] = own - height[u - s]
        rises[n + i] = own - height[u - _ONE]
        rises[n * _TWO + i] = own - height[u + _ONE]
        rises[n * _THREE + i] = own - height[u + s]
        if straight_only:
            continue
        rises[n * _FOUR + i] = own - height[u - s - _ONE]
        rises[n * _FIVE + i] = own - height[u - s + _ONE]
        rises[n * _SIX + i] = own - height[u + s - _ONE]
        rises[n * _SEVEN + i] = own - height[u + s + _ONE]


@helper
def _offer(cell_cost, cost, climbs, s, straight_only, corners, batch, first, n, steps, touched):
    """Offer the neighbours of `n` cells what a step into them costs. Writes those whose cost has fallen to
    `touched`; returns how many times."""
    count = _ZERO
    height, prices = climbs[0], climbs[1]
    rises, entries = steps
    _find_rises(height, s, straight_only, batch, first, n, rises)
    find_entries(rises, _ZERO, n * _FOUR, climbs, 0, entries)
    if not straight_only:
        find_entries(rises, n * _FOUR, n * _FOUR, climbs, 1, entries)
    for i in range(n):
        u = np.uint64(batch[first + i])
        ahead = np.uint64(batch[first + i + np.uint64(_AHEAD)])
        prefetch(cell_cost, ahead)
        prefetch(cost, ahead - s)
        prefetch(cost, ahead)
        prefetch(cost, ahead + s)
        base = -cost[u]
        own = cell_cost[u]
        above = u - s
        below = u + s
        north, west, east, south = cost[above], cost[u - _ONE], cost[u + _ONE], cost[below]
        for k, v, old in (
            (_ZERO, above, north),
            (_ONE, u - _ONE, west),
            (_TWO, u + _ONE, east),
            (_THREE, below, south),
        ):
            key = base + own * prices[np.uint64(entries[n * k + i])]
            cost[v] = min(old, key)
            touched[count] = v
            count += np.uint64(key < old)
        if straight_only:
            continue
        for k, v, shut in (
            (_FOUR, above - _ONE, min(north, west)),
            (_FIVE, above + _ONE, min(north, east)),
            (_SIX, below - _ONE, min(south, west)),
            (_SEVEN, below + _ONE, min(south, east)),
        ):
            old = cost[v]
            key = base + own * prices[np.uint64(entries[n * k + i])]
            key = key if corners or shut > WALL else INF
            cost[v] = min(old, key)
            touched[count] = v
            count += np.uint64(key < old)
    return count


@helper
def _choose(cost, inverse, least, cells, count, buckets):
    """buckets := which one each cell's cost falls into, `least` at least."""
    for i in range(count):
        v = np.uint64(cells[i])
        buckets[i] = max(np.int32(cost[v] * inverse), least)


@kernel(f"({GRID}, f4[::1], i8, {CLIMBS}, {BUCKETS}, {_SCRATCH})")
def grow_directed_by_buckets(grid, cost, root, climbs, buckets, scratch):
    """Costs to `root`, a padded, passable cell. `cost` is written whole.

    buckets  width: at most `WIDTH` lowest cell costs, s. count: of the circular queue, a power of two;
             count * width exceeds the dearest step by two widths
    scratch  as `make_scratch` returns it
    Returns the last bucket: no cost exceeds (last + 1) * width; or TOO_FINE.
    """
    cell_cost, _, stride, rule, corners = grid
    touched, chosen, batch, steps, queue = scratch
    width, circle = buckets
    empty(queue, circle)
    head, tail = queue[3], queue[4]
    s = np.uint64(stride)
    mask = np.uint64(circle) - _ONE
    inverse = np.float32(1.0 / width)
    for i in range(cell_cost.size):
        cost[i] = INF if cell_cost[i] < INF else WALL
    cost[np.uint64(root)] = _ZERO32
    current = np.int32(0)
    batch[0] = root
    n = _ONE
    waiting = _ZERO
    while True:
        n = _serve_once(cost, batch, n)
        first = _ZERO
        while first < n:
            some = min(_PIECE, n - first)
            count = _offer(
                cell_cost, cost, climbs, s, rule == RULE_FOUR, corners, batch, first, some, steps, touched
            )
            _choose(cost, inverse, np.int32(current + 1), touched, count, chosen)
            put(queue, touched, count, chosen, mask, _ZERO)
            waiting += count
            first += some
        if waiting == _ZERO:
            break
        if current > _MOST_BUCKETS:
            return TOO_FINE
        current = np.int32(current + 1)
        b = np.uint64(current) & mask
        while head[b] == tail[b]:
            current = np.int32(current + 1)
            b = np.uint64(current) & mask
        n = take(queue, b, batch)
        waiting -= n
    for i in range(cost.size):
        cost[i] = abs(cost[i])
    return current
