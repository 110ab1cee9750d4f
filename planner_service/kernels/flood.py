"""The exact tree of one root: floods that find the costs, and the parents that follow from them.

The graph is grown from the root backward. A step from u to its neighbour v costs weight[v] * length, so a settled v
offers all its neighbours the same key: cost[v] + weight[v]. Ordered by that exit key, the first touch of a cell
is final. Octile steps make two keys per cell, straight and diagonal.

Arrays are laid out as `rules` says. Indices are unsigned 64-bit: signed ones make numba test for negative ones,
which blocks vectorisation. A uint64 meets only uint64 here, because with an int64 it would silently become float64.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from planner_service.kernels.rules import (
    HUGE,
    INF,
    LETHAL,
    NONE,
    RULE_FOUR,
    RULE_OCTILE,
    RULE_PAPER,
    SQRT2,
    TOO_FINE,
)

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_ONE32 = np.float32(1.0)


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
