"""Pulling a route straight: which of its cells a vehicle turns in, when it drives segments from centre to centre.

A segment costs the integral of the pace of the cells that it crosses, found by Amanatides and Woo, "A fast voxel
traversal algorithm" (1987), with crossings compared as integers. Arrays, of n cells of a route over a map of
rows x cols:
    pace    float32  (rows * cols,)  s for a metre; inf is lethal
    cells   int64    (n,)     the route's cells, neighbours of each other, none lethal
    costs   float64  (2, n)   in paces times cells, from the first cell to each: along the route itself, and pulled
    before  int64    (n,)     index of the cell in which the cheapest pulled way to each one turned last
    turns   int64    (n,)     indices of the cells in which the pulled route turns, its first and last ones included
"""

from __future__ import annotations

import math

import numpy as np

from planner_service.kernels.compile import helper, kernel

LOOK_BACK = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""How many cells back a segment may begin, beside the cell before and where the way to that one turned."""


@helper
def segment_cost(pace, cols, corners, start, end, limit):
    """float64: a segment's cost, in paces times cells; inf if it is not below `limit`, or meets a lethal cell, or a
    lethal one beside a corner that it passes exactly (unless `corners` are cut)."""
    down, right = end // cols - start // cols, end % cols - start % cols
    rows_left, cols_left = abs(down), abs(right)
    length = math.sqrt(np.float64(rows_left * rows_left + cols_left * cols_left))
    if length == 0.0:
        return 0.0
    row_step, col_step = cols if down > 0 else -cols, 1 if right > 0 else -1
    # The k-th line between rows is met at (2k + 1) / (2 * rows) of the way: odd numbers over `whole`, as integers.
    whole = 2 * max(rows_left, 1) * max(cols_left, 1)
    next_row = max(cols_left, 1) if rows_left else whole
    next_col = max(rows_left, 1) if cols_left else whole
    cell, at, total = start, 0, 0.0
    limit *= whole / length
    while next_row < whole or next_col < whole:
        crossing = min(next_row, next_col)
        total += np.float64(pace[np.uint64(cell)]) * (crossing - at)
        if not total < limit:
            return np.inf
        if next_row == next_col and not corners:
            beside = max(pace[np.uint64(cell + row_step)], pace[np.uint64(cell + col_step)])
            if beside == np.inf:
                return np.inf
        on_row, on_col = next_row == crossing, next_col == crossing
        if on_row:
            cell += row_step
            next_row += 2 * max(cols_left, 1)
        if on_col:
            cell += col_step
            next_col += 2 * max(rows_left, 1)
        at = crossing
    total += np.float64(pace[np.uint64(cell)]) * (whole - at)
    return total * (length / whole) if total < limit else np.inf


@kernel("i8(f4[::1], i8, b1, i8[::1], f8[:, ::1], i8[::1], i8[::1])")
def pull(pace, cols, corners, cells, costs, before, turns):
    """Write `costs`, `before` and `turns`; returns how many turns there are. Never dearer than the route itself:
    each cell's pulled cost is at most that of the cell before plus the step between."""
    along, pulled = costs[0], costs[1]
    along[0] = pulled[0] = 0.0
    before[0] = 0
    for j in range(1, cells.size):
        step = segment_cost(pace, cols, corners, cells[j - 1], cells[j], np.inf)
        along[j] = along[j - 1] + step
        best, turn = pulled[j - 1] + step, j - 1
        for back in LOOK_BACK:
            i = j - back
            if i >= 0:
                cost = pulled[i] + segment_cost(pace, cols, corners, cells[i], cells[j], best - pulled[i])
                if cost < best:
                    best, turn = cost, i
        i = before[j - 1]  # straight ways of any length: where the way to the cell before turned, and before that
        while True:
            cost = pulled[i] + segment_cost(pace, cols, corners, cells[i], cells[j], best - pulled[i])
            if cost < best:
                best, turn = cost, i
            elif turn != i:
                break
            if i == 0:
                break
            i = before[i]
        pulled[j], before[j] = best, turn
    count, j = 1, cells.size - 1
    turns[0] = j
    while j > 0:
        j = before[j]
        turns[count] = j
        count += 1
    for i in range(count // 2):
        turns[i], turns[count - 1 - i] = turns[count - 1 - i], turns[i]
    return count
