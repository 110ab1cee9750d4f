"""Routes read off a tree: their cells, their costs, and how far one really drives along the parents.

Routes follow parents, or costs where a growth has stopped, without any search. Arrays, beside those of `layout`; n
is the number of routes:
    starts      int64    (n,)    padded cells
    directions  uint8    (sum of steps,)  direction codes 0..7, one route after the other
    ends        int64    (n,)    where each route stops in `directions`; -1 if it met a hole or a cycle, which is a
                                 bug
    driven      float64  (n,)    s; cost recomputed along the cells
    length      float64  (n,)    m
    last        int64    (n,)    last padded cell
    status      uint8    (n,)    OK, UNREACHABLE, OUTSIDE or LETHAL_START
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, step_price
from planner_service.kernels.decorators import helper, kernel, step_kernel
from planner_service.kernels.layout import (
    BOX,
    GRID,
    INF,
    NONE,
    RULE_OCTILE,
    SQRT2_EXACT,
    check_cells,
    diagonal_length,
    is_shut,
    step_offsets,
)

OK, UNREACHABLE, OUTSIDE, LETHAL_START = range(4)
"""Result of a requested route."""
BROKEN = -2
"""Returned by `walk_routes` instead of a number of steps."""

Moves = tuple[NDArray[np.uint64], NDArray[np.float64]]
Ways = tuple[NDArray[np.uint8], NDArray[np.uint64], NDArray[np.float64], int, int]
"""(parent, offsets, lengths, root, stride): the parents, what `moves_of` returns, the padded root."""
_WAYS = "Tuple((u1[::1], u8[::1], f8[::1], i8, i8))"
_WALKS = "Tuple((u1[::1], i8[::1], f8[::1], f8[::1], i8[::1]))"


@helper
def _driven(cell_cost, climbs, lengths, before, cell, code):
    """float64, s: what the step costs that led from `before` to a cell."""
    own = np.float64(cell_cost[cell])
    if climbs is None:
        return own * lengths[code]
    return own * np.float64(step_price(climbs, before, cell, code))


def moves_of(stride: int, rule: int) -> Moves:
    """Returns for each direction code the offset of a padded cell (uint64) and the length in straight steps
    (float64).

    Unsigned, as sums of a cell and a signed offset would be floating-point numbers; they wrap.
    """
    lengths = np.ones(8, np.float64)
    if rule == RULE_OCTILE:
        lengths[1::2] = SQRT2_EXACT
    return step_offsets(stride).astype(np.uint64), lengths


@helper
def _find_starts(cell_cost, ways, starts, status):
    """Cells of the grid become padded ones: the root where there is no route, so that none is walked."""
    parent, _, _, root, stride = ways
    cols = stride - 2
    cells = (cell_cost.size // stride - 2) * cols
    for i in range(starts.size):
        cell = starts[i]
        starts[i] = root
        if cell < 0 or cell >= cells:
            status[i] = OUTSIDE
            continue
        v = (cell // cols + 1) * stride + cell % cols + 1
        if not cell_cost[v] < INF:
            status[i] = LETHAL_START
        elif parent[v] == NONE and v != root:
            status[i] = UNREACHABLE
        else:
            status[i] = OK
            starts[i] = v


@step_kernel(f"(f4[::1], CLIMBS, {_WAYS}, i8[::1], UniTuple(i8, 2), UniTuple(f8, 2), {_WALKS}, u1[::1])", CLIMBS)
def walk_routes(cell_cost, climbs, ways, starts, most, metres, walks, directions):
    """The routes from `starts` to the root.

    starts      padded cells that have a path; or, if `status` is not empty, any numbers of cells of the grid. Then
                these become padded cells, and `status` is written
    most        (steps of a route, 0 for all of it; the longest possible route)
    metres      (resolution, m; length of a diagonal in straight steps)
    walks       (status, ends, driven, length, last), written; inf, 0 m and the root where `status` says that there
                is no route
    directions  written, as far as there is room
    Raises ValueError where a start is no padded cell. Returns how many steps all routes have, for which there may
    be no room; BROKEN if a route with a status has no end.
    """
    parent, offsets, lengths, root, _ = ways
    status, ends, driven, length, last = walks
    resolution, diagonal = metres
    longest = most[1] if most[0] <= 0 else min(most[1], most[0])
    if status.size:
        _find_starts(cell_cost, ways, starts, status)
    check_cells(starts, parent.size)
    home, room, end = np.uint64(root), np.uint64(directions.size), np.uint64(0)
    for r in range(starts.size):
        v, begin = np.uint64(starts[r]), end
        until = begin + np.uint64(longest)
        odd, sum = 0, 0.0
        code = parent[v]
        while code != NONE and end < until:
            u = v + offsets[code]
            sum += _driven(cell_cost, climbs, lengths, v, u, code)
            if end < room:
                directions[end] = code
            odd += code & 1
            end += np.uint64(1)
            v, code = u, parent[u]
        steps = np.int64(end - begin)
        broken = v != home and (code == NONE or steps == most[1])
        ends[r] = -1 if broken else np.int64(end)
        driven[r] = sum
        last[r] = np.int64(v)
        length[r] = (np.float64(steps) + np.float64(odd) * (diagonal - 1.0)) * resolution
        if r < status.size and status[r] != OK:
            driven[r] = np.inf
        elif r < status.size and broken:
            return np.int64(BROKEN)
    return np.int64(end)


@helper
def _hash(cell):
    """uint64 of 32 bits (D. E. Knuth, "The art of computer programming", vol. 3, 6.4: multiplicative hashing)."""
    return (np.uint64(cell) * np.uint64(0x9E3779B1)) & np.uint64(0xFFFFFFFF)


@step_kernel(
    f"(f4[::1], CLIMBS, {_WAYS}, i8[::1], Tuple((u4[::1], f8[::1])), Tuple((u4[::1], f8[::1])), f8[::1])", CLIMBS
)
def drive_rests(cell_cost, climbs, ways, starts, known, trail, rests):
    """Computes the cost driven from each start along the parents to the root, in float64; inf without a path.

    known  (cells, sums), the rests that are known already of a 16th of all cells, the milestones: their routes
           share their trunks. Cells are 0 before; there are a power of two, at most 2**16. Written
    trail  (cells, sums) of the milestones that one route meets first; room for all cells
    rests  float64 (n,), s; written whole A rest is the sum up to the first milestone plus the milestone's own, and
           so does not depend on the other starts.
    Returns False if a route does not end.
    """
    parent, offsets, lengths, root, _ = ways
    known_cells, known_sums = known
    trail_cells, trail_sums = trail
    check_cells(starts, parent.size)
    mask = np.uint64(known_cells.size - 1)
    for i in range(starts.size):
        v = np.uint64(starts[i])
        many = 0
        steps = 0
        own = 0.0
        rest = 0.0
        while v != np.uint64(root):
            mixed = _hash(v)
            if mixed >> np.uint64(28) == 0:
                slot = (mixed >> np.uint64(12)) & mask
                if known_cells[slot] == v:
                    rest = known_sums[slot]
                    break
                trail_cells[many] = v
                trail_sums[many] = own
                many += 1
                own = 0.0
            code = parent[v]
            steps += 1
            if code == NONE or steps > parent.size:
                break
            u = v + offsets[code]
            own += _driven(cell_cost, climbs, lengths, v, u, code)
            v = u
        if steps > parent.size:
            return False
        if parent[v] == NONE and v != np.uint64(root):
            rests[i] = np.inf
            continue
        for j in range(many - 1, -1, -1):
            rest += own
            own = trail_sums[j]
            slot = (_hash(trail_cells[j]) >> np.uint64(12)) & mask
            known_cells[slot] = trail_cells[j]
            known_sums[slot] = rest
        rests[i] = own + rest
    return True


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
        if key < best and (corners or not k & 1 or not is_shut(cell_cost, offsets, v, k)):
            best, way = key, np.uint8(k)
    return way


@kernel(f"({GRID}, {BOX}, f4[::1], i8, i8[::1], u1[::1], u4[::1], i8)")
def point_routes(grid, box, cost, root, starts, parent, pointed, count):
    """Writes the parents of the cells on the routes from padded, passable cells to the root, of those which have
    one.

    box   of a growth that has stopped, padded rows and columns; row1 and col1 lie outside. It holds all starts, and
          all neighbours of a cell with a cost
    cost  of the cells of the box, row by row: exact costs, inf where a cell has none, WALL where it is lethal
    pointed  uint32 (size,), the cells which have a parent, `count` until now. Those with new ones are put behind
    Returns how many there are.
    """
    _, offsets, stride, _, _ = grid
    row0, col0, _, col1 = box
    width = col1 - col0
    beside = (-width, 1 - width, 1, width + 1, width, width - 1, -1, -width - 1)
    for i in range(starts.size):
        v = starts[i]
        at = (v // stride - row0) * width + v % stride - col0
        while cost[at] < INF and v != root and parent[v] == NONE:
            way = _cheapest_way(grid, cost, beside, v, at)
            if way == NONE:  # a bug, which the reader of the route notices
                break
            parent[v] = way
            pointed[count] = v
            count += 1
            v += offsets[way]
            at += beside[way]
    return count
