"""Exact growth with a bucket queue (R. B. Dial, "Algorithm 360: Shortest-path forest with topological ordering",
Communications of the ACM 12(11), 1969, 632-633), and a breadth-first search to compare it with.

All neighbours of a cell are offered the same exit key per kind of step (see `layout`). Cells leave the queue in the
order of their exit keys, so that the first offer to a cell is its least, and its cost is final at first touch: no
key is ever decreased. Octile steps make two keys per cell, straight and diagonal. Parents follow from the costs.

Arrays, beside those of `layout`:
    touched  uint32  (size + 1,)      padded cells that got their cost from the last bucket
    batch    uint32  (size + _AHEAD,) padded cells of the bucket that is being served
    queue    tuple                    `_make_queue` says

What the loops look like was measured, and small changes cost much: cells are touched without branches, sorted into
buckets in two passes (which bucket, then where in it: in one, each store had the next cell's loads wait), and taken
out of the chunks of their bucket into one row before they make their offers. So the four and eight offers are
written out here, and share no function with the offers of other kernels.

Indices are unsigned 64-bit: signed ones make numba test for negative ones, which blocks vectorisation. A uint64
meets only uint64 here, because with an int64 it would silently become float64. Scratch is allocated for the worst
case; of what is not written, the system keeps no page.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import INF, RULE_OCTILE, RULE_PAPER, SQRT2, TOO_FINE, WALL, step_offsets
from planner_service.kernels.prefetch import prefetch

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_ONE32 = np.float32(1.0)
_ZERO32 = np.float32(0.0)
_CHUNK_BITS = 6
_AHEAD = 8
"""Cells of a batch between asking for one's memory and using it: a fifth of the time at 2048 x 2048."""


@njit
def _open_costs(cell_cost, cost):
    """Before a growth: inf on passable cells, WALL on the others."""
    for i in range(cell_cost.size):
        cost[i] = INF if cell_cost[i] < INF else WALL


@njit
def _close_costs(cost):
    """After a growth: inf on lethal cells too."""
    for i in range(cost.size):
        c = cost[i]
        cost[i] = c if c >= _ZERO32 else INF


@njit
def _make_queue(buckets, items):
    """A queue of cells in `buckets`, for at most `items` at once, in chunks of 2**_CHUNK_BITS cells.

    pool    uint32  the chunks
    link    uint32  of each full chunk, the next one of its bucket
    spare   uint32  a stack of chunks that were emptied
    counts  uint64  how many are spare; how many were ever used
    head    uint64  of each bucket, the position of its first cell: the start of a chunk
    tail    uint64  of each bucket, the position behind its last cell, in a chunk with room for one
    """
    shift = _CHUNK_BITS
    chunks = buckets + (items >> shift) + 1
    pool = np.empty(chunks << shift, np.uint32)
    link = np.empty(chunks, np.uint32)
    spare = np.empty(chunks, np.uint32)
    counts = np.array((0, buckets), np.uint64)
    head = np.empty(buckets, np.uint64)
    tail = np.empty(buckets, np.uint64)
    for b in range(buckets):
        head[b] = b << shift
        tail[b] = b << shift
    return pool, link, spare, counts, head, tail, np.uint64(shift)


@njit
def _choose(cell_cost, cost, length, inverse, least, cells, count, buckets):
    """buckets := which one each cell's exit key falls into, `least` at least."""
    for i in range(count):
        v = np.uint64(cells[i])
        buckets[i] = max(np.int32((cost[v] + cell_cost[v] * length) * inverse), least)


@njit
def _put(queue, cells, count, buckets, ring, first):
    """Put cells into the queue, each into its bucket modulo `ring`, of the circular queue that begins at bucket
    `first`."""
    pool, link, spare, counts, _, tail, shift = queue
    low = (_ONE << shift) - _ONE
    mask = ring - _ONE
    for i in range(count):
        b = (np.uint64(buckets[i]) & mask) + first
        t = tail[b]
        pool[t] = cells[i]
        t += _ONE
        if t & low == _ZERO:
            if counts[0] == _ZERO:
                chunk = counts[1]
                counts[1] += _ONE
            else:
                counts[0] -= _ONE
                chunk = np.uint64(spare[counts[0]])
            link[(t - _ONE) >> shift] = chunk
            t = chunk << shift
        tail[b] = t


@njit
def _take(queue, b, batch):
    """Move all cells of a bucket to `batch`. Returns how many."""
    pool, link, spare, counts, head, tail, shift = queue
    size = _ONE << shift
    position = head[b]
    end = tail[b]
    n = _ZERO
    while position >> shift != end >> shift:
        for i in range(size):
            batch[n + i] = pool[position + i]
        n += size
        chunk = position >> shift
        spare[counts[0]] = chunk
        counts[0] += _ONE
        position = np.uint64(link[chunk]) << shift
    for i in range(end - position):
        batch[n + i] = pool[position + i]
    head[b] = position
    tail[b] = position
    return n + (end - position)


@njit
def _ask_for(cell_cost, cost, s, u):
    prefetch(cell_cost, u)
    prefetch(cost, u - s)
    prefetch(cost, u)
    prefetch(cost, u + s)


@njit
def _offer_straight(cell_cost, cost, s, batch, n, touched):
    """Offer their exit keys to four neighbours. Writes the cells that had no cost yet to `touched`; returns how
    many."""
    count = _ZERO
    for p in range(n):
        _ask_for(cell_cost, cost, s, np.uint64(batch[p + np.uint64(_AHEAD)]))
        u = np.uint64(batch[p])
        key = cost[u] + cell_cost[u]
        north, west, east, south = cost[u - s], cost[u - _ONE], cost[u + _ONE], cost[u + s]
        for i, old in ((u - s, north), (u - _ONE, west), (u + _ONE, east), (u + s, south)):
            cost[i] = min(old, key)
            touched[count] = i
            count += np.uint64(old == INF)
    return count


@njit
def _offer_diagonal(cell_cost, cost, s, corners, batch, n, touched, count):
    """As `_offer_straight`, to the diagonal neighbours of octile steps; there are `count` in `touched` already."""
    for p in range(n):
        _ask_for(cell_cost, cost, s, np.uint64(batch[p + np.uint64(_AHEAD)]))
        u = np.uint64(batch[p])
        key = cost[u] + cell_cost[u] * SQRT2
        above = u - s
        below = u + s
        north, west, east, south = cost[above], cost[u - _ONE], cost[u + _ONE], cost[below]
        around = (
            (above - _ONE, cost[above - _ONE], min(north, west)),
            (above + _ONE, cost[above + _ONE], min(north, east)),
            (below - _ONE, cost[below - _ONE], min(south, west)),
            (below + _ONE, cost[below + _ONE], min(south, east)),
        )
        if not corners:
            # inf past a wall. inf - inf is no number, and no match: a shut diagonal touches nothing.
            for i, old, gate in around:
                offer = max(key, -gate)
                cost[i] = min(old, offer)
                touched[count] = i
                count += np.uint64(old - offer == INF)
            continue
        for i, old, _ in around:
            cost[i] = min(old, key)
            touched[count] = i
            count += np.uint64(old == INF)
    return count


@njit
def _offer_around(cell_cost, cost, s, corners, batch, n, touched):
    """As `_offer_straight`, to eight neighbours, all a step of length 1 away."""
    count = _ZERO
    for p in range(n):
        _ask_for(cell_cost, cost, s, np.uint64(batch[p + np.uint64(_AHEAD)]))
        u = np.uint64(batch[p])
        key = cost[u] + cell_cost[u]
        above = u - s
        below = u + s
        north, west, east, south = cost[above], cost[u - _ONE], cost[u + _ONE], cost[below]
        around = (
            (above - _ONE, cost[above - _ONE], min(north, west)),
            (above + _ONE, cost[above + _ONE], min(north, east)),
            (below - _ONE, cost[below - _ONE], min(south, west)),
            (below + _ONE, cost[below + _ONE], min(south, east)),
        )
        for i, old in ((above, north), (u - _ONE, west), (u + _ONE, east), (below, south)):
            cost[i] = min(old, key)
            touched[count] = i
            count += np.uint64(old == INF)
        if not corners:
            for i, old, gate in around:
                offer = max(key, -gate)
                cost[i] = min(old, offer)
                touched[count] = i
                count += np.uint64(old - offer == INF)
            continue
        for i, old, _ in around:
            cost[i] = min(old, key)
            touched[count] = i
            count += np.uint64(old == INF)
    return count


@njit
def grow_by_buckets(cell_cost, cost, stride, root, rule, corners, width, ring):
    """Costs to `root`, a padded, passable cell. `cost` is written whole.

    width  of a bucket, s: below the lowest cell cost, so that nothing in a bucket leads back into it
    ring   buckets of the circular queue, a power of two; ring * width exceeds the dearest step by two widths
    Returns the last bucket: no cost exceeds (last + 1) * width; or TOO_FINE.

    With octile steps a cell waits twice, under its straight exit key in the first `ring` buckets and under its
    diagonal one in as many behind them.
    """
    kinds = 2 if rule == RULE_OCTILE else 1
    queue = _make_queue(kinds * ring, kinds * cell_cost.size)
    head, tail = queue[4], queue[5]
    # Each cell is touched once; an offer to a cell that has a cost writes one place behind.
    touched = np.empty(cell_cost.size + 1, np.uint32)
    batch = np.empty(cell_cost.size + _AHEAD, np.uint32)
    s = np.uint64(stride)
    ring = np.uint64(ring)
    mask = ring - _ONE
    second = ring if rule == RULE_OCTILE else _ZERO
    inverse = _ONE32 / width

    _open_costs(cell_cost, cost)
    cost[np.uint64(root)] = _ZERO32
    touched[0] = root
    count = _ONE
    current = np.int32(0)
    waiting = _ZERO
    while True:
        # Cells touched from the last bucket join the queue: their cost is final.
        waiting += count
        following = np.int32(current + 1)
        _choose(cell_cost, cost, _ONE32, inverse, following, touched, count, batch)
        _put(queue, touched, count, batch, ring, _ZERO)
        if rule == RULE_OCTILE:
            waiting += count
            _choose(cell_cost, cost, SQRT2, inverse, following, touched, count, batch)
            _put(queue, touched, count, batch, ring, ring)
        if waiting == _ZERO:
            _close_costs(cost)
            return current
        if current > 1 << 20:
            return TOO_FINE
        current = following
        b = np.uint64(current) & mask
        while head[b] == tail[b] and head[b + second] == tail[b + second]:
            current = np.int32(current + 1)
            b = np.uint64(current) & mask
        n = _take(queue, b, batch)
        waiting -= n
        if rule == RULE_PAPER:
            count = _offer_around(cell_cost, cost, s, corners, batch, n, touched)
        else:
            count = _offer_straight(cell_cost, cost, s, batch, n, touched)
        if rule == RULE_OCTILE:
            n = _take(queue, b + ring, batch)
            waiting -= n
            count = _offer_diagonal(cell_cost, cost, s, corners, batch, n, touched, count)


@njit
def breadth_first(cell_cost, cost, stride, root):
    """Steps from every cell to the root over 8 neighbours, whatever they cost: what no growth can be faster than.
    Returns how many cells have a way; `cost` is written whole, and WALL stays on lethal cells."""
    offsets = step_offsets(stride)
    for i in range(cell_cost.size):
        cost[i] = INF if cell_cost[i] < INF else WALL
    queue = np.empty(cell_cost.size, np.uint32)
    cost[root] = np.float32(0.0)
    queue[0] = root
    first = 0
    last = 1
    while first < last:
        u = np.int64(queue[first])
        first += 1
        key = cost[u] + _ONE32
        for k in range(8):
            v = u + offsets[k]
            if cost[v] == INF:
                cost[v] = key
                queue[last] = v
                last += 1
    return last
