"""Growths as far as asked: the cells that one may leave out, and what the map's changes leave of a stopped one.

Arrays, beside those of `layout`:
    box         (row0, col0, row1, col1), padded rows and columns; row1 and col1 lie outside
    crop        float32 (rows, cols)  exact costs of the box; inf or less where a cell has none
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.decorators import helper, kernel
from planner_service.kernels.layout import BOX, GRID, INF, NONE, RULE_OCTILE, diagonal_length, is_shut

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


@kernel("(f4[::1], f4[::1], i8, i8, i8[::1], i8[::1])")
def open_cells(cell_cost, cost, stride, root, asked, cells):
    """Writes those of some numbers which are passable cells of the grid to `cells` (n,), padded.

    cost  of a growth that has stopped; it may be empty
    Returns how many they are; how many of them have no cost; and how far the farthest is from the padded root,
    in rows or columns.
    """
    cols = stride - 2
    most = (cell_cost.size // stride - 2) * cols
    row, col = root // stride, root % stride
    count = unknown = away = 0
    for i in range(asked.size):
        down, across = asked[i] // cols + 1, asked[i] % cols + 1
        v = down * stride + across
        if asked[i] >= 0 and asked[i] < most and cell_cost[v] < INF:
            cells[count] = v
            count += 1
            unknown += cost.size == 0 or not cost[v] < INF
            away = max(away, abs(down - row), abs(across - col))
    return count, unknown, away


@helper
def _driven_to(grid, parent, start, root):
    """float64, s: cost of the way from a padded cell along the parents to a neighbour of `root`, and from there to
    `root`. inf if that way passes no neighbour, or is closed by now."""
    cell_cost, offsets, _, rule, corners = grid
    lengths = np.float64(1.0), np.float64(diagonal_length(rule))
    v, driven, least = start, 0.0, np.inf
    for _ in range(parent.size):
        if v == root:
            return driven
        for k in range(8):
            if v + offsets[k] == root and (corners or not k & 1 or not is_shut(cell_cost, offsets, v, k)):
                least = min(least, driven + np.float64(cell_cost[root]) * lengths[k & 1])
        way = parent[v]
        if way == NONE or (way & 1 and not corners and is_shut(cell_cost, offsets, v, way)):
            break
        v += offsets[way]
        driven += np.float64(cell_cost[v]) * lengths[way & 1]
    return least


_AIMED = 4.0
"""No cells are left out while the rest of the ways may be this many times as long as that from the root straight to
the askers: to find out which takes longer than to grow them there."""


@helper
def _sort(askers, boxes):
    """Sorts cells by column 4 of their rows (D. L. Shell, Communications of the ACM 2(7), 1959, 30-32)."""
    gap = askers.size // 2
    while gap > 0:
        for i in range(gap, askers.size):
            cell, bound, j = askers[i], boxes[i, 4], i
            while j >= gap and boxes[j - gap, 4] > bound:
                askers[j], boxes[j, 4] = askers[j - gap], boxes[j - gap, 4]
                j -= gap
            askers[j], boxes[j, 4] = cell, bound
        gap //= 2


@kernel(f"({GRID}, f4[::1], u1[::1], i8[::1], i8, UniTuple(f8, 2), f4[:, ::1])")
def find_aim(grid, cost, parent, askers, root, known, boxes):
    """Finds which cells a growth to a new root may leave out, by upper bounds of what the cheapest ways cost.

    cost    of an older root's tree; inf where a cell has none
    parent  of any tree, which the map's changes since do not make wrong here; it may be empty
    askers  padded, passable cells; sorted by their upper bounds
    known   s; what the cheapest way from that older root to the new one costs at most (inf: `cost` tells nothing),
            and the lowest cell cost
    boxes   (n, 5), written: for each asker and those behind it, the padded rows and columns (row0, col0, row1,
            col1) in which they lie, row1 and col1 among them; and the cost, s, from which on it pays to leave out
            cells
    Returns what none of the ways exceeds, s: inf if nothing is known.
    """
    stride = grid[2]
    between, lowest = known
    for i in range(askers.size):
        boxes[i, 4] = min(np.float64(cost[askers[i]]) + between, _driven_to(grid, parent, askers[i], root))
    _sort(askers, boxes)
    most = np.float64(boxes[askers.size - 1, 4])
    most *= 1.0 + (most / lowest + 8.0) * 2.0**-22  # costs are rounded once for each step
    home_row, home_col = root // stride, root % stride
    row0 = col0 = np.int64(cost.size)
    row1 = col1 = np.int64(0)
    for i in range(askers.size - 1, -1, -1):
        row, col = askers[i] // stride, askers[i] % stride
        row0, row1 = min(row0, row), max(row1, row)
        col0, col1 = min(col0, col), max(col1, col)
        apart = max(max(row0 - home_row, home_row - row1), max(col0 - home_col, home_col - col1))
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = row0, col0, row1, col1
        boxes[i, 4] = most - _AIMED * lowest * apart
    return most
