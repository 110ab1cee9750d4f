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
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import (
    INF,
    NONE,
    RULE_OCTILE,
    SQRT2,
    SQRT2_EXACT,
    check_cells,
    step_offsets,
)

OK, UNREACHABLE, OUTSIDE, LETHAL_START = range(4)
"""What became of a route that was asked for."""

_LANES = 4
"""Routes that are walked side by side. A step waits for the one before it, but not for another route's."""
_STRETCH = 32
"""Steps between two looks at whether a lane's route has ended; a route that has stands still meanwhile."""


@njit
def relabel(grid, labels):
    """Costs := what is really driven from each cell along its parents. They are written whole; parents are read."""
    cell_cost, stride, rule, _ = grid
    cost, parent, root = labels
    offsets = step_offsets(stride)
    unknown = np.float32(-1.0)
    for i in range(cost.size):
        cost[i] = unknown if parent[i] != NONE else INF
    cost[root] = np.float32(0.0)
    trail = np.empty(cost.size, np.uint32)
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
            cost[v] = cost[u] + (cell_cost[u] * SQRT2 if rule == RULE_OCTILE and k & 1 else cell_cost[u])


@njit
def _walk_on(cell_cost, parent, offsets, lengths, cells, sums, trails, fill, steps):
    """Go `steps` steps on, in all lanes; steps beyond a route's end have the code NONE, and cost nothing."""
    a, b, c, d = np.uint64(cells[0]), np.uint64(cells[1]), np.uint64(cells[2]), np.uint64(cells[3])
    sum_a, sum_b, sum_c, sum_d = sums[0], sums[1], sums[2], sums[3]
    trail_a, trail_b, trail_c, trail_d = trails[0], trails[1], trails[2], trails[3]
    at_a, at_b, at_c, at_d = np.uint64(fill[0]), np.uint64(fill[1]), np.uint64(fill[2]), np.uint64(fill[3])
    for i in range(np.uint64(steps)):
        code_a, code_b, code_c, code_d = parent[a], parent[b], parent[c], parent[d]
        trail_a[at_a + i] = code_a
        trail_b[at_b + i] = code_b
        trail_c[at_c + i] = code_c
        trail_d[at_d + i] = code_d
        a += offsets[code_a]
        b += offsets[code_b]
        c += offsets[code_c]
        d += offsets[code_d]
        sum_a += np.float64(cell_cost[a]) * lengths[code_a]
        sum_b += np.float64(cell_cost[b]) * lengths[code_b]
        sum_c += np.float64(cell_cost[c]) * lengths[code_c]
        sum_d += np.float64(cell_cost[d]) * lengths[code_d]
    cells[0], cells[1], cells[2], cells[3] = np.int64(a), np.int64(b), np.int64(c), np.int64(d)
    sums[0], sums[1], sums[2], sums[3] = sum_a, sum_b, sum_c, sum_d


@njit
def _moves(stride, rule):
    """Of each direction code, what it adds to a padded cell (uint64) and its length in straight steps (float64).

    Beyond the codes of directions, NONE: to stay, at no cost. Unsigned, as sums of a cell and a signed offset would
    be floating-point numbers; they wrap.
    """
    offsets = np.zeros(256, np.uint64)
    lengths = np.zeros(256, np.float64)
    near = step_offsets(stride)
    for k in range(8):
        offsets[k] = np.uint64(near[k])
        lengths[k] = SQRT2_EXACT if rule == RULE_OCTILE and k & 1 else 1.0
    return offsets, lengths


@njit
def walk_routes(cell_cost, parent, stride, rule, root, starts, max_steps, limit):
    """The routes from `starts` to a padded root, at most `max_steps` long where that is positive.

    limit  no route can be longer than so many steps
    Raises ValueError where a start is no padded cell.
    Returns (directions, ends, driven, diagonals, last).
    """
    check_cells(starts, parent.size)
    offsets, lengths = _moves(stride, rule)
    count = starts.size
    ends = np.empty(count, np.int64)
    driven = np.empty(count, np.float64)
    last = np.empty(count, np.int64)
    most = limit if max_steps <= 0 else min(limit, max_steps)

    # Each lane has a share of the routes, and its trail holds them in order.
    trails = np.empty((_LANES, 1024), np.uint8)
    route = np.empty(_LANES, np.int64)
    until = np.empty(_LANES, np.int64)
    begun = np.zeros(_LANES, np.int64)
    fill = np.zeros(_LANES, np.int64)
    cells = np.full(_LANES, root, np.int64)
    sums = np.zeros(_LANES, np.float64)
    for j in range(_LANES):
        route[j] = count * j // _LANES
        until[j] = count * (j + 1) // _LANES
        if route[j] < until[j]:
            cells[j] = starts[route[j]]
    while True:
        steps = np.int64(0)  # a literal would have `_walk_on` compiled twice
        for j in range(_LANES):
            if route[j] < until[j]:
                left = min(_STRETCH, most - (fill[j] - begun[j]))
                steps = left if steps == 0 else min(steps, left)
        if steps == 0:
            break
        if max(max(fill[0], fill[1]), max(fill[2], fill[3])) + steps > trails.shape[1]:
            trails = _longer_trails(trails)
        _walk_on(cell_cost, parent, offsets, lengths, cells, sums, trails, fill, steps)
        for j in range(_LANES):
            r = route[j]
            if r == until[j]:
                continue
            end = fill[j] + steps
            while end > begun[j] and trails[j, end - 1] == NONE:
                end -= 1
            fill[j] = end
            v = cells[j]
            if parent[v] != NONE and end - begun[j] < most:
                continue
            broken = v != root and (parent[v] == NONE or end - begun[j] == limit)
            ends[r] = -1 if broken else end
            driven[r] = sums[j]
            last[r] = v
            route[j] = r + 1
            begun[j] = end
            sums[j] = 0.0
            cells[j] = starts[r + 1] if r + 1 < until[j] else root
    directions, diagonals = _joined(trails, fill, ends)
    return directions, ends, driven, diagonals, last


@njit
def _longer_trails(trails):
    longer = np.empty((trails.shape[0], 2 * trails.shape[1]), np.uint8)
    for j in range(trails.shape[0]):
        for i in range(trails.shape[1]):  # by a loop: see `enlarged` in `layout`
            longer[j, i] = trails[j, i]
    return longer


@njit
def _joined(trails, fill, ends):
    """The trails of all lanes in one row, and how many diagonal steps each route has. Ends of routes in their
    lane's trail become their ends in that row."""
    count = ends.size
    directions = np.empty(fill.sum(), np.uint8)
    n = 0
    for j in range(_LANES):
        for i in range(fill[j]):
            directions[n + i] = trails[j, i]
        for r in range(count * j // _LANES, count * (j + 1) // _LANES):
            ends[r] += n if ends[r] >= 0 else 0
        n += fill[j]
    diagonals = np.empty(count, np.int64)
    n = 0
    for r in range(count):
        odd = 0
        for i in range(n, ends[r]):
            odd += directions[i] & 1
        diagonals[r] = odd
        n = max(n, ends[r])
    return directions, diagonals


@njit
def find_starts(cell_cost, cost, stride, root, asked, starts, status):
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
        elif not cost[v] < INF:
            status[i] = UNREACHABLE
        else:
            status[i] = OK
            starts[i] = v


@njit
def price_routes(cost, offset, root, metres, walks, status, bound, prices):
    """What walked routes cost and how long they are.

    offset  s; what a tree's stored costs lack
    metres  (resolution, m; length of a diagonal in straight steps; price of length, s/m)
    walks   (ends, driven, diagonals, last) as `walk_routes` returns them
    bound   float64 (n,), s; proven lower bound on the cost of each
    prices  written whole
    Returns False if a route does not end where it should.
    """
    resolution, diagonal, length_weight = metres
    ends, driven, diagonals, last = walks
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
        remaining = 0.0
        if last[i] != root:
            remaining = max(np.float64(cost[last[i]]) + offset, 0.0)
        whole = driven[i] - length * length_weight + remaining
        prices[0, i] = whole
        prices[1, i] = min(bound[i], whole)
        prices[2, i] = length
        prices[3, i] = remaining
    return True
