"""A binary heap whose items know their place in it, so that a key can be lowered: it needs room for each item once.

keys   float32  the lowest first
items  int64    indices into `place`
place  int32    where each item is in the heap; -1 where it is not
"""

from __future__ import annotations

from planner_service.kernels.compile import helper


@helper
def heap_pop(keys, items, place, size):
    """Remove the first of `size` elements."""
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
    """Give an item a lower key; one that is not in the heap of `size` elements comes in. Returns its size."""
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
