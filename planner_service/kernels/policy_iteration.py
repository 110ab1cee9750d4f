"""Make a tree exact from the parents that it has, whatever windows, moves and repairs it went through.

When the root moves a cell, over 99 % of all cells keep their parents, and nearly all costs change. Costs are
therefore recomputed along the parents, and the few cells that are then offered less than they cost take the offer.
It is policy iteration on shortest paths (R. A. Howard, "Dynamic Programming and Markov Processes", 1960): to
evaluate the whole tree costs a fourth of growing it, to improve it everywhere, which vectorises, a fifteenth.
Descendants of an improved cell are evaluated along the parents, too; further improvements spread as in a repair.

Arrays, beside those of `layout` and `repair`:
    children  uint8    (size,)    of each cell, bit k: its neighbour in direction k leads to it
    steps     int32    (256, 8)   of each value of `children`: how many padded cells away these neighbours are
    lengths   float32  (256, 8)   of the steps from them, in straight ones
    ways      int64    (256, 8)   the directions of the steps back
    many      int64    (256,)     how many they are
    queue, keys  uint32, float32 (2 * size + 48,)  cells of a walk over the tree, and their costs, s
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, offered
from planner_service.kernels.decorators import helper, prefetch, step_kernel
from planner_service.kernels.layout import BUCKETS, GRID, LABELS, NONE, RULE_OCTILE, SQRT2, step_offsets
from planner_service.kernels.repair import (
    ANY_COST,
    SCRATCH,
    clear_rows,
    note,
    point_near,
    row_factor,
    spread,
    sweep,
)

_ONE = np.uint64(1)
_TWO = np.uint64(2)
_AHEAD = np.uint64(24)
"""Cells of the walk whose memory is asked for before their turn."""
_TURNS = 12
"""Rounds of improvement after which a full search costs less: half as many are rare
(docs/design/incremental-trees.md)."""

Walk = tuple[NDArray[np.uint8], NDArray[np.int32], NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]
"""(children, steps, lengths, ways, many)."""
_WALK = "Tuple((u1[::1], i4[:, ::1], f4[:, ::1], i8[:, ::1], i8[::1]))"


def make_walk(size: int, stride: int, rule: int) -> Walk:
    """(children, steps, lengths, ways, many) for trees of `size` padded cells."""
    offsets = step_offsets(stride)
    steps, lengths = np.zeros((256, 8), np.int32), np.zeros((256, 8), np.float32)
    ways, many = np.zeros((256, 8), np.int64), np.zeros(256, np.int64)
    for bits in range(256):
        codes = [k for k in range(8) if bits >> k & 1]
        many[bits] = len(codes)
        steps[bits, : len(codes)] = offsets[codes]
        ways[bits, : len(codes)] = [k ^ 4 for k in codes]
        lengths[bits, : len(codes)] = [SQRT2 if k & 1 and rule == RULE_OCTILE else 1.0 for k in codes]
    return np.zeros(size, np.uint8), steps, lengths, ways, many


@helper
def _find_children(parent, stride, children):
    """Writes `children` of all inner cells. Vectorises."""
    s = np.uint64(stride)
    for i in range(s + _ONE, np.uint64(parent.size) - s - _ONE):
        bits = np.uint8(1) if parent[i - s] == 4 else np.uint8(0)
        bits |= np.uint8(2) if parent[i - s + _ONE] == 5 else np.uint8(0)
        bits |= np.uint8(4) if parent[i + _ONE] == 6 else np.uint8(0)
        bits |= np.uint8(8) if parent[i + s + _ONE] == 7 else np.uint8(0)
        bits |= np.uint8(16) if parent[i + s] == 0 else np.uint8(0)
        bits |= np.uint8(32) if parent[i + s - _ONE] == 1 else np.uint8(0)
        bits |= np.uint8(64) if parent[i - _ONE] == 2 else np.uint8(0)
        bits |= np.uint8(128) if parent[i - s - _ONE] == 3 else np.uint8(0)
        children[i] = bits


@helper
def _evaluate(grid, climbs, cost, root, walk, queue, keys):
    """Sets costs to those driven along the parents, for all cells with a path. Returns the largest."""
    cell_cost = grid[0]
    children, steps, lengths, ways, many = walk
    half = np.uint64(queue.size >> 1)
    begin = np.uint64(0)
    end = _ONE
    queue[0] = root
    keys[0] = np.float32(0.0)
    highest = np.float32(0.0)
    # A generation of cells in one half of the queue, their children in the other: that much stays in a near cache.
    while begin < end:
        born = half if begin < half else np.uint64(0)
        n = born
        for i in range(begin, end):
            ahead = np.uint64(queue[i + _AHEAD])
            prefetch(children, ahead)
            prefetch(cell_cost, ahead)
            prefetch(cost, ahead)
            u = np.uint64(queue[i])
            key = keys[i]
            cost[u] = key
            highest = max(highest, key)
            own = cell_cost[u]
            bits = np.uint64(children[u])
            count = np.uint64(many[bits])
            at = np.int64(u)
            if climbs is None:
                # Few cells have more than two children: nearly no branch is foretold wrongly.
                for j in range(_TWO):
                    queue[n + j] = at + steps[bits, j]
                    keys[n + j] = key + own * lengths[bits, j]
            for j in range(_TWO if climbs is None else np.uint64(0), count):
                v = np.uint64(at + steps[bits, j])
                queue[n + j] = v
                keys[n + j] = offered(key, own, climbs, v, u, ways[bits, j], lengths[bits, j])
            n += count
        begin, end = born, n
    return highest


@helper
def _lower_branches(grid, climbs, cost, walk, queue, count, rows):
    """Lowers what hangs on the `count` cells of `queue`, whose costs have fallen, along the parents, and note all
    that in `rows`. A cell that hangs on two of them may be lowered twice. Returns how many times one was, or -1
    beyond the queue's room."""
    cell_cost, _, stride, _, _ = grid
    per_row = row_factor(stride)
    children, steps, lengths, ways, many = walk
    n, i = np.uint64(count), np.uint64(0)
    room = np.uint64(queue.size - 8)
    while i < n and n < room:
        u = np.uint64(queue[i])
        i += _ONE
        note(rows, per_row, u)
        key, own = cost[u], cell_cost[u]
        bits, at = np.uint64(children[u]), np.int64(u)
        for j in range(np.uint64(many[bits])):
            v = np.uint64(at + steps[bits, j])
            offer = offered(key, own, climbs, v, u, ways[bits, j], lengths[bits, j])
            if offer < cost[v]:
                cost[v] = offer
                queue[n] = v
                n += _ONE
    return np.int64(n) if i == n else np.int64(-1)


@helper
def _note_all(rows, stride):
    first, last = rows
    for row in range(first.size):
        first[row] = row * stride + 1
        last[row] = row * stride + stride - 2


@step_kernel(f"({GRID}, CLIMBS, {LABELS}, {BUCKETS}, f8, i8, {SCRATCH}, {_WALK})", CLIMBS)
def mend(grid, climbs, labels, buckets, farthest, most, scratch, walk):
    """Makes a tree exact, whatever its costs are, as long as its parents lead to the root.

    buckets   as `repair.spread` says
    farthest  s; the tree must be grown where a cost exceeds it
    most      how many cells are served in one spread
    scratch   as `repair.make_scratch` returns it, for as many buckets
    walk      as `make_walk` returns it

    Costs and parents are then those of a tree grown from scratch, bit for bit. Returns (cells visited, a cost, s,
    that none exceeds, whether the tree is exact). It is not exact if that would take longer than a full search:
    then each cost is at least the one driven along the parents, and more than its parent's by the step at least.
    """
    cell_cost, _, stride, _, _ = grid
    cost, parent, root = labels
    rows, _, _, lowered, best, entries, heads = scratch
    keys, queue, _ = entries
    _find_children(parent, stride, walk[0])
    highest = _evaluate(grid, climbs, cost, root, walk, queue, keys)
    visited = np.int64(cell_cost.size)
    if highest > farthest:
        return visited, highest, False
    _note_all(rows, stride)
    for turn in range(_TURNS):
        count = sweep(grid, climbs, cost, parent, rows, ANY_COST, best, lowered, np.int64(0))
        parent[root] = NONE
        if count == 0:
            return visited, highest, True
        clear_rows(rows, cell_cost.size)
        if not turn & 1:
            _find_children(parent, stride, walk[0])
            lower = _lower_branches(grid, climbs, cost, walk, lowered, count, rows)
            if lower < 0:
                break
            visited += lower
        else:
            served, _ = spread(grid, climbs, cost, buckets, lowered, count, rows, most, entries, heads)
            if served >= 0:
                point_near(grid, climbs, labels, rows)
                return visited + served, highest, True
            if served == -2:
                break
            visited += most
    _note_all(rows, stride)
    sweep(grid, climbs, cost, parent, rows, ANY_COST, best, lowered, np.int64(0))
    parent[root] = NONE
    return visited, highest, False
