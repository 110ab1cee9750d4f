"""Exact growth over cell costs of any ratio, and where a step also costs by what it climbs, with buckets of several
levels (E. V. Denardo, B. L. Fox, "Shortest-route methods: 1. Reaching, pruning, and buckets", Operations Research
27(1), 1979, 161-186).

Where a step costs by what it climbs, neighbours of a cell are offered different keys, so that a cell's first offer
is not its least, as it is in `dial_growth`. But where no cell of a bucket offers anything that lies in it, all of
them are final. So a cell waits under its own cost, once for each time that it fell, and is served once. Parents
follow from the costs.

A cost's *index* is how many finest widths it has. A cell waits in the bucket of the
first digit, to the base 128, in which its index differs from what is served. Buckets of one level are 128 times as
wide as those of the level below. When the turn of a bucket comes, the least that any of its cells may offer decides
(A. Crauser, K. Mehlhorn, U. Meyer, P. Sanders, "A parallelization of Dijkstra's shortest path algorithm", MFCS
1998, their OUT-criterion): cells that cost no more than that are final. They are served, and the others wait on;
but where many cells may lead into their own bucket, all of it is spread over the level below. Neither expensive
cells nor cheap ones make the others' buckets narrower, and no result rests on a width or on the rounding of sums.

Arrays, beside those of `layout` and `climbs`:
    touched  uint32  (8 * _PIECE + 8,) padded cells whose cost has fallen
    chosen   int32   (8 * _PIECE + 8,) their buckets
    batch    uint32  (8 * size + _AHEAD,) padded cells of the bucket that is being served
    steps    float32, int32 (8 * _PIECE + 8,)  of the steps into a piece's cells, a row for each direction: rise, m;
                                               entry of `prices`
    waiting  uint64  (_LEVELS,)  how many entries wait at each level
    queue    as of `heap_and_buckets`; bucket `digit` of a level is the one numbered _BASE * level + digit

While growing, the cost of a cell that was served is negative, so that no offer lowers it, and WALL on lethal cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, find_entries, is_windy
from planner_service.kernels.decorators import helper, prefetch, step_kernel
from planner_service.kernels.heap_and_buckets import QUEUE, Queue, empty, make_queue, open_costs, put, take
from planner_service.kernels.layout import GRID, INF, RULE_FOUR, WALL, diagonal_length

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_TWO, _THREE, _FOUR, _FIVE, _SIX, _SEVEN = (np.uint64(n) for n in range(2, 8))
_WAYS = 4, 2, 6, 0, 3, 5, 1, 7
"""Directions of the steps into a cell from its neighbours, in the order in which these are offered something."""
_ZERO32, _ONE32 = np.float32(0.0), np.float32(1.0)
_AHEAD = 8
"""Cells of a batch between asking for one's memory and using it (docs/design/bucket-queues.md)."""
_PIECE = np.uint64(1 << 6)
"""Cells that make their offers before what these touched is put into the queue."""
WIDTH = 0.9
"""Width of a bucket, in cheapest steps. A cell in a bucket that is being served must not be offered less by
another, whatever the rounding: of the sum, of the product that finds the bucket, and of its factor, each at most
2^-24 of the cost. Up to `_SURE` that is a tenth of a bucket."""
_SURE = np.uint64(1 << 19)
"""Bucket up to which the rounding of a cost stays within a tenth of a bucket: 2^19 widths times 3 * 2^-24."""
BASE_BITS = 7
"""Buckets of each level: 2 to the power of this."""
_DIGIT, _BASE = np.uint64(BASE_BITS), np.uint64(1 << BASE_BITS)
_LAST = _BASE - _ONE
_MASK = np.uint64((1 << 32) - 1)
_LEVELS = np.uint64(-(-63 // BASE_BITS))
_NEAR, _MOST_INDEX = np.float32(2.0**30), np.float32(2.0**62)
_FEW, _SHARE = np.uint64(8), np.uint64(5)
"""A bucket is served in parts while this number of its cells may lead into it, and of n cells n >> _SHARE more."""
_ALL = np.float32(-1.0)
"""Less than each cost: no cell of a batch is left out."""
_SCRATCH = f"Tuple((u4[::1], i4[::1], u4[::1], Tuple((f4[::1], i4[::1])), u8[::1], {QUEUE}))"

Steps = tuple[NDArray[np.float32], NDArray[np.int32]]
Scratch = tuple[NDArray[np.uint32], NDArray[np.int32], NDArray[np.uint32], Steps, NDArray[np.uint64], Queue]


def make_scratch(size: int) -> Scratch:
    """(touched, chosen, batch, steps, waiting, queue) for a growth over `size` padded cells, for the worst case."""
    room = 8 * int(_PIECE) + 8
    batch = np.empty(8 * size + _AHEAD, np.uint32)
    steps = np.empty(room, np.float32), np.empty(room, np.int32)
    waiting, queue = np.empty(int(_LEVELS), np.uint64), make_queue(8 * size, int(_LEVELS * _BASE))
    return np.empty(room, np.uint32), np.empty(room, np.int32), batch, steps, waiting, queue


@helper
def _serve_once(cost, batch, n):
    """Keeps those cells of a batch that were not served yet, and mark them. Returns how many."""
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
def _find_steps(climbs, s, straight_only, batch, first, n, steps):
    """Finds the entries of `prices` of the steps into `n` cells of a batch, direction by direction."""
    rises, entries = steps
    _find_rises(climbs[0], s, straight_only, batch, first, n, rises)
    find_entries(rises, _ZERO, n * _FOUR, climbs, 0, entries)
    if not straight_only:
        find_entries(rises, n * _FOUR, n * _FOUR, climbs, 1, entries)
    if is_windy(climbs):
        for k in range(4 if straight_only else 8):
            shift = climbs[3][_WAYS[k]] - climbs[3][k >> 2]
            for i in range(n):
                entries[n * np.uint64(k) + i] += shift


@helper
def _price(climbs, entries, at, length):
    """Cost of a step, in cell costs: its length, or the entry found for it."""
    if climbs is None:
        return length
    return climbs[1][np.uint64(entries[at])]


@helper
def _offer(grid, climbs, cost, batch, first, n, steps, touched):
    """Offer the neighbours of `n` cells what a step into them costs. Writes those whose cost has fallen to
    `touched`; returns how many times."""
    cell_cost, _, stride, rule, corners = grid
    s, straight_only, slant = np.uint64(stride), rule == RULE_FOUR, diagonal_length(rule)
    count = _ZERO
    entries = steps[1]
    if climbs is not None:
        _find_steps(climbs, s, straight_only, batch, first, n, steps)
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
            key = base + own * _price(climbs, entries, n * k + i, _ONE32)
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
            key = base + own * _price(climbs, entries, n * k + i, slant)
            key = key if corners or shut > WALL else INF
            cost[v] = min(old, key)
            touched[count] = v
            count += np.uint64(key < old)
    return count


@helper
def _index(cost, inverse):
    """uint64: how many finest widths a cost has."""
    return np.uint64(np.int64(min(cost * inverse, _MOST_INDEX)))


@helper
def _bucket(at, now, level):
    """uint64: where a cell of index `at` waits, at `level` or above, while `now` is served; both are without the
    digits of the levels below."""
    apart = at ^ now
    while apart > _LAST:
        apart >>= _DIGIT
        at >>= _DIGIT
        level += _ONE
    return (level << _DIGIT) + (at & _LAST)


@helper
def _choose_buckets(cost, inverse, served, level, cells, count, waiting, buckets):
    """buckets := where each cell is to wait: at `level` or above."""
    if level > _ZERO or served >= _SURE:
        shift = level * _DIGIT
        for i in range(count):
            b = _bucket(_index(cost[np.uint64(cells[i])], inverse) >> shift, served >> shift, level)
            waiting[b >> _DIGIT] += _ONE
            buckets[i] = np.int32(b)
        return
    # Nearly all cells wait at the level that is served: a twentieth of the time.
    now, far = np.int32(served), _ZERO
    for i in range(count):
        c = cost[np.uint64(cells[i])]
        at = np.int32(min(c * inverse, _NEAR))
        buckets[i] = at & np.int32(_LAST)
        if at ^ now > np.int32(_LAST):
            b = _bucket(_index(c, inverse), served, _ZERO)
            waiting[b >> _DIGIT] += _ONE
            buckets[i] = np.int32(b)
            far += _ONE
    waiting[0] += count - far


@helper
def _keep_unserved(cell_cost, cost, inverse, end, batch, n):
    """Keeps those cells of a batch that were not served yet. Returns how many; how many of them may offer less than
    index `end`; and the least that any may offer."""
    kept = _ZERO
    within = _ZERO
    least = INF
    for p in range(n):
        ahead = np.uint64(batch[p + np.uint64(_AHEAD)])
        prefetch(cost, ahead)
        prefetch(cell_cost, ahead)
        u = np.uint64(batch[p])
        c = cost[u]
        batch[kept] = u
        if c >= _ZERO32:
            kept += _ONE
            offer = c + cell_cost[u]
            within += np.uint64(_index(offer, inverse) < end)
            least = min(least, offer)
    return kept, within, least


@helper
def _put_back(cost, inverse, served, level, batch, n, least, scratch):
    """Makes those cells of a batch wait, at `level` or above, that cost more than `least`. Returns how many are
    left."""
    touched, chosen, _, _, waiting, queue = scratch
    room = np.uint64(8) * _PIECE
    kept = _ZERO
    count = _ZERO
    for i in range(n):
        u = np.uint64(batch[i])
        batch[kept] = u
        touched[count] = u
        late = cost[u] > least
        count += np.uint64(late)
        kept += np.uint64(not late)
        if count == room:
            _choose_buckets(cost, inverse, served, level, touched, count, waiting, chosen)
            put(queue, touched, count, chosen, _MASK, _ZERO)
            count = _ZERO
    _choose_buckets(cost, inverse, served, level, touched, count, waiting, chosen)
    put(queue, touched, count, chosen, _MASK, _ZERO)
    return kept


@helper
def _serve(grid, climbs, cost, inverse, served, level, n, scratch):
    """Makes the cells of the batch that have not yet make their offers."""
    touched, chosen, batch, steps, waiting, queue = scratch
    n = _serve_once(cost, batch, n)
    first = _ZERO
    while first < n:
        some = min(_PIECE, n - first)
        count = _offer(grid, climbs, cost, batch, first, some, steps, touched)
        _choose_buckets(cost, inverse, served, level, touched, count, waiting, chosen)
        put(queue, touched, count, chosen, _MASK, _ZERO)
        first += some


@helper
def _find_level(waiting):
    level = _ZERO
    while level < _LEVELS and waiting[level] == _ZERO:
        level += _ONE
    return level


@step_kernel(f"({GRID}, CLIMBS, f4[::1], i8, f8, b1, {_SCRATCH})", CLIMBS)
def grow_by_levels(grid, climbs, cost, root, width, may_lead_back, scratch):
    """Costs to `root`, a padded, passable cell. `cost` is written whole.

    width    s, of the finest buckets. Costs are exact whatever it is
    may_lead_back  False: it is at most `WIDTH` lowest cell costs, so that up to `_SURE` no cell of a finest bucket
             leads back into it
    scratch  as `make_scratch` returns it
    """
    cell_cost = grid[0]
    batch, waiting, queue = scratch[2], scratch[4], scratch[5]
    empty(queue, _LEVELS * _BASE)
    head, tail = queue[3], queue[4]
    inverse = np.float32(min(1.0 / width, 1e30))
    open_costs(cell_cost, cost)
    for level in range(_LEVELS):
        waiting[level] = _ZERO
    cost[np.uint64(root)] = _ZERO32
    batch[0] = root
    _serve(grid, climbs, cost, inverse, _ZERO, _ZERO, _ONE, scratch)
    served = _ZERO
    level = _find_level(waiting)
    while level < _LEVELS:
        shift = level * _DIGIT
        now = served >> shift
        b = (level << _DIGIT) + (now & _LAST)
        while head[b] == tail[b]:
            b += _ONE
        served = ((now & ~_LAST) | (b & _LAST)) << shift
        n = take(queue, b, batch)
        waiting[level] -= n
        if may_lead_back or level > _ZERO or served >= _SURE:
            n, within, least = _keep_unserved(cell_cost, cost, inverse, served + (_ONE << shift), batch, n)
            if level > _ZERO and within > _FEW + (n >> _SHARE):
                level -= _ONE
                n = _put_back(cost, inverse, served, level, batch, n, _ALL, scratch)
            elif within > _ZERO:
                n = _put_back(cost, inverse, served, level, batch, n, least, scratch)
        _serve(grid, climbs, cost, inverse, served, level, n, scratch)
        level = _find_level(waiting)
    for i in range(cost.size):
        cost[i] = abs(cost[i])
