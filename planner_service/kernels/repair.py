"""Mending a tree after weights changed, without growing it anew. Arrays are laid out as `rules` says; and

first, last  int64  of each row, the cells between which something has changed; last < first where nothing has
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import INF, NONE, RULE_FOUR, RULE_OCTILE, SQRT2

_NOBODY = np.int32(-1)
_ONE = np.uint64(1)
_FINE = np.uint64(44)


@njit
def _longer(array, count, size):
    """Room for `size` elements, the first `count` copied. By a loop: assigning to a slice would bring along what
    numba needs for the text of its error, which takes longer to compile than any kernel here."""
    longer = np.empty(size, array.dtype)
    for i in range(count):
        longer[i] = array[i]
    return longer


@njit
def _rows_of(weight, stride):
    """`first` and `last` of nothing."""
    rows = weight.size // stride
    return np.full(rows, weight.size, np.int64), np.full(rows, -1, np.int64)


@njit
def _note(first, last, stride, cells, count):
    for i in range(count):
        row = cells[i] // stride
        first[row] = min(first[row], cells[i])
        last[row] = max(last[row], cells[i])


@njit
def _offers(weight, cost, s, begin, end, diagonal, corners, best, code):
    """The smallest exit key among the neighbours of each cell, and the direction to it; of equals the first of
    north, east, south, west, then of the diagonals clockwise.

    diagonal  length of such a step, inf where there is none. Free of branches, so that it vectorises
    """
    for i in range(begin, end):
        north = weight[i - s]
        east = weight[i + _ONE]
        south = weight[i + s]
        west = weight[i - _ONE]
        least = cost[i - s] + north
        k = np.uint8(0)
        key = cost[i + _ONE] + east
        k = np.uint8(2) if key < least else k
        least = min(least, key)
        key = cost[i + s] + south
        k = np.uint8(4) if key < least else k
        least = min(least, key)
        key = cost[i - _ONE] + west
        k = np.uint8(6) if key < least else k
        least = min(least, key)
        key = cost[i - s + _ONE] + weight[i - s + _ONE] * diagonal
        key = key if corners or max(north, east) < INF else INF
        k = np.uint8(1) if key < least else k
        least = min(least, key)
        key = cost[i + s + _ONE] + weight[i + s + _ONE] * diagonal
        key = key if corners or max(south, east) < INF else INF
        k = np.uint8(3) if key < least else k
        least = min(least, key)
        key = cost[i + s - _ONE] + weight[i + s - _ONE] * diagonal
        key = key if corners or max(south, west) < INF else INF
        k = np.uint8(5) if key < least else k
        least = min(least, key)
        key = cost[i - s - _ONE] + weight[i - s - _ONE] * diagonal
        key = key if corners or max(north, west) < INF else INF
        k = np.uint8(7) if key < least else k
        least = min(least, key)
        best[i - begin] = least
        code[i - begin] = k


@njit
def _diagonal(rule):
    if rule == RULE_FOUR:
        return INF
    return SQRT2 if rule == RULE_OCTILE else np.float32(1.0)


@njit
def _span(first, last, stride, row):
    """The cells of a row that something has changed about, or next to whom, in it and in the rows beside it:
    begin <= cell < end, empty if there are none."""
    # Columns, so that three rows can be laid over each other.
    begin, end = stride, -1
    for near in range(row - 1, row + 2):
        if last[near] >= first[near]:
            begin = min(begin, first[near] - near * stride)
            end = max(end, last[near] - near * stride)
    return row * stride + max(begin - 1, 1), row * stride + min(end + 2, stride - 1)


@njit
def _sweep(weight, cost, stride, rule, corners, first, last, floor, lowered, count):
    """Lower the cells that something changed about, and those next to them, to what they are offered, where they
    cost `floor` or more and are offered less. Returns lowered (uint32), which it appends them to, and how many."""
    best = np.empty(stride, np.float32)
    code = np.empty(stride, np.uint8)
    capacity = lowered.size
    for row in range(1, first.size - 1):
        begin, end = _span(first, last, stride, row)
        if end <= begin:
            continue
        _offers(
            weight, cost, np.uint64(stride), np.uint64(begin), np.uint64(end), _diagonal(rule), corners, best, code
        )
        if count + stride > capacity:
            lowered = _longer(lowered, count, 2 * capacity + stride)
            capacity = lowered.size
        for i in range(begin, end):
            if best[i - begin] < cost[i] and cost[i] >= floor and weight[i] < INF:
                cost[i] = best[i - begin]
                lowered[count] = i
                count += 1
    return lowered, count


@njit
def _spread(weight, cost, stride, rule, corners, width, ring, touched, count, first, last, limit):
    """Let costs that have fallen spread, until no cell is offered less than it costs.

    touched      uint32, the cells whose cost has fallen; `count` of them. Taken over
    width, ring  of a bucket, s, and how many there are before one that holds the rest. Up to the smallest weight no
                 cell is taken twice; beyond, costs are right too
    Notes the cells that have fallen in first and last. Returns (cells taken, or -1 beyond `limit`; the largest
    cost taken).
    """
    across = np.array((-stride, 1, stride, -1)).astype(np.uint64)
    aslant = np.array((1 - stride, stride + 1, stride - 1, -stride - 1)).astype(np.uint64)
    # v // stride, by a multiplication: exact while weight.size * stride is below 2**44.
    per_row = np.uint64((1 << 44) // stride + 1)
    inverse = np.float32(1.0) / width
    top = np.float32(ring)
    heads = np.full(ring + 1, _NOBODY, np.int32)
    capacity = max(1024, 2 * count)
    keys = np.empty(capacity, np.float32)
    items = np.empty(capacity, np.uint32)
    behind = np.empty(capacity, np.int32)
    used = 0
    spare = _NOBODY
    base = np.float32(0.0)
    current = ring
    taken = 0
    highest = np.float32(0.0)
    slant = _diagonal(rule)
    room = np.uint64(touched.size)
    n = np.uint64(count)
    while True:
        if used + np.int64(n) > capacity:
            capacity = 2 * (used + np.int64(n))
            keys = _longer(keys, used, capacity)
            items = _longer(items, used, capacity)
            behind = _longer(behind, used, capacity)
        for i in range(n):
            v = touched[i]
            row = np.int64(np.uint64(v) * per_row >> _FINE)
            first[row] = min(first[row], np.int64(v))
            last[row] = max(last[row], np.int64(v))
            key = cost[v]
            b = ring if current == ring else max(np.int64(min((key - base) * inverse, top)), current)
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
        while current < ring and heads[current] == _NOBODY:
            current += 1
        if current == ring:
            # The buckets begin anew with the lowest cost that waits beyond them.
            rest = heads[ring]
            heads[ring] = _NOBODY
            base = INF
            e = rest
            while e != _NOBODY:
                base = min(base, keys[e])
                e = behind[e]
            if base == INF:
                return taken, highest
            while rest != _NOBODY:
                e = rest
                rest = behind[e]
                b = np.int64(min((keys[e] - base) * inverse, top))
                behind[e] = heads[b]
                heads[b] = e
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
            taken += 1
            highest = max(highest, key)
            if n + np.uint64(8) > room:
                touched = _longer(touched, np.int64(n), np.int64(2 * room) + 64)
                room = np.uint64(touched.size)
            w = weight[u]
            straight = key + w
            diagonal = key + w * slant
            # No calls in here: of a call's array arguments references are counted, which trebles the time. And
            # branches, unlike in a flood: few neighbours are offered less, so that these are foretold.
            for k in range(4):
                v = u + across[k]
                if straight < cost[v] and weight[v] < INF:
                    cost[v] = straight
                    touched[n] = v
                    n += _ONE
                v = u + aslant[k]
                if (
                    diagonal < cost[v]
                    and weight[v] < INF
                    and (corners or max(weight[u + across[k]], weight[u + across[(k + 1) & 3]]) < INF)
                ):
                    cost[v] = diagonal
                    touched[n] = v
                    n += _ONE
        if taken > limit:
            return -1, highest


@njit
def lower(weight, cost, stride, rule, corners, changed, before, width, ring, limit):
    """After weights fell, let costs fall: no cell costs more than what any neighbour offers, where so before.

    width, ring  as `_spread` says
    Needs no parents, and no root but a cell that costs least. Returns cells visited, or -1 beyond `limit`; then
    cost is of no use any more.
    """
    first, last = _rows_of(weight, stride)
    for i in range(changed.size):
        if weight[changed[i]] < before[i]:
            _note(first, last, stride, changed[i : i + 1], 1)
    lowered = np.empty(1024, np.uint32)
    lowered, count = _sweep(weight, cost, stride, rule, corners, first, last, np.float32(-INF), lowered, 0)
    taken, _ = _spread(weight, cost, stride, rule, corners, width, ring, lowered, count, first, last, limit)
    return taken


@njit
def _detach(weight, cost, parent, stride, corners, changed, before, limit):
    """Take cost and parent from the cells whose way leads over a cell that got dearer.

    Returns them (int64) and how many; more than `limit` if that is so, and then not all.
    """
    offsets = np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))
    capacity = 64 + 16 * changed.size
    detached = np.empty(capacity, np.int64)
    count = 0
    for i in range(changed.size):
        x = changed[i]
        if not weight[x] > before[i]:
            continue
        lethal = not weight[x] < INF
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
            if lethal and not corners and way & 1:
                squeezed = v + offsets[way - 1] == x or v + offsets[(way + 1) & 7] == x
            if squeezed or way == (k + 4) & 7:
                parent[v] = NONE
                detached[count] = v
                count += 1
    done = 0
    while done < count and count <= limit:
        if count + 8 > capacity:
            detached = _longer(detached, count, 2 * capacity)
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
def repair(weight, cost, parent, stride, rule, corners, root, changed, before, width, ring, most):
    """Bring a tree up to date after the weights of `changed` cells became what they are now.

    changed      int64    padded cells, without repetition; before: float32, their weights when the tree was right
    width, ring  as `_spread` says
    most         (detached, with_eased, taken): how many cells may lose their way, the same where some cells got
                 cheaper, and how many may find another besides as many as lost theirs
    Cells whose way led through a dearer cell lose their cost and find a new one; the rest only improves. An exact
    tree is exact afterwards, equal to one grown from scratch. Returns (cells visited, the largest new cost); -1
    cells where that is more than `most`: then the tree is of no use any more and must be grown.
    """
    eased_first, eased_last = _rows_of(weight, stride)
    eased = False
    for i in range(changed.size):
        if weight[changed[i]] < before[i]:
            _note(eased_first, eased_last, stride, changed[i : i + 1], 1)
            eased = True
    most_detached = most[1] if eased else most[0]
    detached, many = _detach(weight, cost, parent, stride, corners, changed, before, most_detached)
    if many > most_detached:
        return -1, INF
    first, last = _rows_of(weight, stride)
    lowered = np.empty(1024, np.uint32)
    count = 0
    if many:
        _note(first, last, stride, detached, many)
        lowered, count = _sweep(weight, cost, stride, rule, corners, first, last, INF, lowered, count)
    if eased:
        floor = np.float32(-INF)
        lowered, count = _sweep(weight, cost, stride, rule, corners, eased_first, eased_last, floor, lowered, count)
    taken, highest = _spread(
        weight, cost, stride, rule, corners, width, ring, lowered, count, first, last, 2 * many + most[2]
    )
    if taken < 0:
        return -1, INF
    # Whoever stands beside a cell that changed may have a better neighbour now.
    _note(first, last, stride, changed, changed.size)
    _point(weight, cost, parent, stride, rule, corners, first, last)
    parent[root] = NONE
    return taken + many, highest


@njit
def _point(weight, cost, parent, stride, rule, corners, first, last):
    """The best neighbour becomes the parent, of the cells that something changed about and those next to them."""
    best = np.empty(stride, np.float32)
    code = np.empty(stride, np.uint8)
    for row in range(1, first.size - 1):
        begin, end = _span(first, last, stride, row)
        if end <= begin:
            continue
        _offers(
            weight, cost, np.uint64(stride), np.uint64(begin), np.uint64(end), _diagonal(rule), corners, best, code
        )
        for i in range(begin, end):
            parent[i] = code[i - begin] if max(cost[i], best[i - begin]) < INF else NONE
