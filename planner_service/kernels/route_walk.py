"""Reading a tree: routes, their costs, and how far one really drives along the parents.

Routes follow parents, without any search. Arrays, beside those of `layout`; n is the number of routes:
    starts      int64    (n,)    padded cells that have a way
    directions  uint8    (sum of steps,)  direction codes 0..7, one route after the other
    ends        int64    (n,)    where each route stops in `directions`; -1 if it met a hole or a cycle, which is a
                                 bug
    driven      float64  (n,)    s; cost recomputed along the cells
    diagonals   int64    (n,)    how many of its steps are diagonal
    last        int64    (n,)    last padded cell
    status      uint8    (n,)    OK, UNREACHABLE, OUTSIDE or LETHAL_START
    prices      float64  (4, n)  cost_s, lower_bound_s, length_m and remaining_s; inf, 0, 0, 0 where there is no
                                 route
    trails      uint8    (4, room)  directions of the routes that were walked in each lane, one after the other
    lanes       int64    (5, 4)     of each lane: its route, the first one that is not its own any more, where its
                                    route begins in the trail, how long the trail is, the padded cell it has come to
    sums        float64  (4,)       s; what each lane's route has cost so far
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, offered, step_price
from planner_service.kernels.compile import helper, kernel, step_kernel
from planner_service.kernels.layout import (
    GRID,
    INF,
    LABELS,
    NONE,
    RULE_OCTILE,
    SQRT2_EXACT,
    check_cells,
    step_length,
    step_offsets,
)

OK, UNREACHABLE, OUTSIDE, LETHAL_START = range(4)
"""What became of a route that was asked for."""

Moves = tuple[NDArray[np.uint64], NDArray[np.float64]]
Lanes = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.uint8]]
_WALKS = "Tuple((i8[::1], f8[::1], i8[::1], i8[::1]))"
_WALK = "Tuple((i8[:, ::1], f8[::1], u1[:, ::1]))"

_LANES = 4
"""Routes that are walked side by side. A step waits for the one before it, but not for another route's."""
_ROUTE, _UNTIL, _BEGUN, _FILL, _CELL = range(5)
"""Rows of `lanes`."""
_STRETCH = 32
"""Steps between two looks at whether a lane's route has ended; a route that has stands still meanwhile."""


@step_kernel(f"({GRID}, CLIMBS, {LABELS}, u4[::1])", CLIMBS)
def relabel(grid, climbs, labels, trail):
    """Costs := what is really driven from each cell along its parents. They are written whole; parents are read.
    `trail` has room for all cells."""
    cell_cost, offsets, _, rule, _ = grid
    cost, parent, root = labels
    unknown = np.float32(-1.0)
    for i in range(cost.size):
        cost[i] = unknown if parent[i] != NONE else INF
    cost[root] = np.float32(0.0)
    for i in range(cost.size):
        v = i
        many = 0
        while cost[v] == unknown:
            trail[many] = v
            many += 1
            v += offsets[parent[v]]
        for j in range(many - 1, -1, -1):
            v = np.int64(trail[j])
            k = parent[v]
            u = v + offsets[k]
            cost[v] = offered(cost[u], cell_cost[u], climbs, v, u, k, step_length(rule, k & 1))


@helper
def _driven(cell_cost, climbs, lengths, before, cell, code):
    """float64, s: what the step costs that led from `before` to a cell; 0 beyond a route's end."""
    own = np.float64(cell_cost[cell])
    if climbs is None:
        return own * lengths[code]
    return own * np.float64(step_price(climbs, before, cell, code)) if code != NONE else 0.0


@helper
def _walk_on(cell_cost, climbs, parent, moves, lanes, sums, trails, steps):
    """Go `steps` steps on, in all lanes; steps beyond a route's end have the code NONE, and cost nothing."""
    offsets, lengths = moves
    a, b, c, d = (
        np.uint64(lanes[_CELL, 0]),
        np.uint64(lanes[_CELL, 1]),
        np.uint64(lanes[_CELL, 2]),
        np.uint64(lanes[_CELL, 3]),
    )
    sum_a, sum_b, sum_c, sum_d = sums[0], sums[1], sums[2], sums[3]
    at_a, at_b, at_c, at_d = (
        np.uint64(lanes[_FILL, 0]),
        np.uint64(lanes[_FILL, 1]),
        np.uint64(lanes[_FILL, 2]),
        np.uint64(lanes[_FILL, 3]),
    )
    for i in range(np.uint64(steps)):
        code_a, code_b, code_c, code_d = parent[a], parent[b], parent[c], parent[d]
        trails[0, at_a + i] = code_a
        trails[1, at_b + i] = code_b
        trails[2, at_c + i] = code_c
        trails[3, at_d + i] = code_d
        from_a, from_b, from_c, from_d = a, b, c, d
        a += offsets[code_a]
        b += offsets[code_b]
        c += offsets[code_c]
        d += offsets[code_d]
        sum_a += _driven(cell_cost, climbs, lengths, from_a, a, code_a)
        sum_b += _driven(cell_cost, climbs, lengths, from_b, b, code_b)
        sum_c += _driven(cell_cost, climbs, lengths, from_c, c, code_c)
        sum_d += _driven(cell_cost, climbs, lengths, from_d, d, code_d)
    lanes[_CELL, 0], lanes[_CELL, 1], lanes[_CELL, 2], lanes[_CELL, 3] = (
        np.int64(a),
        np.int64(b),
        np.int64(c),
        np.int64(d),
    )
    sums[0], sums[1], sums[2], sums[3] = sum_a, sum_b, sum_c, sum_d


def moves_of(stride: int, rule: int) -> Moves:
    """Of each direction code, what it adds to a padded cell (uint64) and its length in straight steps (float64).

    Beyond the codes of directions, NONE: to stay, at no cost. Unsigned, as sums of a cell and a signed offset would
    be floating-point numbers; they wrap.
    """
    offsets, lengths = np.zeros(256, np.uint64), np.zeros(256, np.float64)
    offsets[:8] = step_offsets(stride).astype(np.uint64)
    lengths[:8] = 1.0
    if rule == RULE_OCTILE:
        lengths[1:8:2] = SQRT2_EXACT
    return offsets, lengths


def make_lanes() -> Lanes:
    """(lanes, sums, trails), for routes of usual length; `longer` for others."""
    return np.empty((5, _LANES), np.int64), np.empty(_LANES, np.float64), np.empty((_LANES, 1024), np.uint8)


def longer(walk: Lanes) -> Lanes:
    """The same lanes, their trails with twice the room."""
    lanes, sums, trails = walk
    room = trails.shape[1]
    twice = np.empty((_LANES, 2 * room), np.uint8)
    twice[:, :room] = trails
    return lanes, sums, twice


@step_kernel(
    f"(f4[::1], CLIMBS, u1[::1], Tuple((u8[::1], f8[::1])), i8, i8[::1], UniTuple(i8, 2), {_WALKS}, {_WALK}, b1)",
    CLIMBS,
)
def walk_routes(cell_cost, climbs, parent, moves, root, starts, most, walks, walk, anew):
    """The routes from `starts` to a padded root. `join_routes` is to follow.

    moves  as `moves_of` returns them
    most   (steps of a route, 0 for all of it; no route can be longer than so many)
    walks  (ends, driven, diagonals, last), written: all but `diagonals`, and `ends` in the lane's trail
    walk   as `make_lanes` returns them
    anew   begin with the first routes; if not, go on
    Raises ValueError where a start is no padded cell. Returns how many steps all routes have; -1 if the trails have
    no room for the next ones: call it again with longer ones to go on.
    """
    ends, driven, _, last = walks
    lanes, sums, trails = walk
    count = starts.size
    limit = most[1]
    longest = limit if most[0] <= 0 else min(limit, most[0])
    if anew:
        check_cells(starts, parent.size)
        # Each lane has a share of the routes, and its trail holds them in order.
        for j in range(_LANES):
            first = count * j // _LANES
            lanes[_ROUTE, j] = first
            lanes[_UNTIL, j] = count * (j + 1) // _LANES
            lanes[_BEGUN, j] = 0
            lanes[_FILL, j] = 0
            lanes[_CELL, j] = starts[first] if first < lanes[_UNTIL, j] else root
            sums[j] = 0.0
    while True:
        steps = np.int64(0)  # a literal would have `_walk_on` compiled twice
        room = trails.shape[1]
        for j in range(_LANES):
            room = min(room, trails.shape[1] - lanes[_FILL, j])
            if lanes[_ROUTE, j] < lanes[_UNTIL, j]:
                left = min(_STRETCH, longest - (lanes[_FILL, j] - lanes[_BEGUN, j]))
                steps = left if steps == 0 else min(steps, left)
        if steps == 0:
            break
        if steps > room:
            return -1
        _walk_on(cell_cost, climbs, parent, moves, lanes, sums, trails, steps)
        for j in range(_LANES):
            r = lanes[_ROUTE, j]
            if r == lanes[_UNTIL, j]:
                continue
            begun = lanes[_BEGUN, j]
            end = lanes[_FILL, j] + steps
            while end > begun and trails[j, end - 1] == NONE:
                end -= 1
            lanes[_FILL, j] = end
            v = lanes[_CELL, j]
            if parent[v] != NONE and end - begun < longest:
                continue
            broken = v != root and (parent[v] == NONE or end - begun == limit)
            ends[r] = -1 if broken else end
            driven[r] = sums[j]
            last[r] = v
            r += 1
            lanes[_ROUTE, j] = r
            lanes[_BEGUN, j] = end
            lanes[_CELL, j] = starts[r] if r < lanes[_UNTIL, j] else root
            sums[j] = 0.0
    return lanes[_FILL, 0] + lanes[_FILL, 1] + lanes[_FILL, 2] + lanes[_FILL, 3]


@kernel(f"({_WALKS}, {_WALK}, u1[::1])")
def join_routes(walks, walk, directions):
    """Put the trails of all lanes into one row, `directions`. Ends of routes in their lane's trail become their
    ends in that row; `diagonals` is written."""
    ends, _, diagonals, _ = walks
    lanes, _, trails = walk
    count = ends.size
    n = 0
    for j in range(_LANES):
        for i in range(lanes[_FILL, j]):
            directions[n + i] = trails[j, i]
        for r in range(count * j // _LANES, count * (j + 1) // _LANES):
            ends[r] += n if ends[r] >= 0 else 0
        n += lanes[_FILL, j]
    n = 0
    for r in range(count):
        odd = 0
        for i in range(n, ends[r]):
            odd += directions[i] & 1
        diagonals[r] = odd
        n = max(n, ends[r])


@helper
def _hash(cell):
    """uint64 of 32 bits (D. E. Knuth, "The art of computer programming", vol. 3, 6.4: multiplicative hashing)."""
    return (np.uint64(cell) * np.uint64(0x9E3779B1)) & np.uint64(0xFFFFFFFF)


@step_kernel(
    "(f4[::1], CLIMBS, u1[::1], Tuple((u8[::1], f8[::1])), i8, i8[::1],"
    " Tuple((u4[::1], f8[::1])), Tuple((u4[::1], f8[::1])), f8[::1])",
    CLIMBS,
)
def drive_rests(cell_cost, climbs, parent, moves, root, starts, known, trail, rests):
    """What is driven from each start along the parents to the root, in float64; inf where there is no way.

    known  (cells, sums), the rests that are known already of a 16th of all cells, the milestones: their routes
           share their trunks. Cells are 0 before; there are a power of two, at most 2**16. Written
    trail  (cells, sums) of the milestones that one route meets first; room for all cells
    rests  float64 (n,), s; written whole
    A rest is the sum up to the first milestone plus the milestone's own, and so the same whoever else is asked for.
    Returns False if a route does not end.
    """
    offsets, lengths = moves
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


@kernel("(f4[::1], u1[::1], i8, i8, i8[::1], i8[::1], u1[::1])")
def find_starts(cell_cost, parent, stride, root, asked, starts, status):
    """Where routes from `asked` cells (int64, of the grid) start, padded, and whether there is one.

    Written: starts (int64; the root where there is no route, so that none is walked), status (uint8).
    """
    cols = stride - 2
    cells = (cell_cost.size // stride - 2) * cols
    for i in range(asked.size):
        cell = asked[i]
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


@kernel(f"(UniTuple(f8, 2), {_WALKS}, f8[::1], u1[::1], f8[:, ::1])")
def price_routes(metres, walks, rests, status, prices):
    """What walked routes cost and how long they are.

    metres  (resolution, m; length of a diagonal in straight steps)
    walks   (ends, driven, diagonals, last) as `walk_routes` and `join_routes` wrote them
    rests   float64 (n,), s; what is driven from where each ends
    prices  written, but for the bound of a route that there is
    Returns False if a route does not end where it should.
    """
    resolution, diagonal = metres
    ends, driven, diagonals, _ = walks
    begin = 0
    for i in range(status.size):
        if status[i] != OK:
            prices[0, i] = np.inf
            prices[1, i] = 0.0
            prices[2, i] = 0.0
            prices[3, i] = 0.0
            continue
        if ends[i] < 0:
            return False
        length = (np.float64(ends[i] - begin) + np.float64(diagonals[i]) * (diagonal - 1.0)) * resolution
        begin = ends[i]
        prices[0, i] = driven[i] + rests[i]
        prices[2, i] = length
        prices[3, i] = rests[i]
    return True
