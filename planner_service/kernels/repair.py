"""Repair of a tree after cell costs changed, in the manner of LPA* (S. Koenig, M. Likhachev, D. Furcy, "Lifelong
Planning A*", Artificial Intelligence 155, 2004) without its heuristic; and of G. Ramalingam, T. Reps, "An
incremental algorithm for a generalization of the shortest-path problem", Journal of Algorithms 21, 1996.

Cells whose way led over a dearer cell are detached: they lose cost and parent. They, and the cells beside what got
cheaper, take the least that they are offered. What has fallen spreads by a label-correcting search over approximate
buckets (Cherkassky, Goldberg, Radzik 1996), whose last one overflows: it holds all that costs more than the others
reach. Memory and time follow what has changed, not the grid; so the queue keeps entries, not cells, and what became
obsolete is skipped when its turn comes.

Arrays, beside those of `layout`:
    changed   int64    (n,)  padded cells whose cost changed, without repetition
    before    float32  (n,)  s; their cell cost when the tree was right
    rows      (first, last)  int64 (rows + 2,)  of each padded row, the first and last padded cell that something
                             has changed about; last < first where nothing has
    lowered   uint32         padded cells whose cost has fallen; as many as a count says
    keys, items, behind  float32, uint32, int32  entries of the queue: cost when entered (s), padded cell, the next
                                                 entry of its bucket; _NOBODY ends a list
    heads     int32    (count + 1,)  first entry of each bucket, the overflow last; _NOBODY if empty
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import INF, NONE, diagonal_length, enlarged, step_offsets
from planner_service.kernels.parents import point_row_to_parents

_NOBODY = np.int32(-1)
_ONE = np.uint64(1)
_FINE = np.uint64(44)


@njit
def _no_rows(grid):
    """`rows` of nothing."""
    count = grid.cell_cost.size // grid.stride
    return np.full(count, grid.cell_cost.size, np.int64), np.full(count, -1, np.int64)


@njit
def _note(first, last, stride, cells, count):
    """Something has changed about the first `count` of these padded cells."""
    # cell // stride, by a multiplication: exact while the grid's size * stride is below 2**44.
    per_row = np.uint64((1 << 44) // stride + 1)
    for i in range(count):
        v = np.int64(cells[i])
        row = np.int64(np.uint64(v) * per_row >> _FINE)
        first[row] = min(first[row], v)
        last[row] = max(last[row], v)


@njit
def _note_cheaper(grid, rows, changed, before):
    """Note the cells that got cheaper. Returns whether there are any."""
    first, last = rows
    found = False
    for i in range(changed.size):
        if grid.cell_cost[changed[i]] < before[i]:
            _note(first, last, grid.stride, changed[i : i + 1], 1)
            found = True
    return found


@njit
def _span(first, last, stride, row):
    """The cells of a row that something has changed about in it or in the rows beside it, and their neighbours:
    begin <= cell < end, empty if there are none."""
    # Columns, so that three rows can be laid over each other.
    begin, end = stride, -1
    for near in range(row - 1, row + 2):
        if last[near] >= first[near]:
            begin = min(begin, first[near] - near * stride)
            end = max(end, last[near] - near * stride)
    return row * stride + max(begin - 1, 1), row * stride + min(end + 2, stride - 1)


@njit
def _best_offers(grid, cost, begin, end, best):
    """best[0 : end - begin] := the smallest exit key among the neighbours of each cell of a part of a row.

    Free of branches, so that it vectorises; the length of a diagonal is inf where there is none.
    """
    cell_cost, stride, rule, corners = grid
    s = np.uint64(stride)
    diagonal = diagonal_length(rule)
    for i in range(begin, end):
        north = cell_cost[i - s]
        east = cell_cost[i + _ONE]
        south = cell_cost[i + s]
        west = cell_cost[i - _ONE]
        least = min(
            min(cost[i - s] + north, cost[i + _ONE] + east), min(cost[i + s] + south, cost[i - _ONE] + west)
        )
        key = cost[i - s + _ONE] + cell_cost[i - s + _ONE] * diagonal
        least = min(least, key if corners or max(north, east) < INF else INF)
        key = cost[i + s + _ONE] + cell_cost[i + s + _ONE] * diagonal
        least = min(least, key if corners or max(south, east) < INF else INF)
        key = cost[i + s - _ONE] + cell_cost[i + s - _ONE] * diagonal
        least = min(least, key if corners or max(south, west) < INF else INF)
        key = cost[i - s - _ONE] + cell_cost[i - s - _ONE] * diagonal
        least = min(least, key if corners or max(north, west) < INF else INF)
        best[i - begin] = least


@njit
def _sweep(grid, cost, rows, floor, lowered, count):
    """Lower the cells of `rows`, and those next to them, to what they are offered, where they cost `floor` (s) or
    more and are offered less. Returns lowered, to which it appends them, and how many there are."""
    stride = grid.stride
    first, last = rows
    best = np.empty(stride, np.float32)
    for row in range(1, first.size - 1):
        begin, end = _span(first, last, stride, row)
        if end <= begin:
            continue
        _best_offers(grid, cost, np.uint64(begin), np.uint64(end), best)
        if count + stride > lowered.size:
            lowered = enlarged(lowered, count, 2 * lowered.size + stride)
        for i in range(begin, end):
            if best[i - begin] < cost[i] and cost[i] >= floor and grid.cell_cost[i] < INF:
                cost[i] = best[i - begin]
                lowered[count] = i
                count += 1
    return lowered, count


@njit
def _begin_anew(keys, behind, heads, inverse):
    """Spread the overflow over the buckets, the first of which begins with its lowest key. Returns that key, or inf
    if nothing waits."""
    overflow = heads.size - 1
    top = np.float32(overflow)
    rest = heads[overflow]
    heads[overflow] = _NOBODY
    base = INF
    e = rest
    while e != _NOBODY:
        base = min(base, keys[e])
        e = behind[e]
    while rest != _NOBODY:
        e = rest
        rest = behind[e]
        b = np.int64(min((keys[e] - base) * inverse, top))
        behind[e] = heads[b]
        heads[b] = e
    return base


@njit
def _spread(grid, cost, buckets, lowered, count, rows, limit):
    """Let costs that have fallen spread, until no cell is offered less than it costs.

    buckets  width: up to the lowest cell cost no cell is served twice; beyond, costs are right too
    lowered  `count` cells whose cost has fallen; taken over
    Notes the cells that have fallen in `rows`. Returns (cells served, or -1 beyond `limit`; the largest cost
    served).
    """
    cell_cost, stride, rule, corners = grid
    first, last = rows
    across = np.array((-stride, 1, stride, -1)).astype(np.uint64)
    aslant = np.array((1 - stride, stride + 1, stride - 1, -stride - 1)).astype(np.uint64)
    per_row = np.uint64((1 << 44) // stride + 1)  # as in `_note`
    inverse = np.float32(1.0) / buckets.width
    overflow = buckets.count
    top = np.float32(overflow)
    heads = np.full(overflow + 1, _NOBODY, np.int32)
    capacity = max(1024, 2 * count)
    keys = np.empty(capacity, np.float32)
    items = np.empty(capacity, np.uint32)
    behind = np.empty(capacity, np.int32)
    used = 0
    spare = _NOBODY
    base = np.float32(0.0)
    current = overflow
    served = 0
    highest = np.float32(0.0)
    slant = diagonal_length(rule)
    room = np.uint64(lowered.size)
    n = np.uint64(count)
    # All in one function: of a call's array arguments references are counted: repairs took a fifth more time where
    # entering a bucket's cells was a call, and treble the time where making offers is one.
    while True:
        if used + np.int64(n) > capacity:
            capacity = 2 * (used + np.int64(n))
            keys = enlarged(keys, used, capacity)
            items = enlarged(items, used, capacity)
            behind = enlarged(behind, used, capacity)
        for i in range(n):
            v = lowered[i]
            row = np.int64(np.uint64(v) * per_row >> _FINE)
            first[row] = min(first[row], np.int64(v))
            last[row] = max(last[row], np.int64(v))
            key = cost[v]
            b = overflow if current == overflow else max(np.int64(min((key - base) * inverse, top)), current)
            e = spare
            if e == _NOBODY:
                e = used
                used += 1
            else:
                spare = behind[e]
            keys[e] = key
            items[e] = v
            behind[e] = heads[b]
            heads[b] = e
        n = np.uint64(0)
        while current < overflow and heads[current] == _NOBODY:
            current += 1
        if current == overflow:
            base = _begin_anew(keys, behind, heads, inverse)
            if base == INF:
                return served, highest
            current = 0
            continue
        e = heads[current]
        heads[current] = _NOBODY
        while e != _NOBODY:
            u = np.uint64(items[e])
            key = keys[e]
            after = behind[e]
            behind[e] = spare
            spare = e
            e = after
            if key > cost[u]:
                continue
            served += 1
            highest = max(highest, key)
            if n + np.uint64(8) > room:
                lowered = enlarged(lowered, np.int64(n), np.int64(2 * room) + 64)
                room = np.uint64(lowered.size)
            straight = key + cell_cost[u]
            diagonal = key + cell_cost[u] * slant
            # Branches, unlike in a growth: few neighbours are offered less, so that these are foretold.
            for k in range(4):
                v = u + across[k]
                if straight < cost[v] and cell_cost[v] < INF:
                    cost[v] = straight
                    lowered[n] = v
                    n += _ONE
                v = u + aslant[k]
                if (
                    diagonal < cost[v]
                    and cell_cost[v] < INF
                    and (corners or max(cell_cost[u + across[k]], cell_cost[u + across[(k + 1) & 3]]) < INF)
                ):
                    cost[v] = diagonal
                    lowered[n] = v
                    n += _ONE
        if served > limit:
            return -1, highest


@njit
def lower_costs(grid, cost, changed, before, buckets, limit):
    """After cell costs fell, let costs fall: no cell costs more than what any neighbour offers, where so before.

    Needs no parents, and no root but a cell that costs least. Returns cells served, or -1 beyond `limit`; then
    `cost` is of no use any more.
    """
    rows = _no_rows(grid)
    _note_cheaper(grid, rows, changed, before)
    lowered, count = _sweep(grid, cost, rows, np.float32(-INF), np.empty(1024, np.uint32), 0)
    served, _ = _spread(grid, cost, buckets, lowered, count, rows, limit)
    return served


@njit
def _detach(grid, labels, changed, before, limit):
    """Take cost and parent from the cells whose way leads over a cell that got dearer.

    Returns them (int64) and how many; more than `limit` if that is so, and then not all.
    """
    cell_cost, parent = grid.cell_cost, labels.parent
    offsets = step_offsets(grid.stride)
    detached = np.empty(64 + 16 * changed.size, np.int64)
    count = 0
    for i in range(changed.size):
        x = changed[i]
        if not cell_cost[x] > before[i]:
            continue
        lethal = not cell_cost[x] < INF
        if lethal and parent[x] != NONE:
            parent[x] = NONE
            detached[count] = x
            count += 1
        for k in range(8):
            v = x + offsets[k]
            way = parent[v]
            if way == NONE:
                continue
            squeezed = False
            if lethal and not grid.corners and way & 1:
                squeezed = v + offsets[way - 1] == x or v + offsets[(way + 1) & 7] == x
            if squeezed or way == (k + 4) & 7:
                parent[v] = NONE
                detached[count] = v
                count += 1
    return _detach_behind(labels, offsets, detached, count, limit)


@njit
def _detach_behind(labels, offsets, detached, count, limit):
    """Detach all whose way leads over the `count` cells that are detached already."""
    cost, parent, _ = labels
    capacity = detached.size
    done = 0
    while done < count and count <= limit:
        if count + 8 > capacity:
            detached = enlarged(detached, count, 2 * capacity)
            capacity *= 2
        u = np.uint64(detached[done])
        done += 1
        # A cell has one parent, so that none is found twice.
        for k in range(8):
            v = np.uint64(np.int64(u) + offsets[k])
            detached[count] = v
            count += parent[v] == (k + 4) & 7
        parent[u] = NONE
        cost[u] = INF
    return detached, count


@njit
def repair(grid, labels, changed, before, buckets, most):
    """Bring a tree up to date after the costs of `changed` cells became what they are now.

    buckets  as `_spread` says
    most     (detached, with_cheaper, served): how many cells may lose their way, the same where some cells got
             cheaper, and how many may be served besides twice as many as lost theirs
    An exact tree is exact afterwards, equal to one grown from scratch. Returns (cells visited, the largest new
    cost, s); -1 cells where that is more than `most`: then the tree is of no use any more and must be grown.
    """
    cheaper = _no_rows(grid)
    any_cheaper = _note_cheaper(grid, cheaper, changed, before)
    most_detached = most[1] if any_cheaper else most[0]
    detached, many = _detach(grid, labels, changed, before, most_detached)
    if many > most_detached:
        return -1, INF
    rows = _no_rows(grid)
    first, last = rows
    lowered = np.empty(1024, np.uint32)
    count = 0
    if many:
        _note(first, last, grid.stride, detached, many)
        lowered, count = _sweep(grid, labels.cost, rows, INF, lowered, count)
    if any_cheaper:
        lowered, count = _sweep(grid, labels.cost, cheaper, np.float32(-INF), lowered, count)
    served, highest = _spread(grid, labels.cost, buckets, lowered, count, rows, 2 * many + most[2])
    if served < 0:
        return -1, INF
    cell_cost, stride, rule, corners = grid
    cost, parent, root = labels
    # A cell beside one that changed may have a better neighbour now.
    _note(first, last, grid.stride, changed, changed.size)
    for row in range(1, first.size - 1):
        begin, end = _span(first, last, grid.stride, row)
        if begin < end:
            point_row_to_parents(cell_cost, cost, stride, rule, corners, begin, end, parent)
    parent[root] = NONE
    return served + many, highest
