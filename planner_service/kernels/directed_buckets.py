"""Exact growth where a step also costs by what it climbs, with a bucket queue (Dial 1969).

Neighbours of a cell are offered different keys, so that a cell's first offer is not its least, as it is in
`bucket_queue`. But a bucket is narrower than the cheapest step: once it is served, no cell in it is offered less.
So a cell waits under its own cost, once for each time that it fell, and is served the first time that its turn
comes. Parents follow from the costs.

Arrays, beside those of `layout` and `climbs`:
    touched  uint32  (8 * _PIECE + 1,) padded cells whose cost has fallen
    chosen   int32   (8 * _PIECE + 1,) their buckets
    batch    uint32  (8 * size + _AHEAD,) padded cells of the bucket that is being served
    queue    as of `chunked_buckets`

While growing, the cost of a cell that was served is negative, so that no offer lowers it, and WALL on lethal cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.chunked_buckets import QUEUE, Queue, empty, make_queue, put, take
from planner_service.kernels.climbs import CLIMBS, step_price
from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.layout import BUCKETS, GRID, INF, RULE_FOUR, TOO_FINE, WALL
from planner_service.kernels.prefetch import prefetch

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_ZERO32 = np.float32(0.0)
_AHEAD = 8
"""Cells of a batch between asking for one's memory and using it."""
_PIECE = np.uint64(1 << 10)
"""Cells that make their offers before what these touched is put into the queue."""
WIDTH = 0.9
"""Of a bucket, in cheapest steps. A cell of a bucket that is being served must not be offered less by another of
it, whatever the rounding: of the sum, of the product that finds the bucket, and of its factor, each at most 2^-24
of the cost. Up to `_MOST_BUCKETS` that is a tenth of a bucket."""
_MOST_BUCKETS = 1 << 19
_SCRATCH = f"Tuple((u4[::1], i4[::1], u4[::1], {QUEUE}))"

Scratch = tuple[NDArray[np.uint32], NDArray[np.int32], NDArray[np.uint32], Queue]


def make_scratch(size: int, buckets: int) -> Scratch:
    """(touched, chosen, batch, queue) for a growth over `size` padded cells, for the worst case."""
    room = 8 * int(_PIECE) + 8
    batch = np.empty(8 * size + _AHEAD, np.uint32)
    return np.empty(room, np.uint32), np.empty(room, np.int32), batch, make_queue(8 * size, buckets)


@helper
def _serve_once(cost, batch, n):
    """Keep those cells of a batch that were not served yet, and mark them. Returns how many."""
    kept = _ZERO
    for p in range(n):
        prefetch(cost, np.uint64(batch[p + np.uint64(_AHEAD)]))
        u = np.uint64(batch[p])
        c = cost[u]
        batch[kept] = u
        kept += np.uint64(c >= _ZERO32)
        cost[u] = -abs(c)
    return kept


@helper
def _ask_for(cell_cost, cost, height, s, u):
    prefetch(cell_cost, u)
    prefetch(cost, u - s)
    prefetch(cost, u + s)
    prefetch(height, u - s)
    prefetch(height, u)
    prefetch(height, u + s)


@helper
def _offer(cell_cost, cost, climbs, s, straight_only, corners, batch, first, last, touched):
    """Offer each cell's neighbours what a step into it costs. Writes those whose cost has fallen to `touched`;
    returns how many times."""
    count = _ZERO
    height = climbs[0]
    for p in range(first, last):
        _ask_for(cell_cost, cost, height, s, np.uint64(batch[p + np.uint64(_AHEAD)]))
        u = np.uint64(batch[p])
        base = -cost[u]
        own = cell_cost[u]
        above = u - s
        below = u + s
        north, west, east, south = cost[above], cost[u - _ONE], cost[u + _ONE], cost[below]
        for v, old in ((above, north), (u - _ONE, west), (u + _ONE, east), (below, south)):
            key = base + own * step_price(climbs, v, u, 0)
            cost[v] = min(old, key)
            touched[count] = v
            count += np.uint64(key < old)
        if straight_only:
            continue
        for v, shut in (
            (above - _ONE, min(north, west)),
            (above + _ONE, min(north, east)),
            (below - _ONE, min(south, west)),
            (below + _ONE, min(south, east)),
        ):
            old = cost[v]
            key = base + own * step_price(climbs, v, u, 1)
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
    touched, chosen, batch, queue = scratch
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
            last = min(first + _PIECE, n)
            count = _offer(cell_cost, cost, climbs, s, rule == RULE_FOUR, corners, batch, first, last, touched)
            _choose(cost, inverse, np.int32(current + 1), touched, count, chosen)
            put(queue, touched, count, chosen, mask, _ZERO)
            waiting += count
            first = last
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
