"""Parents from costs: every cell leads to the neighbour that offers it least.

With exact costs such parents are a shortest-path tree. Costs grow strictly along them, backwards, so that they
cannot form a cycle. Arrays are laid out as `layout` says.

If a step costs less than the rounding of the path behind it, a cell may cost as much as its parent, and parents
that follow from costs alone may form a cycle. `untie_parents` gives such cells others: from where costs do tell
them onward, over steps that cost exactly what their cells differ by. Every cell with a way has such steps all the
way to the root: its cost is what one neighbour offered it, which cost less, or as much and was served before it.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.climbs import CLIMBS, offered, offers_of_row
from planner_service.kernels.decorators import helper, step_kernel
from planner_service.kernels.layout import (
    BOX,
    GRID,
    HUGE,
    INF,
    LABELS,
    NONE,
    RULE_FOUR,
    diagonal_length,
    is_shut,
    step_length,
)

_ONE = np.uint64(1)
_ZERO8, _ONE8, _TWO8, _THREE8, _FOUR8, _FIVE8, _SIX8, _SEVEN8 = (np.uint8(k) for k in range(8))


@helper
def least_offers(cell_cost, cost, s, first, last, step, limit, parent, least):
    """The lowest offer to each cell, and whose it is. A diagonal counts if the more expensive of its two corners
    costs at most `limit`, and none where `step`, its length, is inf. Free of branches: it vectorises.

    parent  written; None if not needed
    least   s; written from its first element on; None if not needed
    """
    for i in range(first, last):
        north, east, south, west = i - s, i + _ONE, i + s, i - _ONE
        best, code = INF, _ZERO8
        for k, u in ((_ZERO8, north), (_TWO8, east), (_FOUR8, south), (_SIX8, west)):
            key = cost[u] + cell_cost[u]
            code = k if key < best else code
            best = min(best, key)
        for k, u, one, other in (
            (_ONE8, north + _ONE, north, east),
            (_THREE8, south + _ONE, south, east),
            (_FIVE8, south - _ONE, south, west),
            (_SEVEN8, north - _ONE, north, west),
        ):
            key = cost[u] + cell_cost[u] * step
            key = key if max(cell_cost[one], cell_cost[other]) <= limit else INF
            code = k if key < best else code
            best = min(best, key)
        if parent is not None:
            parent[i] = code if max(cost[i], best) < INF else NONE
        if least is not None:
            least[i - first] = best


@helper
def _take_less(climbs, n, code):
    """Takes a row's offer, and its origin, where it is less than the best up to now."""
    keys, best, codes = climbs[4], climbs[5], climbs[6]
    for i in range(n):
        codes[i] = code if keys[i] < best[i] else codes[i]
        best[i] = min(best[i], keys[i])


@helper
def _shut_diagonals(cell_cost, climbs, first, n, one, other):
    """Blocks offers over a diagonal step if one of the cells beside it, at this (unsigned) offset, is lethal."""
    keys = climbs[4]
    for i in range(n):
        v = first + i
        keys[i] = keys[i] if max(cell_cost[v + one], cell_cost[v + other]) < INF else INF


@helper
def _parents_by_climb(grid, climbs, cost, first, last, parent, least):
    """Like the others here, direction by direction, so that it vectorises."""
    cell_cost, offsets, _, rule, corners = grid
    best, codes = climbs[5], climbs[6]
    n = last - first
    for i in range(n):
        best[i] = INF
        codes[i] = np.float32(NONE)
    for j in range(4 if rule == RULE_FOUR else 8):
        # Straight steps come first, of equals.
        k = 2 * j if j < 4 else 2 * j - 7
        offers_of_row(cell_cost, cost, climbs, k, first, n, np.uint64(offsets[k]))
        if k & 1 and not corners:
            one, other = np.uint64(offsets[k - 1]), np.uint64(offsets[(k + 1) & 7])
            _shut_diagonals(cell_cost, climbs, first, n, one, other)
        _take_less(climbs, n, np.float32(k))
    for i in range(n):
        if parent is not None:
            parent[first + i] = np.uint8(codes[i]) if cost[first + i] < INF else NONE
        if least is not None:
            least[i] = best[i]


@helper
def point_row_to_parents(grid, climbs, cost, first, last, parent, least):
    """Like `point_to_parents`, for the padded cells first <= cell < last of one row; the root is not left out.

    parent  None if not needed
    least   float32 (last - first,), written: the lowest offer to each, s; None if not needed
    """
    cell_cost, _, stride, rule, corners = grid
    s, begin, end = np.uint64(stride), np.uint64(first), np.uint64(last)
    if climbs is not None:
        _parents_by_climb(grid, climbs, cost, begin, end, parent, least)
    else:
        limit = INF if corners else HUGE
        least_offers(cell_cost, cost, s, begin, end, diagonal_length(rule), limit, parent, least)


@step_kernel(f"({GRID}, CLIMBS, f4[::1], i8, {BOX}, u1[::1])", CLIMBS)
def point_to_parents(grid, climbs, cost, root, box, parent):
    """Writes the parents of the cells of a window: the neighbour with the smallest exit key; of equals the first of
    north, east, south, west, then of the diagonals clockwise."""
    row0, col0, row1, col1 = box
    stride = grid[2]
    for row in range(row0, row1):
        start = (row + 1) * stride + 1
        point_row_to_parents(grid, climbs, cost, start + col0, start + col1, parent, None)
    parent[root] = NONE


@helper
def _leads_on(grid, climbs, labels, v, k):
    """Returns True if a cell's step in direction k is one of its cheapest, and leads to a cell whose parent is
    right."""
    cell_cost, offsets, _, rule, corners = grid
    cost, parent, root = labels
    odd = k & 1
    u = v + offsets[k]
    if (odd and rule == RULE_FOUR) or not cost[u] < INF or (parent[u] == NONE and u != root):
        return False
    if odd and not corners and is_shut(cell_cost, offsets, v, k):
        return False
    return offered(cost[u], cell_cost[u], climbs, v, u, k, step_length(rule, odd)) == cost[v]


@step_kernel(f"({GRID}, CLIMBS, {LABELS}, u4[::1])", CLIMBS)
def untie_parents(grid, climbs, labels, parentless):
    """Replaces parents that cost as much as their cells, for exact costs and parents that follow from them.

    parentless  uint32 (2 * size,), scratch: padded cells that need another parent; behind them, those that have
                got one
    """
    offsets = grid[1]
    cost, parent, root = labels
    count = 0
    for v in range(cost.size):
        if cost[v] < INF and parent[v] != NONE and not cost[v + offsets[parent[v]]] < cost[v]:
            parentless[count] = v
            count += 1
    for i in range(count):
        parent[parentless[i]] = NONE
    done = count
    for i in range(count):
        v = np.int64(parentless[i])
        for k in range(8):
            if parent[v] == NONE and _leads_on(grid, climbs, labels, v, k):
                parent[v] = k
                parentless[done] = v
                done += 1
    while count < done:
        u = np.int64(parentless[count])
        count += 1
        for k in range(8):
            v = u - offsets[k]
            if parent[v] == NONE and v != root and cost[v] < INF and _leads_on(grid, climbs, labels, v, k):
                parent[v] = k
                parentless[done] = v
                done += 1
