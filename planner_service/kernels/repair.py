"""Repair of a tree after cell costs changed, in the manner of LPA* (S. Koenig, M. Likhachev, D. Furcy, "Lifelong
Planning A*", Artificial Intelligence 155, 2004) without its heuristic; and of G. Ramalingam, T. Reps, "An
incremental algorithm for a generalization of the shortest-path problem", Journal of Algorithms 21, 1996.

Cells whose path led over a cell with a higher cost are detached: they lose cost and parent. They, and the cells
beside what got cheaper, take the least that they are offered. Lower costs spread by a label-correcting search over
approximate buckets (Cherkassky, Goldberg, Radzik 1996), whose last one overflows: it holds all costs beyond the
others. Memory and time follow the changes, not the grid; the queue therefore keeps entries, not cells, and obsolete
ones are skipped when their turn comes.

Arrays, beside those of `layout`:
    changed   int64    (n,)  padded cells whose cost changed, without repetition
    before    float32  (n,)  s; their cell cost when the tree was right
    rows      (first, last)  int64 (rows + 2,)  of each padded row, the first and last padded cell that something
                             has changed about; last < first where nothing has
    detached  int64   (size + 8,)    padded cells that lost their way
    lowered   uint32  (2 * size,)    padded cells whose cost has fallen; as many as a count says
    best      float32 (stride,)      least offers in a part of a row, s
    keys, items, behind  float32, uint32, int32  entries of the queue: cost when entered (s), padded cell, the next
                                                 entry of its bucket; _NOBODY ends a list
    heads     int32    (count + 1,)  first entry of each bucket, the overflow last; _NOBODY if empty
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, offered
from planner_service.kernels.decorators import helper, step_kernel
from planner_service.kernels.layout import BUCKETS, GRID, INF, LABELS, NONE, diagonal_length, is_shut, leads_by
from planner_service.kernels.parents_from_costs import point_row_to_parents

_NOBODY = np.int32(-1)
_ONE = np.uint64(1)
_FINE_ROW = np.uint64(44)
"""Bits of the fixed-point number by which a cell's row is found without a division."""
_STRAIGHT = np.float32(1.0)
_PART = np.uint64(64)
"""Cells of a row that are looked through at once."""
ANY_COST = np.float32(-INF)
"""A floor of `sweep` that all costs reach."""


Rows = tuple[NDArray[np.int64], NDArray[np.int64]]
Entries = tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.int32]]
Scratch = tuple[Rows, Rows, NDArray[np.int64], NDArray[np.uint32], NDArray[np.float32], Entries, NDArray[np.int32]]
_ROWS = "UniTuple(i8[::1], 2)"
SCRATCH = f"Tuple(({_ROWS}, {_ROWS}, i8[::1], u4[::1], f4[::1], Tuple((f4[::1], u4[::1], i4[::1])), i4[::1]))"


def make_scratch(size: int, stride: int, buckets: int) -> Scratch:
    """(rows, rows of what got cheaper, detached, lowered, best, (keys, items, behind), heads) for repairs of `size`
    padded cells: for the worst case, as the system keeps no page that was not written."""
    count = size // stride
    first, last, cheaper_first, cheaper_last = (np.empty(count, np.int64) for _ in range(4))
    many = 2 * size + 1024
    entries = np.empty(many, np.float32), np.empty(many, np.uint32), np.empty(many, np.int32)
    return (
        *((first, last), (cheaper_first, cheaper_last), np.empty(size + 8, np.int64), np.empty(many, np.uint32)),
        *(np.empty(stride, np.float32), entries, np.empty(buckets + 1, np.int32)),
    )


@helper
def clear_rows(rows, size):
    """`rows` := of nothing, in arrays of `size` padded cells."""
    first, last = rows
    for row in range(first.size):
        first[row] = size
        last[row] = -1


@helper
def note(rows, per_row, cell):
    """Something has changed about a padded cell (unsigned)."""
    first, last = rows
    row = np.int64(cell * per_row >> _FINE_ROW)
    first[row] = min(first[row], np.int64(cell))
    last[row] = max(last[row], np.int64(cell))


@helper
def _note_cheaper(rows, per_row, cell_cost, changed, before):
    """`rows` := of the cells that got cheaper. Returns True if any has."""
    clear_rows(rows, cell_cost.size)
    found = False
    for i in range(changed.size):
        if cell_cost[changed[i]] < before[i]:
            note(rows, per_row, np.uint64(changed[i]))
            found = True
    return found


@helper
def near_rows(first, last):
    """The inner rows in which something has changed, the rows beside these, and all between: begin <= row < end."""
    begin, end = 0, first.size
    while begin < end and last[begin] < first[begin]:
        begin += 1
    while end > begin and last[end - 1] < first[end - 1]:
        end -= 1
    return max(begin - 1, 1), min(end + 1, first.size - 1)


@helper
def span_near(first, last, stride, row):
    """The cells of a row that something has changed about in it or in the rows beside it, and their neighbours:
    begin <= cell < end, empty if there are none."""
    # Columns, so that three rows can be laid over each other.
    begin, end = stride, -1
    for near in range(row - 1, row + 2):
        if last[near] >= first[near]:
            begin = min(begin, first[near] - near * stride)
            end = max(end, last[near] - near * stride)
    return row * stride + max(begin - 1, 1), row * stride + min(end + 2, stride - 1)


@helper
def sweep(grid, climbs, cost, parent, rows, floor, best, lowered, count):
    """Lowers the cells of `rows`, and those next to them, to what they are offered, where they cost `floor` (s) or
    more and are offered less. Appends them to the `count` that are in `lowered`; returns how many there are.

    parent  of all these cells the neighbour that offers least is written; None if not wanted
    """
    cell_cost, _, stride, _, _ = grid
    first, last = rows
    from_row, to_row = near_rows(first, last)
    n = np.uint64(count)
    for row in range(from_row, to_row):
        begin, end = span_near(first, last, stride, row)
        if end <= begin:
            continue
        point_row_to_parents(grid, climbs, cost, begin, end, parent, best)
        at, width = np.uint64(begin), np.uint64(end - begin)
        # In parts, as nearly none has a cell to lower: to ask vectorises.
        for part in range(np.uint64(0), width, _PART):
            until = min(part + _PART, width)
            found = np.int32(0)
            for i in range(part, until):
                found += np.int32((best[i] < cost[at + i]) & (cost[at + i] >= floor) & (cell_cost[at + i] < INF))
            if not found:
                continue
            for i in range(part, until):
                if best[i] < cost[at + i] and cost[at + i] >= floor and cell_cost[at + i] < INF:
                    cost[at + i] = best[i]
                    lowered[n] = at + i
                    n += _ONE
    return np.int64(n)


@helper
def _begin_anew(keys, behind, heads, overflow, inverse):
    """Spreads the overflow over the buckets, the first of which begins with its lowest key. Returns that key, or
    inf if nothing waits."""
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


@helper
def spread(grid, climbs, cost, buckets, lowered, count, rows, limit, entries, heads):
    """Propagates lower costs through the tree until no neighbour offers a cell a lower cost than it has.

    buckets  (width, number) of the queue's buckets. Up to a width of the lowest cell cost no cell is processed
             twice; with wider ones some are, and the costs are still correct
    lowered  its first `count` entries are the cells whose cost has fallen; used as work space, so its content is
             lost
    Notes the cells that have fallen in `rows`. Returns (cells served; the largest cost served). Instead of the
    number of cells it returns -1 if more than `limit` cells were processed (all changes so far are in `rows`), and
    -2 if the queue is full (some changes are not in `rows`).
    """
    cell_cost, offsets, stride, rule, corners = grid
    keys, items, behind = entries
    per_row = row_factor(stride)
    width, overflow = buckets
    inverse = np.float32(1.0) / np.float32(width)
    top = np.float32(overflow)
    for b in range(overflow + 1):
        heads[b] = _NOBODY
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
        if used + np.int64(n) > keys.size:
            return -2, highest
        for i in range(n):
            v = lowered[i]
            note(rows, per_row, np.uint64(v))
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
        if served > limit:
            return -1, highest
        n = np.uint64(0)
        while current < overflow and heads[current] == _NOBODY:
            current += 1
        if current == overflow:
            base = _begin_anew(keys, behind, heads, overflow, inverse)
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
                return -2, highest
            own = cell_cost[u]
            # Branches, unlike in a growth: few neighbours are offered less, so that these are foretold.
            for k in range(4):
                v = u + np.uint64(offsets[2 * k])
                straight = offered(key, own, climbs, v, u, (2 * k) ^ 4, _STRAIGHT)
                if straight < cost[v] and cell_cost[v] < INF:
                    cost[v] = straight
                    lowered[n] = v
                    n += _ONE
                v = u + np.uint64(offsets[2 * k + 1])
                diagonal = offered(key, own, climbs, v, u, (2 * k + 1) ^ 4, slant)
                lower = diagonal < cost[v] and cell_cost[v] < INF
                if lower and (corners or not is_shut(cell_cost, offsets, u, 2 * k + 1)):
                    cost[v] = diagonal
                    lowered[n] = v
                    n += _ONE


@helper
def point_near(grid, climbs, labels, rows):
    """Writes the parents of the cells of `rows`, and of those next to them."""
    stride = grid[2]
    cost, parent, root = labels
    first, last = rows
    from_row, to_row = near_rows(first, last)
    for row in range(from_row, to_row):
        begin, end = span_near(first, last, stride, row)
        if begin < end:
            point_row_to_parents(grid, climbs, cost, begin, end, parent, None)
    parent[root] = NONE


@helper
def row_factor(stride):
    """cell // stride is cell * this >> _FINE_ROW, unsigned: exact while the grid's size * stride is below 2**44."""
    return np.uint64((1 << 44) // stride + 1)


@helper
def _detach(grid, cost, parent, changed, before, limit, detached):
    """Takes cost and parent from the cells whose path leads over a cell that got more expensive.

    Writes them to `detached`. Returns how many; more than `limit` if that is so, and then not all.
    """
    cell_cost, offsets, _, _, corners = grid
    count = np.int64(0)  # a literal would have `_detach_behind` compiled twice
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
            if leads_by(parent, offsets, x, k, lethal and not corners):
                parent[x + offsets[k]] = NONE
                detached[count] = x + offsets[k]
                count += 1
    return _detach_behind(cost, parent, offsets, detached, count, limit)


@helper
def _detach_behind(cost, parent, offsets, detached, count, limit):
    """Detaches all whose way leads over the `count` cells that are detached already."""
    done = 0
    while done < count and count <= limit:
        u = np.uint64(detached[done])
        done += 1
        # A cell has one parent, so that none is found twice.
        for k in range(8):
            v = np.uint64(np.int64(u) + offsets[k])
            detached[count] = v
            count += parent[v] == (k + 4) & 7
        parent[u] = NONE
        cost[u] = INF
    return count


@step_kernel(f"({GRID}, CLIMBS, {LABELS}, i8[::1], f4[::1], {BUCKETS}, UniTuple(i8, 3), {SCRATCH})", CLIMBS)
def repair(grid, climbs, labels, changed, before, buckets, most, scratch):
    """Brings a tree up to date after the costs of `changed` cells became what they are now.

    buckets  as `spread` says
    most     (detached, with_cheaper, served): how many cells may lose their way, the same where some cells got
             cheaper, and how many may be served besides twice as many as lost theirs
    scratch  as `make_scratch` returns it, for as many buckets
    Without parents (none at all) costs only fall: none is more than what any neighbour offers, where so before.

    An exact tree is exact afterwards, equal to one grown from scratch. Returns (cells visited, the largest new
    cost, s); -1 cells where that is more than `most`: then the tree is of no use any more and must be grown.
    """
    cell_cost, _, stride, _, _ = grid
    cost, parent, _ = labels
    rows, cheaper, detached, lowered, best, entries, heads = scratch
    per_row = row_factor(stride)
    any_cheaper = _note_cheaper(cheaper, per_row, cell_cost, changed, before)
    most_detached = most[1] if any_cheaper else most[0]
    many = np.int64(0)
    if parent.size:
        many = _detach(grid, cost, parent, changed, before, most_detached, detached)
    if many > most_detached:
        return -1, INF
    clear_rows(rows, cell_cost.size)
    count = np.int64(0)  # a literal would have `sweep` compiled twice
    if many:
        for i in range(many):
            note(rows, per_row, np.uint64(detached[i]))
        count = sweep(grid, climbs, cost, None, rows, INF, best, lowered, count)
    if any_cheaper:
        count = sweep(grid, climbs, cost, None, cheaper, ANY_COST, best, lowered, count)
    served, highest = spread(grid, climbs, cost, buckets, lowered, count, rows, 2 * many + most[2], entries, heads)
    if served < 0:
        return -1, INF
    if not parent.size:
        return served, highest
    # A cell beside one that changed may have a better neighbour now.
    for i in range(changed.size):
        note(rows, per_row, np.uint64(changed[i]))
    point_near(grid, climbs, labels, rows)
    return served + many, highest
