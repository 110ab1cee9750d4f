"""Trees that were cut out of a growth which has stopped: what the map's changes leave of them, and their routes.

Arrays, beside those of `layout`:
    box   (row0, col0, row1, col1), padded rows and columns; row1 and col1 lie outside
    crop  float32 (rows, cols)  exact costs of the box; inf or less where a cell has none
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.decorators import helper, kernel
from planner_service.kernels.layout import BOX, GRID, INF, NONE, RULE_OCTILE, SQRT2_EXACT, diagonal_length

_DETOUR = 0.4142135
"""Least that a diagonal octile step costs beyond a straight one, in straight ones."""


@helper
def _cost_in(crop, box, row, col):
    """A padded cell's cost; inf outside the box, and where it has none."""
    row0, col0, row1, col1 = box
    if row < row0 or row >= row1 or col < col0 or col >= col1:
        return INF
    c = crop[row - row0, col - col0]
    return c if c >= 0 else INF


@kernel("(u4[::1], i8)")
def box_of(cells, stride):
    """The box of some padded cells, at least one. Divides in float64, which vectorises and is exact here."""
    row0 = col0 = np.int32((1 << 31) - 1)
    row1 = col1 = np.int32(0)
    share = 1.0 / stride
    for i in range(cells.size):
        v = np.int32(cells[i])
        row = np.int32((v + 0.5) * share)
        col = np.int32(v - row * np.int32(stride))
        row0, row1 = min(row0, row), max(row1, row)
        col0, col1 = min(col0, col), max(col1, col)
    return row0, col0, row1 + 1, col1 + 1


@kernel(f"({GRID}, {BOX}, f4[:, ::1], i8[::1], f4[::1], f8, i8[::1], UniTuple(f8, 2), u1[::1])")
def stays_exact(grid, box, crop, cells, before, bound, route, known, mark):
    """Looks at changes of the map since a tree was cut out.

    cells, before  int64 padded cells that have changed, and float32 cell costs as they were; a cell may occur twice
    bound          s; no cell without a cost cost less
    route          int64 padded cells of a cheapest route from a start to the root; it may be empty
    known          what it costs by `crop`, s, and the lowest cell cost now
    mark           uint8 (size,), zeros; zeros afterwards
    Returns the cost, s, below which all costs are as they were; and whether the route is one of the cheapest yet.

    A change matters only from the exit key of its cell on. A route stays cheapest if none of its cells costs more,
    none of the corners that it cuts is shut, and no way over a cell that costs less can cost less than it.
    """
    cell_cost, offsets, stride, rule, _ = grid
    at_start, lowest = known
    level = bound
    stands = route.size > 0
    for i in range(route.size):
        mark[route[i]] = 1
    for i in range(cells.size):
        v = cells[i]
        row = v // stride
        col = v - row * stride
        now, old = cell_cost[v], before[i]
        own = _cost_in(crop, box, row, col)
        least = np.float64(own)
        level = min(level, np.float64(own) + np.float64(min(now, old)))
        if (now < INF) != (old < INF):
            # Its neighbours offer to it, or past its corner.
            for k in range(8):
                u = v + offsets[k]
                c = np.float64(_cost_in(crop, box, u // stride, u % stride))
                level = min(level, c + cell_cost[u])
                least = min(least, c)
        if now > old:
            stands = stands and not mark[v]
            if not now < INF:
                for k in range(0, 8, 2):
                    stands = stands and not mark[v + offsets[k]]
        elif stands and now < old:
            down, across = abs(row - route[0] // stride), abs(col - route[0] % stride)
            steps = max(down, across) + (_DETOUR * min(down, across) if rule == RULE_OCTILE else 0.0)
            there = max(steps - 2.0, 0.0) * lowest
            stands = there + min(least, bound) >= at_start * (1.0 - 1e-6)
    for i in range(route.size):
        mark[route[i]] = 0
    return level, stands


@helper
def _cheapest_way(grid, cost, beside, v, at):
    """The direction of the least offer to padded cell `v`, which is cell `at` of `cost`, and what direction k adds
    to that is beside[k]; of equals the first as in `parents_from_costs`. NONE if there is none."""
    cell_cost, offsets, _, rule, corners = grid
    lengths = np.float32(1.0), diagonal_length(rule)
    best, way = INF, NONE
    for j in range(8):
        k = 2 * j if j < 4 else 2 * j - 7
        key = cost[at + beside[k]] + cell_cost[v + offsets[k]] * lengths[k & 1]
        if key < best:
            shut = max(cell_cost[v + offsets[k - (k & 1)]], cell_cost[v + offsets[(k + 1) & 7]]) == INF
            if not (k & 1 and shut and not corners):
                best, way = key, np.uint8(k)
    return way


@kernel(f"({GRID}, f4[::1], i8, i8[::1], u1[::1], u4[::1], i8)")
def point_routes(grid, cost, root, starts, parent, pointed, count):
    """Writes the parents of the cells on the routes from padded, passable cells to the root, of those which have
    one.

    cost     of a growth that has stopped: exact, inf where a cell has none, WALL where it is lethal
    pointed  uint32 (size,), the cells which have a parent, `count` until now. Those with new ones are put behind
    Returns how many there are.
    """
    offsets = grid[1]
    for i in range(starts.size):
        v = starts[i]
        while cost[v] < INF and v != root and parent[v] == NONE:
            parent[v] = _cheapest_way(grid, cost, offsets, v, v)
            pointed[count] = v
            count += 1
            v += offsets[parent[v]]
    return count


@kernel(f"({GRID}, {BOX}, f4[::1], f4[::1], UniTuple(i8, 3), u1[::1])")
def walk_by_costs(grid, box, crop, time_cost, ends, directions):
    """Writes the directions of a cheapest route by costs alone; of equals the first as in `parents_from_costs`.

    crop       one row of it after the other. All neighbours of a cell with a cost lie in the box
    time_cost  float32 (size,), s, of a straight step into a padded cell
    ends       padded cells, a start that has a cost and the root; and the number of steps of the first part
    Returns the steps, or -1 if it does not end at the root within as many as have room; diagonal ones of the first
    part; what it takes, s, all and the first part.
    """
    _, offsets, stride, rule, _ = grid
    v, root, part = ends
    row0, col0, _, col1 = box
    width = col1 - col0
    beside = (-width, 1 - width, 1, width + 1, width, width - 1, -1, -width - 1)
    at = (v // stride - row0) * width + v % stride - col0
    n = slanted = 0
    driven = first = 0.0
    while v != root:
        way = _cheapest_way(grid, crop, beside, v, at)
        if way == NONE or n == directions.size:
            return -1, 0, 0.0, 0.0
        directions[n] = way
        n += 1
        v += offsets[way]
        at += beside[way]
        step = np.float64(time_cost[v]) * (SQRT2_EXACT if way & 1 and rule == RULE_OCTILE else 1.0)
        driven += step
        if n <= part:
            first += step
            slanted += way & 1
    return n, slanted, driven, first
