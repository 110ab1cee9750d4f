"""The queues of all growths: a binary heap, and buckets of cells in chunks of memory.

The heap's items know their place in it, so that a key can be lowered: it needs room for each item once.

    keys   float32  the lowest first
    items  int64    indices into `place`
    place  int32    where each item is in the heap; -1 where it is not

Buckets serve growths which take a whole bucket at a time.

    pool    uint32  the chunks, of 2**_CHUNK_BITS cells each
    link    uint32  of each full chunk, the next one of its bucket
    spare   uint32  a stack of chunks that were emptied
    head    uint64  of each bucket, the position of its first cell: the start of a chunk
    tail    uint64  of each bucket, the position behind its last cell, in a chunk with room for one
    counts  uint64  how many are spare; how many were ever used

Indices are unsigned 64-bit: signed ones make numba test for negative ones, which blocks vectorisation. A uint64
meets only uint64 here, because with an int64 it would silently become float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.decorators import helper, kernel
from planner_service.kernels.layout import INF, WALL


@helper
def heap_pop(keys, items, place, size):
    """Removes the first of `size` elements."""
    place[items[0]] = -1
    size -= 1
    if size == 0:
        return
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
        place[items[hole]] = hole
        hole = child
    keys[hole] = key
    items[hole] = item
    place[item] = hole


@helper
def heap_lower(keys, items, place, size, key, item):
    """Gives an item a lower key; one that is not in the heap of `size` elements comes in. Returns its size."""
    hole = place[item]
    if hole < 0:
        hole = size
        size += 1
    while hole > 0:
        above = (hole - 1) >> 1
        if keys[above] <= key:
            break
        keys[hole] = keys[above]
        items[hole] = items[above]
        place[items[hole]] = hole
        hole = above
    keys[hole] = key
    items[hole] = item
    place[item] = hole
    return size


@kernel("void(f4[::1], i8[::1], f8, i8, f4[::1], Tuple((f4[::1], i8[::1], i4[::1])))")
def arrivals(cell_cost, offsets, diagonal, start, cost, heap):
    """Writes how soon something that begins on a cell can be on each other one, by Dijkstra's algorithm.

    cell_cost  float32 (n,), padded; inf is lethal, and the border
    cost       float32 (n,), written, from the start to each cell; inf where there is no path
    heap       (keys, items, place), each (n,); place is -1 everywhere
    Trees lead to their root: a step is priced by the cell that it enters on the way there. A path away from a cell
    pays for the cells entered on the way out, which no tree knows. Corners of lethal cells are cut: nothing comes
    sooner than this.
    """
    keys, items, place = heap
    for i in range(cost.size):
        cost[i] = INF
    cost[start] = np.float32(0.0)
    size = heap_lower(keys, items, place, 0, cost[start], start)
    while size:
        u, at = items[0], np.float64(cost[items[0]])
        heap_pop(keys, items, place, size)
        size -= 1
        for k in range(8):
            v = u + offsets[k]
            if cell_cost[v] == INF:
                continue
            offered = np.float32(at + np.float64(cell_cost[v]) * (diagonal if k & 1 else 1.0))
            if offered < cost[v]:
                cost[v] = offered
                size = heap_lower(keys, items, place, size, offered, v)


_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_CHUNK_BITS = 6
"""64 cells, four cache lines: smaller chunks are linked more often, larger ones leave more of each bucket empty."""
_SHIFT = np.uint64(_CHUNK_BITS)

Queue = tuple[NDArray[Any], ...]
QUEUE = "Tuple((u4[::1], u4[::1], u4[::1], u8[::1], u8[::1], u8[::1]))"


def make_queue(entries: int, buckets: int) -> Queue:
    """Returns (pool, link, spare, head, tail, counts), for a number of entries: the system keeps no page that was
    not written."""
    chunks = buckets + (entries >> _CHUNK_BITS) + 1
    pool = np.empty(chunks << _CHUNK_BITS, np.uint32)
    link, spare = np.empty(chunks, np.uint32), np.empty(chunks, np.uint32)
    head, tail = np.empty(buckets, np.uint64), np.empty(buckets, np.uint64)
    return pool, link, spare, head, tail, np.empty(2, np.uint64)


@helper
def open_costs(cell_cost, cost):
    """Before a growth: inf on passable cells, WALL on the others."""
    for i in range(cell_cost.size):
        cost[i] = INF if cell_cost[i] < INF else WALL


@helper
def empty(queue, buckets):
    """Empties a queue of `count` buckets."""
    _, _, _, head, tail, counts = queue
    for b in range(np.uint64(buckets)):
        head[b] = b << _SHIFT
        tail[b] = b << _SHIFT
    counts[0] = _ZERO
    counts[1] = np.uint64(buckets)


@helper
def put(queue, cells, count, buckets, mask, first):
    """Puts cells into the queue, each into its bucket, modulo the length of the circular queue that begins at
    bucket `first`; `mask` is that length less one."""
    pool, link, spare, _, tail, counts = queue
    low = (_ONE << _SHIFT) - _ONE
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
            link[(t - _ONE) >> _SHIFT] = chunk
            t = chunk << _SHIFT
        tail[b] = t


@helper
def take(queue, b, batch):
    """Moves all cells of a bucket to `batch`. Returns how many."""
    pool, link, spare, head, tail, counts = queue
    size = _ONE << _SHIFT
    position = head[b]
    end = tail[b]
    n = _ZERO
    while position >> _SHIFT != end >> _SHIFT:
        for i in range(size):
            batch[n + i] = pool[position + i]
        n += size
        chunk = position >> _SHIFT
        spare[counts[0]] = chunk
        counts[0] += _ONE
        position = np.uint64(link[chunk]) << _SHIFT
    for i in range(end - position):
        batch[n + i] = pool[position + i]
    head[b] = position
    tail[b] = position
    return n + (end - position)
