"""Exact growth over cell costs of any ratio with a radix heap (R. K. Ahuja, K. Mehlhorn, J. B. Orlin, R. E. Tarjan,
"Faster algorithms for the shortest path problem", Journal of the ACM 37(2), 1990, 213-223), on the digits of
float32.

Where one cell cost is thousands of times another, buckets as narrow as the lowest are too many to turn over one by
one. Here a key's bits are read as digits, which sort positive floats, and a cell waits in the list of the first
digit in which its key differs from the keys that are served now. When these reach a list, it is spread over the
lists of the digits below; or served whole where it is no wider than the lowest cell cost. So a cell moves a few
times, whatever the ratio, and no width is too fine: float32 keys are served in the order that they have.

Arrays, beside those of `layout`; an *item* is a padded cell and a kind of step: with octile steps item 2 * v waits
under the straight exit key of v and 2 * v + 1 under its diagonal one, else item v under its only one:
    heads    uint32  (levels * slots,)  first item of each list; 0 if empty (cell 0 is border)
    links    uint32  (kinds * size,)    the item behind each in its list; 0 at the end
    touched  uint32  (size,)            padded cells that got their first cost from what was served last
    waiting  uint64  (levels,)          how many items wait at each level of digits
    number, bits  float32, uint32  (1,)  one key, as a number and as its bits: the same memory
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.layout import GRID, INF, LABELS, NONE, RULE_FOUR, RULE_OCTILE, SQRT2, WALL

_ONE = np.uint64(1)
_DIGIT = np.uint64(6)
_SLOTS = np.uint64(64)
_INF_BITS = np.uint64(0x7F800000)
_LEVELS = np.uint64(6)
"""Digits of 6 bits that 32 bits take."""

Scratch = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint64], Any, Any]


def make_scratch(size: int, rule: int) -> Scratch:
    """(heads, links, touched, waiting, number, bits) for a growth over `size` padded cells."""
    number = np.empty(1, np.float32)
    links = np.empty((2 if rule == RULE_OCTILE else 1) * size, np.uint32)
    heads, waiting = np.empty(int(_LEVELS * _SLOTS), np.uint32), np.empty(int(_LEVELS), np.uint64)
    return heads, links, np.empty(size, np.uint32), waiting, number, number.view(np.uint32)


@helper
def _enter(heads, links, waiting, item, key, served):
    """Put an item into the list of the first digit in which its key differs from `served`; of equal ones, the last.

    Keys are the bits of float32 numbers, as integers."""
    level = np.uint64(0)
    rest = (key ^ served) >> _DIGIT
    while rest:
        rest >>= _DIGIT
        level += _ONE
    slot = level * _SLOTS + ((key >> (level * _DIGIT)) & (_SLOTS - _ONE))
    links[item] = heads[slot]
    heads[slot] = item
    waiting[level] += _ONE


@kernel(f"({GRID}, {LABELS}, f8, Tuple((u4[::1], u4[::1], u4[::1], u8[::1], f4[::1], u4[::1])))")
def grow_by_radix_heap(grid, labels, width, scratch):
    """Costs and parents of a tree to a padded, passable root, both written whole: where one cell cost drowns in the
    rounding of another, costs do not tell the parents.

    width    s; the lowest cell cost, or less
    scratch  as `make_scratch` returns it
    Returns the largest exit key, which no cost exceeds.
    """
    cell_cost, offsets, _, rule, corners = grid
    cost, parent, root = labels
    heads, links, touched, waiting, number, bits = scratch
    width = np.float32(width)
    every = 2 if rule == RULE_FOUR else 1
    kinds = 2 if rule == RULE_OCTILE else 1
    for i in range(cell_cost.size):
        parent[i] = NONE
        cost[i] = INF if cell_cost[i] < INF else WALL
    for i in range(heads.size):
        heads[i] = 0
    for i in range(waiting.size):
        waiting[i] = 0
    cost[root] = np.float32(0.0)
    touched[0] = root
    count = 1
    served = np.uint64(0)
    reach = np.float32(0.0)
    while True:
        for i in range(count):
            v = np.uint64(touched[i])
            for kind in range(kinds):
                number[0] = cost[v] + (cell_cost[v] * SQRT2 if kind else cell_cost[v])
                _enter(heads, links, waiting, v * np.uint64(kinds) + np.uint64(kind), np.uint64(bits[0]), served)
        count = 0
        level = np.uint64(0)
        while level < _LEVELS and waiting[level] == 0:
            level += _ONE
        if level == _LEVELS:
            break
        shift = level * _DIGIT
        digit = (served >> shift) & (_SLOTS - _ONE)
        while heads[level * _SLOTS + digit] == 0:
            digit += _ONE
        item = heads[level * _SLOTS + digit]
        heads[level * _SLOTS + digit] = 0
        above = shift + _DIGIT
        served = (served >> above << above) | (digit << shift)
        bits[0] = served
        first = number[0]
        bits[0] = min(served + (_ONE << shift), _INF_BITS)
        whole = level == 0 or number[0] - first <= width
        while item != 0:
            following = links[item]
            waiting[level] -= _ONE
            u = np.int64(item) // kinds
            kind = np.int64(item) % kinds
            key = cost[u] + (cell_cost[u] * SQRT2 if kind else cell_cost[u])
            if not whole:
                number[0] = key
                _enter(heads, links, waiting, np.uint64(item), np.uint64(bits[0]), served)
                item = following
                continue
            item = following
            reach = max(reach, key)
            for k in range(kind, 8, every * kinds):
                v = u + offsets[k]
                if not key < cost[v]:
                    continue
                if (
                    k & 1
                    and not corners
                    and not max(cell_cost[u + offsets[k - 1]], cell_cost[u + offsets[(k + 1) & 7]]) < INF
                ):
                    continue
                if cost[v] == INF:
                    touched[count] = v
                    count += 1
                cost[v] = key
                parent[v] = (k + 4) & 7
    for i in range(cell_cost.size):
        cost[i] = cost[i] if cost[i] >= np.float32(0.0) else INF
    return reach
