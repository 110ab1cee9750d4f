"""Reading a tree: routes, their costs, and how far one really drives along the parents; and of a tree that was cut
out of a stopped growth, what the map's changes leave of it.

Routes follow parents, without any search. Arrays, beside those of `layout`; n is the number of routes:
    starts      int64    (n,)    padded cells
    directions  uint8    (sum of steps,)  direction codes 0..7, one route after the other
    ends        int64    (n,)    where each route stops in `directions`; -1 if it met a hole or a cycle, which is a
                                 bug
    driven      float64  (n,)    s; cost recomputed along the cells
    length      float64  (n,)    m
    last        int64    (n,)    last padded cell
    status      uint8    (n,)    OK, UNREACHABLE, OUTSIDE or LETHAL_START
    box         (row0, col0, row1, col1), padded rows and columns; row1 and col1 lie outside
    crop        float32 (rows, cols)  exact costs of the box; inf or less where a cell has none

`pull_routes` pulls routes straight: it finds the cells in which a vehicle turns, when it drives segments from
centre to centre.

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
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, entry_of, step_price
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
        if key < best and (corners or not k & 1 or not is_shut(cell_cost, offsets, v, k)):
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


LOOK_BACK = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Largest number of cells back at which a segment may begin, beside the cell before and the last turn of the path
to that one."""
NO_CORNERS, OPEN_CORNERS, ALL_CORNERS = range(3)
"""Through an exact corner a segment passes never, between two passable cells only, or always."""


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
def segment_cost(pace, flight, cols, corners, start, end, limit):
    """float64: a segment's cost, in paces times cells; inf if it is not below `limit`, or meets a lethal cell, or
    an exact corner that it may not pass."""
    down, right = end // cols - start // cols, end % cols - start % cols
    rows_left, cols_left = abs(down), abs(right)
    length = math.sqrt(np.float64(rows_left * rows_left + cols_left * cols_left))
    if length == 0.0:
        return 0.0
    length = _flown(flight, np.float64(down), np.float64(right), length)
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
        if next_row == next_col and corners != ALL_CORNERS:
            beside = max(pace[np.uint64(cell + row_step)], pace[np.uint64(cell + col_step)])
            if beside == np.inf or corners == NO_CORNERS:
                return np.inf
        on_row, on_col = next_row == crossing, next_col == crossing
        before = cell
        if on_row:
            cell += row_step
            next_row += 2 * max(cols_left, 1)
        if on_col:
            cell += col_step
            next_col += 2 * max(rows_left, 1)
        total += _climb(flight, pace, before, cell, on_row and on_col) * (whole / length)
        at = crossing
    total += np.float64(pace[np.uint64(cell)]) * (whole - at)
    return total * (length / whole) if total < limit else np.inf


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
        step = segment_cost(pace, flight, cols, corners, cells[j - 1], cells[j], np.inf)
        along[j] = along[j - 1] + step
        best, turn = pulled[j - 1] + step, j - 1
        for back in LOOK_BACK:
            i = j - back
            if i >= 0:
                cost = pulled[i] + segment_cost(pace, flight, cols, corners, cells[i], cells[j], best - pulled[i])
                if cost < best:
                    best, turn = cost, i
        i = before[j - 1]  # straight ways of any length: where the way to the cell before turned, and before that
        while True:
            cost = pulled[i] + segment_cost(pace, flight, cols, corners, cells[i], cells[j], best - pulled[i])
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


@helper
def _lay_out(cols, start, end, directions, at):
    """Writes the steps along the cells that a segment crosses, from index `at` on; returns the index behind
    them."""
    down, right = end // cols - start // cols, end % cols - start % cols
    rows_left, cols_left = abs(down), abs(right)
    whole = 2 * max(rows_left, 1) * max(cols_left, 1)
    next_row = max(cols_left, 1) if rows_left else whole
    next_col = max(rows_left, 1) if cols_left else whole
    straight_down, straight_right = np.uint8(4 if down > 0 else 0), np.uint8(2 if right > 0 else 6)
    if down > 0:
        both = np.uint8(3 if right > 0 else 5)
    else:
        both = np.uint8(1 if right > 0 else 7)
    while next_row < whole or next_col < whole:
        if next_row == next_col:
            directions[at] = both
        else:
            directions[at] = straight_down if next_row < next_col else straight_right
        on_row, on_col = next_row <= next_col, next_col <= next_row
        if on_row:
            next_row += 2 * max(cols_left, 1)
        if on_col:
            next_col += 2 * max(rows_left, 1)
        at += 1
    return at


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
                until = _lay_out(cols, start, end, out, at)
                legs[many] = until - at
                at, many, first = until, many + 1, i
        begin = ends[n]
        out_ends[n] = at
    many_legs[0] = many
