"""The exact tree of one root: a flood over a ring of buckets, and the parents that follow from its costs.

The graph is grown from the root backward. A step from u to its neighbour v costs weight[v] * length, so a settled v
offers all its neighbours the same key: cost[v] + weight[v]. Ordered by that exit key, the first touch of a cell
is final. Octile steps make two keys per cell, straight and diagonal.

What the loops look like was measured, and small changes cost much: cells are touched without branches, sorted into
buckets in two passes (which bucket, then where in it: in one, each store had the next cell's loads wait), and taken
out of the chunks of their bucket into one row before they make their offers.

Arrays are laid out as `rules` says. Indices are unsigned 64-bit: signed ones make numba test for negative ones,
which blocks vectorisation. A uint64 meets only uint64 here, because with an int64 it would silently become float64.
Scratch is allocated for the worst case; of what is not written, the system keeps no page.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import (
    HUGE,
    INF,
    NONE,
    RULE_FOUR,
    RULE_OCTILE,
    RULE_PAPER,
    SQRT2,
    TOO_FINE,
    WALL,
)
from planner_service.kernels.prefetch import prefetch

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_ONE32 = np.float32(1.0)
_ZERO32 = np.float32(0.0)
_CHUNK_BITS = 6
_AHEAD = 8
"""Cells of a batch between asking for one's memory and using it: a fifth of the time at 2048 x 2048."""


@njit
def _open_costs(weight, cost):
    """Before a flood: inf on passable cells, WALL on the others."""
    for i in range(weight.size):
        cost[i] = INF if weight[i] < INF else WALL


@njit
def _close_costs(cost):
    """After a flood: inf on lethal cells too."""
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
def _choose(weight, cost, length, inverse, least, cells, count, buckets):
    """buckets := which one each cell's exit key falls into, `least` at least."""
    for i in range(count):
        v = np.uint64(cells[i])
        buckets[i] = max(np.int32((cost[v] + weight[v] * length) * inverse), least)


@njit
def _put(queue, cells, count, buckets, ring, first):
    """Put cells into the queue, each into its bucket modulo `ring`, of the ring that begins at bucket `first`."""
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
def _ask_for(weight, cost, s, u):
    prefetch(weight, u)
    prefetch(cost, u - s)
    prefetch(cost, u)
    prefetch(cost, u + s)


@njit
def _offer_straight(weight, cost, s, batch, n, touched):
    """Offer their exit keys to four neighbours. Writes the cells that had no cost yet to `touched`; returns how
    many."""
    count = _ZERO
    for p in range(n):
        _ask_for(weight, cost, s, np.uint64(batch[p + np.uint64(_AHEAD)]))
        u = np.uint64(batch[p])
        key = cost[u] + weight[u]
        north, west, east, south = cost[u - s], cost[u - _ONE], cost[u + _ONE], cost[u + s]
        for i, old in ((u - s, north), (u - _ONE, west), (u + _ONE, east), (u + s, south)):
            cost[i] = min(old, key)
            touched[count] = i
            count += np.uint64(old == INF)
    return count


@njit
def _offer_diagonal(weight, cost, s, corners, batch, n, touched, count):
    """As `_offer_straight`, to the diagonal neighbours of octile steps; there are `count` in `touched` already."""
    for p in range(n):
        _ask_for(weight, cost, s, np.uint64(batch[p + np.uint64(_AHEAD)]))
        u = np.uint64(batch[p])
        key = cost[u] + weight[u] * SQRT2
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
def _offer_around(weight, cost, s, corners, batch, n, touched):
    """As `_offer_straight`, to eight neighbours, all a step of length 1 away."""
    count = _ZERO
    for p in range(n):
        _ask_for(weight, cost, s, np.uint64(batch[p + np.uint64(_AHEAD)]))
        u = np.uint64(batch[p])
        key = cost[u] + weight[u]
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
def flood(weight, cost, stride, root, rule, corners, width, ring):
    """First-touch flood. `cost` is written whole.

    width  of a bucket, s: below the smallest weight, so that nothing in a bucket leads back into it
    ring   buckets in the circular queue, a power of two; ring * width exceeds the dearest step by two widths
    Returns the last bucket: no cost exceeds (last + 1) * width; or TOO_FINE.

    With octile steps a cell waits twice, under its straight exit key in the first `ring` buckets and under its
    diagonal one in as many behind them.
    """
    kinds = 2 if rule == RULE_OCTILE else 1
    queue = _make_queue(kinds * ring, kinds * weight.size)
    head, tail = queue[4], queue[5]
    # Each cell is touched once; an offer to a cell that has a cost writes one place behind.
    touched = np.empty(weight.size + 1, np.uint32)
    batch = np.empty(weight.size + _AHEAD, np.uint32)
    s = np.uint64(stride)
    ring = np.uint64(ring)
    mask = ring - _ONE
    second = ring if rule == RULE_OCTILE else _ZERO
    inverse = _ONE32 / width

    _open_costs(weight, cost)
    cost[np.uint64(root)] = _ZERO32
    touched[0] = root
    count = _ONE
    current = np.int32(0)
    waiting = _ZERO
    while True:
        # Cells touched from the last bucket join the queue: their cost is final.
        waiting += count
        following = np.int32(current + 1)
        _choose(weight, cost, _ONE32, inverse, following, touched, count, batch)
        _put(queue, touched, count, batch, ring, _ZERO)
        if rule == RULE_OCTILE:
            waiting += count
            _choose(weight, cost, SQRT2, inverse, following, touched, count, batch)
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
            count = _offer_around(weight, cost, s, corners, batch, n, touched)
        else:
            count = _offer_straight(weight, cost, s, batch, n, touched)
        if rule == RULE_OCTILE:
            n = _take(queue, b + ring, batch)
            waiting -= n
            count = _offer_diagonal(weight, cost, s, corners, batch, n, touched, count)


@njit
def point_to_parents(weight, cost, stride, rule, corners, root, box, parent):
    """Parent of each cell of a window: the neighbour with the smallest exit key; of equals the first of north,
    east, south, west, then of the diagonals clockwise. Costs grow strictly along such parents, backwards, so that
    they cannot form a cycle. box = (row0, col0, row1, col1)."""
    row0, col0, row1, col1 = box
    for row in range(row0, row1):
        first = np.uint64((row + 1) * stride + 1 + col0)
        last = np.uint64((row + 1) * stride + 1 + col1)
        if rule == RULE_FOUR:
            _parents_of_four(weight, cost, np.uint64(stride), first, last, parent)
        else:
            step = SQRT2 if rule == RULE_OCTILE else _ONE32
            limit = INF if corners else HUGE
            _parents_of_eight(weight, cost, np.uint64(stride), first, last, step, limit, parent)
    parent[root] = NONE


@njit
def _parents_of_four(weight, cost, s, first, last, parent):
    for i in range(first, last):
        best = cost[i - s] + weight[i - s]
        code = np.uint8(0)
        key = cost[i + _ONE] + weight[i + _ONE]
        code = np.uint8(2) if key < best else code
        best = min(best, key)
        key = cost[i + s] + weight[i + s]
        code = np.uint8(4) if key < best else code
        best = min(best, key)
        key = cost[i - _ONE] + weight[i - _ONE]
        code = np.uint8(6) if key < best else code
        best = min(best, key)
        parent[i] = code if max(cost[i], best) < INF else NONE


@njit
def _parents_of_eight(weight, cost, s, first, last, step, limit, parent):
    """A diagonal counts where the dearer of its two corners costs at most `limit`. Free of branches: it
    vectorises."""
    for i in range(first, last):
        north = cost[i - s] + weight[i - s]
        east = cost[i + _ONE] + weight[i + _ONE]
        south = cost[i + s] + weight[i + s]
        west = cost[i - _ONE] + weight[i - _ONE]
        best = north
        code = np.uint8(0)
        code = np.uint8(2) if east < best else code
        best = min(best, east)
        code = np.uint8(4) if south < best else code
        best = min(best, south)
        code = np.uint8(6) if west < best else code
        best = min(best, west)
        key = cost[i - s + _ONE] + weight[i - s + _ONE] * step
        key = key if max(north, east) <= limit else INF
        code = np.uint8(1) if key < best else code
        best = min(best, key)
        key = cost[i + s + _ONE] + weight[i + s + _ONE] * step
        key = key if max(south, east) <= limit else INF
        code = np.uint8(3) if key < best else code
        best = min(best, key)
        key = cost[i + s - _ONE] + weight[i + s - _ONE] * step
        key = key if max(south, west) <= limit else INF
        code = np.uint8(5) if key < best else code
        best = min(best, key)
        key = cost[i - s - _ONE] + weight[i - s - _ONE] * step
        key = key if max(north, west) <= limit else INF
        code = np.uint8(7) if key < best else code
        best = min(best, key)
        parent[i] = code if max(cost[i], best) < INF else NONE


@njit
def breadth_first(weight, cost, stride, root):
    """Steps from every cell to the root, whatever they cost: the floor under every growth of a tree."""
    offsets = np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))
    for i in range(weight.size):
        cost[i] = INF if weight[i] < INF else WALL
    queue = np.empty(weight.size, np.uint32)
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
