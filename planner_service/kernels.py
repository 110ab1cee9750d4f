"""The tree's kernels: growth, parents, windows. Arrays in, arrays out.

All arrays are flat and padded: a grid of `rows` x `cols` lies in `(rows + 2) * stride` cells, stride = cols + 2,
with a border of lethal cells, so that no neighbour of an inner cell needs a bounds check.

    weight   float32  s; what entering a cell by a straight step costs (pace * resolution); inf is lethal
    cost     float32  s; cheapest known cost to the root, less the tree's offset; inf where there is no way
    parent   uint8    direction 0..7 of the next cell towards the root; 255 at the root and where there is no way

The graph is grown from the root backward. A step from u to its neighbour v costs weight[v] * length, so a settled v
offers all its neighbours the same key: cost[v] + weight[v]. Ordered by that exit key, the first touch of a cell
is final. Octile steps make two keys per cell, straight and diagonal.

`rule`: RULE_FOUR steps to 4 neighbours; RULE_PAPER to 8, all of length 1; RULE_OCTILE to 8, diagonals sqrt(2) long.
`corners`: whether a diagonal step may pass a lethal cell.

Indices are unsigned 64-bit: signed ones make numba test for negative ones, which blocks vectorisation. A uint64
meets only uint64 here, because with an int64 it would silently become float64.
"""

from __future__ import annotations

import numpy as np
from numba import njit

RULE_FOUR = 0
RULE_PAPER = 1
RULE_OCTILE = 2

NONE = np.uint8(255)
SQRT2 = np.float32(1.4142135623730951)
SQRT2_EXACT = 1.4142135623730951
INF = np.float32(np.inf)
HUGE = np.float32(3.4028235e38)
LETHAL = np.float32(-1.0)
"""While growing, the cost of a lethal cell: below every key, so that a minimum leaves it alone."""

TOO_FINE = -1
"""Returned by a flood whose keys grew so large, in smallest weights, that float32 could not tell them apart."""

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_ONE32 = np.float32(1.0)


@njit(cache=True, nogil=True)
def pad_weights(pace, resolution, extra, stride, weight):
    """weight := pace * resolution + extra, everywhere. Returns cells whose pace is NaN, zero or negative."""
    bad = 0
    for row in range(pace.shape[0]):
        base = (row + 1) * stride + 1
        for col in range(pace.shape[1]):
            p = pace[row, col]
            w = p * resolution + extra
            bad += not (p > 0 and w > 0)
            weight[base + col] = w
    return bad


@njit(cache=True, nogil=True)
def changed_cells(pace, resolution, extra, box, stride, weight, cells, before):
    """The padded cells of a window whose weight differs from their pace, and their weight before; updates weight.

    box = (row0, col0, row1, col1); cells, before have room for the whole window. Returns (count, cells whose pace
    is NaN, zero or negative: these are not applied).
    """
    row0, col0, row1, col1 = box
    count = 0
    bad = 0
    for row in range(row0, row1):
        base = (row + 1) * stride + 1
        for col in range(col0, col1):
            p = pace[row, col]
            new = p * resolution + extra
            if not (p > 0 and new > 0):
                bad += 1
                continue
            old = weight[base + col]
            if new != old:
                cells[count] = base + col
                before[count] = old
                count += 1
                weight[base + col] = new
    return count, bad


@njit(cache=True, nogil=True)
def weight_range(weight):
    """(smallest, largest finite) weight; (inf, 0) if all cells are lethal."""
    low = INF
    high = np.float32(0.0)
    for i in range(weight.size):
        w = weight[i]
        low = min(low, w)
        high = max(high, w if w < INF else np.float32(0.0))
    return low, high


@njit(cache=True, nogil=True)
def open_costs(weight, active, cost):
    """Before a flood: inf on passable cells, LETHAL on the others; 0 on passable ones that are not to take part,
    which is below every key too. `active` is empty if all take part."""
    if active.size == 0:
        for i in range(weight.size):
            cost[i] = INF if weight[i] < INF else LETHAL
        return
    for i in range(weight.size):
        cost[i] = (INF if active[i] else np.float32(0.0)) if weight[i] < INF else LETHAL


@njit(cache=True, nogil=True)
def close_costs(cost):
    """After a flood: inf on lethal cells too."""
    for i in range(cost.size):
        c = cost[i]
        cost[i] = c if c >= np.float32(0.0) else INF


@njit(cache=True, nogil=True)
def flood_single(weight, active, cost, stride, root, diagonals, corners, width, ring, shift):
    """First-touch flood where every step has length 1: one exit key per cell. `cost` is written whole.

    active uint8    the cells that take part; empty if all

    width  of a bucket, s: below the smallest weight, so that nothing in a bucket leads back into it
    ring   buckets in the circular queue, a power of two; ring * width exceeds the largest weight by two widths
    shift  a chunk of the queue holds 2**shift cells
    Returns the last bucket: no cost exceeds (last + 1) * width; or TOO_FINE.
    """
    s = np.uint64(stride)
    mask = np.uint64(ring - 1)
    inverse = _ONE32 / width
    size = np.uint64(1) << np.uint64(shift)
    low = size - _ONE
    sh = np.uint64(shift)
    chunks = 2 * ring + 64 + (weight.size >> (shift + 4))
    pool = np.empty(chunks << shift, np.uint32)
    following = np.empty(chunks, np.uint32)
    spare = np.empty(chunks, np.uint32)
    head = np.empty(ring, np.uint64)
    tail = np.empty(ring, np.uint64)
    for b in range(ring):
        head[b] = np.uint64(b) << sh
        tail[b] = head[b]
    spares = 0
    for c in range(chunks - 1, ring - 1, -1):
        spare[spares] = c
        spares += 1
    touched = np.empty(1024 + 8 * 64, np.uint32)
    capacity = np.uint64(touched.size - 8)

    open_costs(weight, active, cost)
    root = np.uint64(root)
    cost[root] = np.float32(0.0)
    touched[0] = root
    count = _ONE
    current = 0
    waiting = 0
    while True:
        # Cells touched from the last bucket join the queue: their cost is final.
        n = np.int64(count)
        waiting += n
        if spares < (n >> shift) + min(n, ring) + 2:
            more = chunks + (n >> shift) + min(n, ring) + 2
            new_pool = np.empty((chunks + more) << shift, np.uint32)
            new_pool[: chunks << shift] = pool
            pool = new_pool
            new_following = np.empty(chunks + more, np.uint32)
            new_following[:chunks] = following
            following = new_following
            new_spare = np.empty(chunks + more, np.uint32)
            new_spare[:spares] = spare[:spares]
            spare = new_spare
            for c in range(chunks, chunks + more):
                spare[spares] = c
                spares += 1
            chunks += more
        for i in range(n):
            v = np.uint64(touched[i])
            bucket = max(np.int64((cost[v] + weight[v]) * inverse), current + 1)
            b = np.uint64(bucket) & mask
            t = tail[b]
            pool[t] = v
            t += _ONE
            if t & low == _ZERO:
                spares -= 1
                c = spare[spares]
                following[(t - _ONE) >> sh] = c
                t = np.uint64(c) << sh
            tail[b] = t
        if waiting == 0:
            close_costs(cost)
            return current
        if current > 1 << 20:
            return TOO_FINE
        current += 1
        b = np.uint64(current) & mask
        while head[b] == tail[b]:
            current += 1
            b = np.uint64(current) & mask
        count = _ZERO
        position = head[b]
        end = tail[b]
        while position != end:
            chunk_end = (position | low) + _ONE
            stop = end if end >> sh == position >> sh else chunk_end
            need = count + np.uint64(8) * (stop - position)
            if need > capacity:
                new_touched = np.empty(np.int64(2 * need) + 8, np.uint32)
                new_touched[:count] = touched[:count]
                touched = new_touched
                capacity = np.uint64(touched.size - 8)
            waiting -= np.int64(stop - position)
            for p in range(position, stop):
                u = np.uint64(pool[p])
                key = cost[u] + weight[u]
                above = u - s
                below = u + s
                north = cost[above]
                east = cost[u + _ONE]
                south = cost[below]
                west = cost[u - _ONE]
                cost[above] = min(north, key)
                touched[count] = above
                count += np.uint64(north == INF)
                cost[u + _ONE] = min(east, key)
                touched[count] = u + _ONE
                count += np.uint64(east == INF)
                cost[below] = min(south, key)
                touched[count] = below
                count += np.uint64(south == INF)
                cost[u - _ONE] = min(west, key)
                touched[count] = u - _ONE
                count += np.uint64(west == INF)
                if not diagonals:
                    continue
                ne = above + _ONE
                se = below + _ONE
                sw = below - _ONE
                nw = above - _ONE
                if not corners and min(min(north, east), min(south, west)) < np.float32(0.0):
                    # A step past a wall goes to cell 0 instead, which is lethal and takes no offer.
                    ne = ne if min(north, east) >= np.float32(0.0) else _ZERO
                    se = se if min(south, east) >= np.float32(0.0) else _ZERO
                    sw = sw if min(south, west) >= np.float32(0.0) else _ZERO
                    nw = nw if min(north, west) >= np.float32(0.0) else _ZERO
                old = cost[ne]
                cost[ne] = min(old, key)
                touched[count] = ne
                count += np.uint64(old == INF)
                old = cost[se]
                cost[se] = min(old, key)
                touched[count] = se
                count += np.uint64(old == INF)
                old = cost[sw]
                cost[sw] = min(old, key)
                touched[count] = sw
                count += np.uint64(old == INF)
                old = cost[nw]
                cost[nw] = min(old, key)
                touched[count] = nw
                count += np.uint64(old == INF)
            if end >> sh == position >> sh:
                position = end
            else:
                c = following[position >> sh]
                spare[spares] = position >> sh
                spares += 1
                position = np.uint64(c) << sh
        head[b] = position & ~low
        tail[b] = head[b]


@njit(cache=True, nogil=True)
def flood_octile(weight, active, cost, stride, root, corners, width, ring, shift):
    """As `flood_single`, for octile steps: a cell waits twice, under its straight and under its diagonal exit key.

    Buckets 0..ring-1 of the queue hold straight exits, ring..2*ring-1 diagonal ones.
    """
    s = np.uint64(stride)
    mask = np.uint64(ring - 1)
    diagonal = np.uint64(ring)
    inverse = _ONE32 / width
    low = (np.uint64(1) << np.uint64(shift)) - _ONE
    sh = np.uint64(shift)
    chunks = 4 * ring + 64 + (weight.size >> (shift + 3))
    pool = np.empty(chunks << shift, np.uint32)
    following = np.empty(chunks, np.uint32)
    spare = np.empty(chunks, np.uint32)
    head = np.empty(2 * ring, np.uint64)
    tail = np.empty(2 * ring, np.uint64)
    for c in range(2 * ring):
        head[c] = np.uint64(c) << sh
        tail[c] = head[c]
    spares = 0
    for c in range(chunks - 1, 2 * ring - 1, -1):
        spare[spares] = c
        spares += 1
    touched = np.empty(1024 + 4 * 64, np.uint32)
    capacity = np.uint64(touched.size - 8)

    open_costs(weight, active, cost)
    root = np.uint64(root)
    cost[root] = np.float32(0.0)
    touched[0] = root
    count = _ONE
    current = 0
    waiting = 0
    while True:
        n = np.int64(count)
        waiting += 2 * n
        need_chunks = 2 * ((n >> shift) + min(n, ring) + 2)
        if spares < need_chunks:
            more = chunks + need_chunks
            new_pool = np.empty((chunks + more) << shift, np.uint32)
            new_pool[: chunks << shift] = pool
            pool = new_pool
            new_following = np.empty(chunks + more, np.uint32)
            new_following[:chunks] = following
            following = new_following
            new_spare = np.empty(chunks + more, np.uint32)
            new_spare[:spares] = spare[:spares]
            spare = new_spare
            for c in range(chunks, chunks + more):
                spare[spares] = c
                spares += 1
            chunks += more
        for i in range(n):
            v = np.uint64(touched[i])
            base = cost[v]
            w = weight[v]
            bucket = max(np.int64((base + w) * inverse), current + 1)
            b = np.uint64(bucket) & mask
            t = tail[b]
            pool[t] = v
            t += _ONE
            if t & low == _ZERO:
                spares -= 1
                c = spare[spares]
                following[(t - _ONE) >> sh] = c
                t = np.uint64(c) << sh
            tail[b] = t
            bucket = max(np.int64((base + w * SQRT2) * inverse), current + 1)
            b = (np.uint64(bucket) & mask) + diagonal
            t = tail[b]
            pool[t] = v
            t += _ONE
            if t & low == _ZERO:
                spares -= 1
                c = spare[spares]
                following[(t - _ONE) >> sh] = c
                t = np.uint64(c) << sh
            tail[b] = t
        if waiting == 0:
            close_costs(cost)
            return current
        if current > 1 << 20:
            return TOO_FINE
        current += 1
        b = np.uint64(current) & mask
        while head[b] == tail[b] and head[b + diagonal] == tail[b + diagonal]:
            current += 1
            b = np.uint64(current) & mask
        count = _ZERO
        position = head[b]
        end = tail[b]
        while position != end:
            stop = end if end >> sh == position >> sh else (position | low) + _ONE
            need = count + np.uint64(4) * (stop - position)
            if need > capacity:
                new_touched = np.empty(np.int64(2 * need) + 8, np.uint32)
                new_touched[:count] = touched[:count]
                touched = new_touched
                capacity = np.uint64(touched.size - 8)
            waiting -= np.int64(stop - position)
            for p in range(position, stop):
                u = np.uint64(pool[p])
                key = cost[u] + weight[u]
                i = u - s
                old = cost[i]
                cost[i] = min(old, key)
                touched[count] = i
                count += np.uint64(old == INF)
                i = u + _ONE
                old = cost[i]
                cost[i] = min(old, key)
                touched[count] = i
                count += np.uint64(old == INF)
                i = u + s
                old = cost[i]
                cost[i] = min(old, key)
                touched[count] = i
                count += np.uint64(old == INF)
                i = u - _ONE
                old = cost[i]
                cost[i] = min(old, key)
                touched[count] = i
                count += np.uint64(old == INF)
            if end >> sh == position >> sh:
                position = end
            else:
                c = following[position >> sh]
                spare[spares] = position >> sh
                spares += 1
                position = np.uint64(c) << sh
        head[b] = position & ~low
        tail[b] = head[b]

        b += diagonal
        position = head[b]
        end = tail[b]
        while position != end:
            stop = end if end >> sh == position >> sh else (position | low) + _ONE
            need = count + np.uint64(4) * (stop - position)
            if need > capacity:
                new_touched = np.empty(np.int64(2 * need) + 8, np.uint32)
                new_touched[:count] = touched[:count]
                touched = new_touched
                capacity = np.uint64(touched.size - 8)
            waiting -= np.int64(stop - position)
            for p in range(position, stop):
                u = np.uint64(pool[p])
                key = cost[u] + weight[u] * SQRT2
                above = u - s
                below = u + s
                ne = above + _ONE
                se = below + _ONE
                sw = below - _ONE
                nw = above - _ONE
                if not corners:
                    north = cost[above]
                    east = cost[u + _ONE]
                    south = cost[below]
                    west = cost[u - _ONE]
                    if min(min(north, east), min(south, west)) < np.float32(0.0):
                        ne = ne if min(north, east) >= np.float32(0.0) else _ZERO
                        se = se if min(south, east) >= np.float32(0.0) else _ZERO
                        sw = sw if min(south, west) >= np.float32(0.0) else _ZERO
                        nw = nw if min(north, west) >= np.float32(0.0) else _ZERO
                old = cost[ne]
                cost[ne] = min(old, key)
                touched[count] = ne
                count += np.uint64(old == INF)
                old = cost[se]
                cost[se] = min(old, key)
                touched[count] = se
                count += np.uint64(old == INF)
                old = cost[sw]
                cost[sw] = min(old, key)
                touched[count] = sw
                count += np.uint64(old == INF)
                old = cost[nw]
                cost[nw] = min(old, key)
                touched[count] = nw
                count += np.uint64(old == INF)
            if end >> sh == position >> sh:
                position = end
            else:
                c = following[position >> sh]
                spare[spares] = position >> sh
                spares += 1
                position = np.uint64(c) << sh
        head[b] = position & ~low
        tail[b] = head[b]


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def step_offsets(stride):
    """What each direction code 0..7 adds to a padded cell index."""
    return np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))


@njit(cache=True, nogil=True)
def flood_wide(weight, cost, stride, root, rule, corners, parent):
    """First-touch flood with a heap, for weights of any ratio. Sets parents too: where one weight drowns in the
    rounding of another, costs cannot tell them. Whole arrays `cost` and `parent` are written. Returns the largest
    exit key, which no cost exceeds."""
    offsets = step_offsets(stride)
    for i in range(weight.size):
        parent[i] = NONE
        cost[i] = INF
    capacity = 1024
    keys = np.empty(capacity, np.float32)
    items = np.empty(capacity, np.int64)
    cost[root] = np.float32(0.0)
    keys[0] = weight[root]
    items[0] = root * 2
    size = 1
    if rule == RULE_OCTILE:
        _rise(keys, items, 1, weight[root] * SQRT2, root * 2 + 1)
        size = 2
    while size > 0:
        key = keys[0]
        u = items[0] >> 1
        kind = items[0] & 1
        size -= 1
        _sink(keys, items, size)
        if size + 16 > capacity:
            new_keys = np.empty(2 * capacity, np.float32)
            new_items = np.empty(2 * capacity, np.int64)
            new_keys[:size] = keys[:size]
            new_items[:size] = items[:size]
            keys = new_keys
            items = new_items
            capacity *= 2
        first = kind if rule == RULE_OCTILE else 0
        every = 1 if rule == RULE_PAPER else 2
        for k in range(first, 8, every):
            v = u + offsets[k]
            if cost[v] < INF or not weight[v] < INF:
                continue
            if k & 1 and not corners:
                a = weight[u + offsets[k - 1]]
                b = weight[u + offsets[(k + 1) & 7]]
                if not max(a, b) < INF:
                    continue
            cost[v] = key
            parent[v] = (k + 4) & 7
            w = weight[v]
            _rise(keys, items, size, key + w, v * 2)
            size += 1
            if rule == RULE_OCTILE:
                _rise(keys, items, size, key + w * SQRT2, v * 2 + 1)
                size += 1
    return key


@njit(cache=True, nogil=True)
def _offer(weight, cost, offsets, rule, corners, v):
    """(smallest exit key among the neighbours of v, direction to it)."""
    best = INF
    code = NONE
    for k in (0, 2, 4, 6):
        u = v + offsets[k]
        key = cost[u] + weight[u]
        if key < best:
            best = key
            code = np.uint8(k)
    if rule != RULE_FOUR:
        for k in (1, 3, 5, 7):
            if not corners and not max(weight[v + offsets[k - 1]], weight[v + offsets[(k + 1) & 7]]) < INF:
                continue
            u = v + offsets[k]
            key = cost[u] + (weight[u] * SQRT2 if rule == RULE_OCTILE else weight[u])
            if key < best:
                best = key
                code = np.uint8(k)
    return best, code


@njit(cache=True, nogil=True)
def _wave(weight, cost, offsets, rule, corners, root, candidates, count, limit):
    """Let better offers spread from `candidates` until no cell is offered less than it costs.

    Returns (cells popped, or -1 beyond `limit`; the largest cost popped; the cells whose cost fell, with
    repetitions; how many).
    """
    capacity = 64 + 2 * count
    keys = np.empty(capacity, np.float32)
    items = np.empty(capacity, np.int64)
    fallen = np.empty(capacity, np.int64)
    falls = 0
    size = 0
    for i in range(count):
        v = candidates[i]
        if v == root or not weight[v] < INF:
            continue
        best, _ = _offer(weight, cost, offsets, rule, corners, v)
        if best < cost[v]:
            cost[v] = best
            _rise(keys, items, size, best, v)
            size += 1
            fallen[falls] = v
            falls += 1
    popped = 0
    key = np.float32(0.0)
    while size > 0:
        key = keys[0]
        u = items[0]
        size -= 1
        _sink(keys, items, size)
        if key > cost[u]:
            continue
        popped += 1
        if popped > limit:
            return -1, key, fallen, falls
        if max(size, falls) + 16 > capacity:
            new_keys = np.empty(2 * capacity, np.float32)
            new_items = np.empty(2 * capacity, np.int64)
            new_fallen = np.empty(2 * capacity, np.int64)
            new_keys[:size] = keys[:size]
            new_items[:size] = items[:size]
            new_fallen[:falls] = fallen[:falls]
            keys = new_keys
            items = new_items
            fallen = new_fallen
            capacity *= 2
        straight = key + weight[u]
        diagonal = key + (weight[u] * SQRT2 if rule == RULE_OCTILE else weight[u])
        for k in range(0, 8, 2 if rule == RULE_FOUR else 1):
            v = u + offsets[k]
            offer = diagonal if k & 1 else straight
            if not offer < cost[v] or not weight[v] < INF:
                continue
            shut = max(weight[u + offsets[k - 1]], weight[u + offsets[(k + 1) & 7]]) == INF
            if k & 1 and not corners and shut:
                continue
            cost[v] = offer
            _rise(keys, items, size, offer, v)
            size += 1
            fallen[falls] = v
            falls += 1
    return popped, key, fallen, falls


@njit(cache=True, nogil=True)
def _eased(weight, offsets, changed, before, out, count):
    """Append the cells that may be offered less since the weights of `changed` fell. Returns how many there are."""
    for i in range(changed.size):
        x = changed[i]
        if weight[x] < before[i]:
            out[count] = x
            count += 1
            for k in range(8):
                out[count] = x + offsets[k]
                count += 1
    return count


@njit(cache=True, nogil=True)
def lower(weight, cost, stride, rule, corners, changed, before, limit):
    """After weights fell, let costs fall: no cell costs more than what any neighbour offers, where so before.

    Needs no parents, and no root but a cell that costs least. Returns cells visited, or -1 beyond `limit`; then
    cost is of no use any more.
    """
    offsets = step_offsets(stride)
    candidates = np.empty(9 * changed.size, np.int64)
    count = _eased(weight, offsets, changed, before, candidates, 0)
    popped, _, _, _ = _wave(weight, cost, offsets, rule, corners, -1, candidates, count, limit)
    return popped


@njit(cache=True, nogil=True)
def repair(weight, cost, parent, stride, rule, corners, root, changed, before, limit, state):
    """Bring a tree up to date after the weights of `changed` cells became what they are now.

    changed  int64    padded cells, without repetition; before: float32, their weights when the tree was right
    state    uint8    scratch, zero; zero again afterwards
    Cells whose way led through a dearer cell lose their cost and find a new one; the rest only improves. An exact
    tree is exact afterwards, equal to one grown from scratch. Returns (cells visited, the largest new cost); -1
    cells if more than `limit` are concerned: then the tree is of no use any more and must be grown.
    """
    offsets = step_offsets(stride)
    capacity = 64 + 12 * changed.size
    affected = np.empty(capacity, np.int64)
    count = 0
    for i in range(changed.size):
        x = changed[i]
        if not weight[x] > before[i]:
            continue
        lethal = not weight[x] < INF
        if lethal and state[x] == 0 and x != root:
            state[x] = 1
            affected[count] = x
            count += 1
        for k in range(8):
            v = x + offsets[k]
            way = parent[v]
            if way == NONE or state[v] != 0:
                continue
            squeezed = False
            if lethal and not corners and way & 1:
                squeezed = v + offsets[way - 1] == x or v + offsets[(way + 1) & 7] == x
            if squeezed or way == (k + 4) & 7:
                state[v] = 1
                affected[count] = v
                count += 1
    done = 0
    while done < count and count <= limit:
        u = affected[done]
        done += 1
        if count + 8 > capacity:
            new_affected = np.empty(2 * capacity, np.int64)
            new_affected[:count] = affected[:count]
            affected = new_affected
            capacity *= 2
        for k in range(8):
            v = u + offsets[k]
            if state[v] == 0 and parent[v] == (k + 4) & 7:
                state[v] = 1
                affected[count] = v
                count += 1
    for i in range(count):
        state[affected[i]] = 0
    if count > limit:
        return -1, INF
    for i in range(count):
        cost[affected[i]] = INF
    candidates = np.empty(count + 9 * changed.size, np.int64)
    candidates[:count] = affected[:count]
    total = _eased(weight, offsets, changed, before, candidates, count)
    popped, highest, fallen, falls = _wave(weight, cost, offsets, rule, corners, root, candidates, total, limit)
    if popped < 0:
        return -1, INF
    # Whoever stands beside a cell that changed may have a better neighbour now.
    for part in range(3):
        many = (changed.size, count, falls)[part]
        for i in range(many):
            x = changed[i] if part == 0 else (affected[i] if part == 1 else fallen[i])
            if state[x] == 2:
                continue
            state[x] = 2
            for k in range(-1, 8):
                v = x if k < 0 else x + offsets[k]
                if weight[v] < INF and v != root:
                    _, code = _offer(weight, cost, offsets, rule, corners, v)
                    parent[v] = code if cost[v] < INF else NONE
                elif v != root:
                    parent[v] = NONE
    for i in range(changed.size):
        state[changed[i]] = 0
    for i in range(count):
        state[affected[i]] = 0
    for i in range(falls):
        state[fallen[i]] = 0
    return popped + count, highest


@njit(cache=True, nogil=True)
def cut_window(weight, stride, box, part):
    """The weights of a window as a padded grid of its own."""
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    for i in range(part.size):
        part[i] = INF
    for row in range(row0, row1):
        a = (row + 1) * stride + 1 + col0
        b = (row - row0 + 1) * width + 1
        for col in range(col1 - col0):
            part[b + col] = weight[a + col]


@njit(cache=True, nogil=True)
def merge_window(part, box, offset, old_root, cost, stride):
    """Costs of a window grown around a new root improve a tree whose costs are stored less `offset`.

    Only what gets cheaper is rewritten, and the old root, so that costs stay upper bounds of what is driven and
    grow strictly along every way. Returns cells rewritten.
    """
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    rewritten = 0
    for row in range(row0, row1):
        a = (row + 1) * stride + 1 + col0
        b = (row - row0 + 1) * width + 1
        for col in range(col1 - col0):
            new = part[b + col] - offset
            if new < cost[a + col] or a + col == old_root:
                cost[a + col] = new
                rewritten += 1
    return rewritten


@njit(cache=True, nogil=True)
def relabel(weight, parent, stride, rule, root, cost):
    """cost := what is really driven from each cell along its parents. `cost` is written whole."""
    offsets = step_offsets(stride)
    unknown = np.float32(-1.0)
    for i in range(cost.size):
        cost[i] = unknown if parent[i] != NONE else INF
    cost[root] = np.float32(0.0)
    trail = np.empty(cost.size, np.uint32)
    for i in range(cost.size):
        v = i
        many = 0
        while cost[v] == unknown:
            trail[many] = v
            many += 1
            v += offsets[parent[v]]
        for j in range(many - 1, -1, -1):
            v = np.int64(trail[j])
            k = parent[v]
            u = v + offsets[k]
            cost[v] = cost[u] + (weight[u] * SQRT2 if rule == RULE_OCTILE and k & 1 else weight[u])


@njit(cache=True, nogil=True)
def walk_routes(weight, parent, stride, rule, root, starts, max_steps, limit):
    """The routes from `starts` (padded cells that have a way), at most `max_steps` long where that is positive.

    limit  no route can be longer than so many steps
    Returns directions (uint8, one route after the other), ends (int64, where each stops in directions), driven
    (float64, s, recomputed along the cells), diagonals (int64, how many steps were diagonal), last (int64, the
    last cell). A cycle or a hole would be a bug: ends is -1 there.
    """
    offsets = step_offsets(stride)
    count = starts.size
    capacity = 1024
    directions = np.empty(capacity, np.uint8)
    ends = np.empty(count, np.int64)
    driven = np.empty(count, np.float64)
    diagonals = np.empty(count, np.int64)
    last = np.empty(count, np.int64)
    n = 0
    most = limit if max_steps <= 0 else min(limit, max_steps)
    for r in range(count):
        v = starts[r]
        straight_sum = 0.0
        diagonal_sum = 0.0
        slants = 0
        steps = 0
        while v != root and steps < most:
            if n == capacity:
                more = np.empty(2 * capacity, np.uint8)
                more[:n] = directions
                directions = more
                capacity *= 2
            k = parent[v]
            if k == NONE:
                break
            directions[n] = k
            n += 1
            steps += 1
            v += offsets[k]
            w = np.float64(weight[v])
            odd = k & 1
            slants += odd
            diagonal_sum += w if odd else 0.0
            straight_sum += 0.0 if odd else w
        broken = v != root and (steps == limit or parent[v] == NONE)
        ends[r] = -1 if broken else n
        driven[r] = straight_sum + diagonal_sum * (SQRT2_EXACT if rule == RULE_OCTILE else 1.0)
        diagonals[r] = slants
        last[r] = v
    return directions[:n], ends, driven, diagonals, last


@njit(cache=True, nogil=True)
def breadth_first(weight, cost, stride, root):
    """Steps from every cell to the root, whatever they cost: the floor under every growth of a tree."""
    offsets = step_offsets(stride)
    for i in range(weight.size):
        cost[i] = INF if weight[i] < INF else LETHAL
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
