"""Buckets of cells in chunks of memory: the queue of growths that serve a whole bucket at a time.

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

from planner_service.kernels.decorators import helper

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
