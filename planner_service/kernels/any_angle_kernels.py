"""Routes pulled straight: the cells in which a vehicle turns when it drives segments from centre to centre.

A segment costs the integral of the pace of the cells that it crosses, found by Amanatides and Woo, "A fast voxel
traversal algorithm" (1987), with crossings compared as integers. For flying classes that integral is multiplied by
the factor of the wind in the segment's direction, and each border between cells costs its climb: as much as the
step over it does, wherever it is crossed. Arrays, of n routes over a map of rows x cols, of which the longest has m
cells:
    pace       float32  (rows * cols,)  s for a metre; inf is lethal
    flight     None for ground classes; for flying ones (height, factors, per_metre, wind):
        height     float32  (rows * cols,)  m, of the surface on which it flies
        factors    float32  (entries,)      of a step by its rise in still air, 1 of a level one in the middle
        per_metre  float32  (2,)   entries of it per metre of rise, of straight steps and of diagonal ones
        wind       (south, east)   what it blows towards, in air speeds
    offsets    int64    (8,)     of `layout.step_offsets(cols)`
    routes     (starts int64 (n,), directions uint8 (sum of steps,), ends int64 (n,)), as `RouteBatch`, and
               stays bool (n,): those that are not to be pulled
    cells      int64    (m,)     those of one route, neighbours of each other
    costs      float64  (2, m)   in paces times cells, from its first cell to each: along the route, and pulled
    before     int64    (m,)     index of the cell in which the cheapest pulled way to each one turned last
    turns      int64    (m,)     indices of the cells in which the pulled route turns, its first and last included
    pulled     (directions uint8 (2 * sum of steps,), ends int64 (n,), legs uint32 (2 * sum of steps,), many int64
               (1,)): steps along the cells that each any-angle route crosses, and the number of them in each of its
               segments; the number of segments
    prices     float64  (3, n)   of each route: cost pulled, cost along the route, both as above, and the length
                                 of the segments in cells
"""

from __future__ import annotations

import math

import numpy as np

from planner_service.kernels.climbs import entry_of
from planner_service.kernels.decorators import helper, step_kernel

LOOK_BACK = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Largest number of cells back at which a segment may begin, beside the cell before and the last turn of the path
to that one."""
NO_CORNERS, OPEN_CORNERS, ALL_CORNERS = range(3)
"""Through an exact corner a segment passes never, between two passable cells only, or always."""


_STEPS = 7, 0, 1, 6, 255, 2, 5, 4, 3
"""Directions of the steps by -1, 0 and 1 rows, of each those by -1, 0 and 1 columns."""
_FLIGHT = "Tuple((f4[::1], f4[::1], f4[::1], UniTuple(f8, 2)))"


@helper
def _flown(flight, down, right, length):
    """float64, cells: how far one comes in still air, while a segment is flown.
    `shared_map.terrain.slope_and_climb` has the formula."""
    if flight is None:
        return length
    south, east = flight[3]
    across, along = east * down - south * right, south * down + east * right
    return (math.sqrt(length * length - across * across) - along) / (1.0 - south * south - east * east)


@helper
def _climb(flight, pace, before, cell, both):
    """float64: what it costs to climb from a cell into the next one, in paces times cells; `both` of a step over
    their corner."""
    if flight is None:
        return 0.0
    height, factors, per_metre, _ = flight
    half = np.float32(factors.size >> 1)
    entry = np.uint64(entry_of(height[cell] - height[before], per_metre[np.int64(both)], half))
    length = math.sqrt(2.0) if both else 1.0
    return (np.float64(factors[entry]) - 1.0) * np.float64(pace[np.uint64(cell)]) * length


@helper
def _drive(pace, flight, cols, corners, start, end, limit, directions, at):
    """(float64: a segment's cost, in paces times cells; the index behind its steps).

    limit       the cost is inf if it is not below this, or the segment meets a lethal cell, or an exact corner that
                it may not pass
    directions  the steps along the cells that it crosses are written there, from index `at` on; None if not needed
    """
    down, right = end // cols - start // cols, end % cols - start % cols
    rows_left, cols_left = abs(down), abs(right)
    length = math.sqrt(np.float64(rows_left * rows_left + cols_left * cols_left))
    if length == 0.0:
        return 0.0, at
    length = _flown(flight, np.float64(down), np.float64(right), length)
    row_step, col_step = cols if down > 0 else -cols, 1 if right > 0 else -1
    # The k-th line between rows is met at (2k + 1) / (2 * rows) of the way: odd numbers over `whole`, as integers.
    whole = 2 * max(rows_left, 1) * max(cols_left, 1)
    next_row = max(cols_left, 1) if rows_left else whole
    next_col = max(rows_left, 1) if cols_left else whole
    cell, met, total = start, 0, 0.0
    limit *= whole / length
    while next_row < whole or next_col < whole:
        crossing = min(next_row, next_col)
        total += np.float64(pace[np.uint64(cell)]) * (crossing - met)
        if not total < limit:
            return np.inf, at
        if next_row == next_col and corners != ALL_CORNERS:
            beside = max(pace[np.uint64(cell + row_step)], pace[np.uint64(cell + col_step)])
            if beside == np.inf or corners == NO_CORNERS:
                return np.inf, at
        on_row, on_col = next_row == crossing, next_col == crossing
        before = cell
        if on_row:
            cell += row_step
            next_row += 2 * max(cols_left, 1)
        if on_col:
            cell += col_step
            next_col += 2 * max(rows_left, 1)
        if directions is not None:
            directions[at] = _STEPS[(1 + on_row * (1 if down > 0 else -1)) * 3 + 1 + on_col * col_step]
            at += 1
        total += _climb(flight, pace, before, cell, on_row and on_col) * (whole / length)
        met = crossing
    total += np.float64(pace[np.uint64(cell)]) * (whole - met)
    return total * (length / whole) if total < limit else np.inf, at


@helper
def _cost(pace, flight, cols, corners, start, end, limit):
    """float64: a segment's cost, as of `_drive`."""
    return _drive(pace, flight, cols, corners, start, end, limit, None, 0)[0]


@helper
def _pull(pace, flight, cols, corners, scratch, size):
    """Writes `costs`, `before` and `turns` of the first `size` cells; returns how many turns there are. Never
    costlier than the route itself: the any-angle cost of each cell is at most that of the cell before plus the step
    between."""
    cells, costs, before, turns = scratch
    along, pulled = costs[0], costs[1]
    along[0] = pulled[0] = 0.0
    before[0] = 0
    for j in range(1, size):
        step = _cost(pace, flight, cols, corners, cells[j - 1], cells[j], np.inf)
        along[j] = along[j - 1] + step
        best, turn = pulled[j - 1] + step, j - 1
        for back in LOOK_BACK:
            i = j - back
            if i >= 0:
                cost = pulled[i] + _cost(pace, flight, cols, corners, cells[i], cells[j], best - pulled[i])
                if cost < best:
                    best, turn = cost, i
        i = before[j - 1]  # straight ways of any length: where the way to the cell before turned, and before that
        while True:
            cost = pulled[i] + _cost(pace, flight, cols, corners, cells[i], cells[j], best - pulled[i])
            if cost < best:
                best, turn = cost, i
            elif turn != i:
                break
            if i == 0:
                break
            i = before[i]
        pulled[j], before[j] = best, turn
    count, j = 1, size - 1
    turns[0] = j
    while j > 0:
        j = before[j]
        turns[count] = j
        count += 1
    for i in range(count // 2):
        turns[i], turns[count - 1 - i] = turns[count - 1 - i], turns[i]
    return count


@helper
def _goes_straight(cols, a, b, c):
    """Returns True if a path over three centres does not turn in the second one."""
    down, right = b // cols - a // cols, b % cols - a % cols
    further_down, further_right = c // cols - b // cols, c % cols - b % cols
    same_line = down * further_right == right * further_down
    return same_line and down * further_down + right * further_right > 0


@step_kernel(
    "void(f4[::1], CLIMBS, i8[::1], i8, Tuple((i8[::1], u1[::1], i8[::1], b1[::1])), "
    "Tuple((i8[::1], f8[:, ::1], i8[::1], i8[::1])), Tuple((u1[::1], i8[::1], u4[::1], i8[::1])), f8[:, ::1])",
    _FLIGHT,
)
def pull_routes(pace, flight, offsets, corners, routes, scratch, pulled, prices):
    """Writes `pulled` and `prices`. A route that is not to be pulled stays as it is, each step a segment; so does
    one that meets a lethal cell, which costs inf."""
    cols = offsets[4]
    starts, directions, ends, stays = routes
    cells, costs, _, turns = scratch
    out, out_ends, legs, many_legs = pulled
    at = many = 0
    begin = np.int64(0)
    for n in range(starts.size):
        size = ends[n] - begin + 1
        cells[0] = starts[n]
        for i in range(1, size):
            cells[i] = cells[i - 1] + offsets[directions[begin + i - 1]]
        prices[0, n] = prices[1, n] = prices[2, n] = 0.0
        if size > 1:
            count = _pull(pace, flight, cols, corners, scratch, size)
            prices[0, n], prices[1, n] = costs[1, size - 1], costs[0, size - 1]
            if prices[0, n] == np.inf or stays[n]:
                prices[0, n] = prices[1, n]
                for i in range(size - 1):
                    out[at + i], legs[many + i] = directions[begin + i], 1
                    prices[2, n] += math.sqrt(2.0) if directions[begin + i] & 1 else 1.0
                at, many = at + size - 1, many + size - 1
                count = 0
            first = 0  # of the segment that is under way, as an index into `turns`
            for i in range(1, count):
                more = i + 1 < count and _goes_straight(
                    cols, cells[turns[first]], cells[turns[i]], cells[turns[i + 1]]
                )
                if more:
                    continue
                start, end = cells[turns[first]], cells[turns[i]]
                down, right = end // cols - start // cols, end % cols - start % cols
                prices[2, n] += math.sqrt(np.float64(down * down + right * right))
                _, until = _drive(pace, flight, cols, corners, start, end, np.inf, out, at)
                legs[many] = until - at
                at, many, first = until, many + 1, i
        begin = ends[n]
        out_ends[n] = at
    many_legs[0] = many
