"""Reading a tree: routes, their costs, and how far one really drives along the parents.

Routes follow parents, without any search. Arrays, beside those of `layout`; n is the number of routes:
    starts      int64    (n,)    padded cells
    directions  uint8    (sum of steps,)  direction codes 0..7, one route after the other
    ends        int64    (n,)    where each route stops in `directions`; -1 if it met a hole or a cycle, which is a
                                 bug
    driven      float64  (n,)    s; cost recomputed along the cells
    length      float64  (n,)    m
    last        int64    (n,)    last padded cell
    status      uint8    (n,)    OK, UNREACHABLE, OUTSIDE or LETHAL_START
    trails      uint8    (4, room)  directions of the routes that were walked in each lane, one after the other
    lanes       int64    (5, 4)     of each lane: its route, the first one that is not its own any more, where its
                                    route begins in the trail, how long the trail is, the padded cell it has come to
    sums        float64  (4,)       s; what each lane's route has cost so far
    joined      uint8    (4 * room,)  the trails of all lanes, one after the other: `directions`, and room behind
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, offered, step_price
from planner_service.kernels.compile import helper, step_kernel
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
Ways = tuple[NDArray[np.uint8], NDArray[np.uint64], NDArray[np.float64], int, int]
"""(parent, offsets, lengths, root, stride): the parents, what `moves_of` returns, the padded root."""
Lanes = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.uint8], NDArray[np.uint8]]
_WAYS = "Tuple((u1[::1], u8[::1], f8[::1], i8, i8))"
_WALKS = "Tuple((u1[::1], i8[::1], f8[::1], f8[::1], i8[::1]))"
_WALK = "Tuple((i8[:, ::1], f8[::1], u1[:, ::1], u1[::1]))"

_LANES = 4
"""Routes that are walked side by side. A step waits for the one before it, but not for another route's."""
_ROUTE, _UNTIL, _BEGUN, _FILL, _CELL = range(5)
"""Rows of `lanes`."""
NO_ROOM, BROKEN = -1, -2
"""What `walk_routes` returns instead of a number of steps."""
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
def _walk_on(cell_cost, climbs, ways, lanes, sums, trails, steps):
    """Go `steps` steps on, in all lanes; steps beyond a route's end have the code NONE, and cost nothing."""
    parent, offsets, lengths, _, _ = ways
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
    """(lanes, sums, trails, joined), for routes of usual length; `longer` for others."""
    return np.empty((5, _LANES), np.int64), np.empty(_LANES, np.float64), *_trails(1024)


def _trails(room: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    return np.empty((_LANES, room), np.uint8), np.empty(_LANES * room, np.uint8)


def longer(walk: Lanes) -> Lanes:
    """The same lanes, their trails with twice the room."""
    lanes, sums, trails, _ = walk
    room = trails.shape[1]
    twice, joined = _trails(2 * room)
    twice[:, :room] = trails
    return lanes, sums, twice, joined


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


@helper
def _begin(lanes, sums, starts, root):
    """Each lane has a share of the routes, and its trail holds them in order."""
    count = starts.size
    for j in range(_LANES):
        first = count * j // _LANES
        lanes[_ROUTE, j] = first
        lanes[_UNTIL, j] = count * (j + 1) // _LANES
        lanes[_BEGUN, j] = 0
        lanes[_FILL, j] = 0
        lanes[_CELL, j] = starts[first] if first < lanes[_UNTIL, j] else root
        sums[j] = 0.0


@helper
def _join(walks, walk, metres):
    """Put the trails of all lanes into one row. Ends of routes in their lane's trail become their ends in that row;
    lengths are written. Returns how many steps all have; BROKEN if a route that was looked for has no end."""
    status, ends, driven, length, _ = walks
    lanes, _, trails, joined = walk
    resolution, diagonal = metres
    count = ends.size
    n = 0
    for j in range(_LANES):
        for i in range(lanes[_FILL, j]):
            joined[n + i] = trails[j, i]
        for r in range(count * j // _LANES, count * (j + 1) // _LANES):
            ends[r] += n if ends[r] >= 0 else 0
        n += lanes[_FILL, j]
    begin = 0
    for r in range(count):
        odd = 0
        for i in range(begin, ends[r]):
            odd += joined[i] & 1
        end = max(begin, ends[r])
        length[r] = (np.float64(end - begin) + np.float64(odd) * (diagonal - 1.0)) * resolution
        begin = end
        if r < status.size and status[r] != OK:
            driven[r] = np.inf
        elif r < status.size and ends[r] < 0:
            return np.int64(BROKEN)
    return n


@step_kernel(f"(f4[::1], CLIMBS, {_WAYS}, i8[::1], UniTuple(i8, 3), UniTuple(f8, 2), {_WALKS}, {_WALK})", CLIMBS)
def walk_routes(cell_cost, climbs, ways, starts, most, metres, walks, walk):
    """The routes from `starts` to the root.

    starts  padded cells that have a way; or, if `status` is not empty, any numbers of cells of the grid. Then these
            become padded cells, and `status` is written
    most    (steps of a route, 0 for all of it; no route can be longer than so many; 1 to begin, 0 to go on)
    metres  (resolution, m; length of a diagonal in straight steps)
    walks   (status, ends, driven, length, last), written; inf, 0 m and the root where `status` says that there is
            no route
    walk    as `make_lanes` returns them; `joined` is written
    Raises ValueError where a start is no padded cell. Returns how many steps all routes have; NO_ROOM if the trails
    have none for the next ones: call it again with longer ones to go on; BROKEN if a route with a status has no
    end.
    """
    parent, _, _, root, _ = ways
    status, ends, driven, _, last = walks
    lanes, sums, trails, _ = walk
    limit = most[1]
    longest = limit if most[0] <= 0 else min(limit, most[0])
    if most[2]:
        if status.size:
            _find_starts(cell_cost, ways, starts, status)
        check_cells(starts, parent.size)
        _begin(lanes, sums, starts, root)
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
            return np.int64(NO_ROOM)
        _walk_on(cell_cost, climbs, ways, lanes, sums, trails, steps)
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
    return _join(walks, walk, metres)


@helper
def _hash(cell):
    """uint64 of 32 bits (D. E. Knuth, "The art of computer programming", vol. 3, 6.4: multiplicative hashing)."""
    return (np.uint64(cell) * np.uint64(0x9E3779B1)) & np.uint64(0xFFFFFFFF)


@step_kernel(
    f"(f4[::1], CLIMBS, {_WAYS}, i8[::1], Tuple((u4[::1], f8[::1])), Tuple((u4[::1], f8[::1])), f8[::1])", CLIMBS
)
def drive_rests(cell_cost, climbs, ways, starts, known, trail, rests):
    """What is driven from each start along the parents to the root, in float64; inf where there is no way.

    known  (cells, sums), the rests that are known already of a 16th of all cells, the milestones: their routes
           share their trunks. Cells are 0 before; there are a power of two, at most 2**16. Written
    trail  (cells, sums) of the milestones that one route meets first; room for all cells
    rests  float64 (n,), s; written whole
    A rest is the sum up to the first milestone plus the milestone's own, and so the same whoever else is asked for.
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
