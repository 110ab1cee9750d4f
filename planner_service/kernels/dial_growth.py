"""Exact growth with a bucket queue (R. B. Dial, "Algorithm 360: Shortest-path forest with topological ordering",
Communications of the ACM 12(11), 1969, 632-633).

All neighbours of a cell are offered the same exit key per kind of step (see `layout`). Cells leave the queue in the
order of their exit keys, so that the first offer to a cell is its least, and its cost is final at first touch: no
key is ever decreased. Octile steps make two keys per cell, straight and diagonal. Parents follow from the costs.

Therefore a growth can stop behind any bucket, and go on from there later: cells with a cost are exact, and no other
cell costs less than the next bucket begins with. Between two calls the cost of a lethal cell is WALL.

Arrays, beside those of `layout`:
    touched  uint32  (size + 1,)     padded cells that have a cost, in the order of the buckets they got it from
    batch    uint32  (size + AHEAD,) padded cells of the bucket that is being served
    queue    as of `heap_and_buckets`; `make_scratch` says how large
    aim      (lowest, most, boxes)   the lowest cell cost, s; what a cheapest way of an asker costs at most, s; and
                                     float32 (n, 5), the boxes of `partial_growth_kernels.find_aim`. A growth leaves
                                     out the cells over which every way of an asker without a cost costs more, even
                                     at the lowest cost. With `NO_AIM` it leaves out none
    state    int64   (5,)            the last bucket served; entries that wait in the queue; how many of `touched`
                                     were put into it; how many there are; 1 if cells were left out, else 0.
                                     (0, 0, 0, 1, 0) where a growth begins, with a cost of 0 for the root, the
                                     first of `touched`. (b, 0, m, n, 0) where one goes on from n cells with a cost,
                                     all whose cost falls into bucket b or less; the first m of them have no
                                     neighbour without one

The form of the loops was measured, and small changes cost much. Cells are touched without branches, sorted into
buckets in two passes (which bucket, then where in it: in one, each store had the next cell's loads wait), and taken
out of the chunks of their bucket into one row before they make their offers. The four and eight offers are
therefore written out here, and share no function with the offers of other kernels.

Indices are unsigned 64-bit: signed ones make numba test for negative ones, which blocks vectorisation. A uint64
meets only uint64 here, because with an int64 it would silently become float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import layout
from planner_service.kernels.decorators import helper, kernel, prefetch
from planner_service.kernels.heap_and_buckets import QUEUE, Queue, empty, make_queue, open_costs, put, take

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_ONE32 = np.float32(1.0)
_ZERO32 = np.float32(0.0)
WHOLE = -1
"""Most cells of a growth that is to reach all, from a new root."""
AHEAD = 8
"""Cells of a batch between asking for one's memory and using it: a fifth of the time at 2048 x 2048
(docs/design/bucket-queues.md)."""
Aim = tuple[float, float, NDArray[np.float32]]
NO_AIM: Aim = (0.0, np.inf, np.empty((1, 5), np.float32))
_DETOUR = np.float32(0.4142135)
"""Least that a diagonal octile step costs beyond a straight one, in straight ones."""
_AIM = "Tuple((f4, f4, f4[:, ::1]))"
_SCRATCH = f"Tuple((u4[::1], u4[::1], {QUEUE}))"


Scratch = tuple[NDArray[np.uint32], NDArray[np.uint32], Queue]


def make_scratch(size: int, rule: int, buckets: int) -> Scratch:
    """(touched, batch, queue) for a growth over `size` padded cells, for the worst case: the system keeps no page
    that was not written."""
    kinds = 2 if rule == layout.RULE_OCTILE else 1
    # Each cell is touched once; an offer to a cell that has a cost writes one place behind.
    touched, batch = np.empty(size + 1, np.uint32), np.empty(size + AHEAD, np.uint32)
    return touched, batch, make_queue(kinds * size, kinds * buckets)


@helper
def _choose(cell_cost, cost, length, inverse, least, cells, count, buckets):
    """buckets := which one each cell's exit key falls into, `least` at least."""
    for i in range(count):
        v = np.uint64(cells[i])
        buckets[i] = max(np.int32((cost[v] + cell_cost[v] * length) * inverse), least)


@helper
def _offer(grid, cost, straight, slanted, batch, n, touched, count):
    """Offer their exit keys to four or eight neighbours. Writes the cells that had no cost yet behind the `count`
    that are in `touched`; returns how many there are.

    straight, slanted  length of such steps; None: those neighbours are offered nothing. Paper steps take both in
                       one pass over the batch, which `./launch_scripts/bench peers` shows to be a fifth faster
                       than one after the other
    """
    cell_cost, _, stride, _, corners = grid
    s = np.uint64(stride)
    for p in range(n):
        ahead = np.uint64(batch[p + np.uint64(AHEAD)])
        prefetch(cell_cost, ahead)
        prefetch(cost, ahead - s)
        prefetch(cost, ahead)
        prefetch(cost, ahead + s)
        u = np.uint64(batch[p])
        above = u - s
        below = u + s
        north, west, east, south = cost[above], cost[u - _ONE], cost[u + _ONE], cost[below]
        if straight is not None:
            key = cost[u] + cell_cost[u] * straight
            for i, old in ((above, north), (u - _ONE, west), (u + _ONE, east), (below, south)):
                cost[i] = min(old, key)
                touched[count] = i
                count += np.uint64(old == layout.INF)
        if slanted is not None:
            key = cost[u] + cell_cost[u] * slanted
            # inf past a wall. inf - inf is no number, and no match: a shut diagonal touches nothing.
            for i, old, gate in (
                (above - _ONE, cost[above - _ONE], min(north, west)),
                (above + _ONE, cost[above + _ONE], min(north, east)),
                (below - _ONE, cost[below - _ONE], min(south, west)),
                (below + _ONE, cost[below + _ONE], min(south, east)),
            ):
                offer = key if corners else max(key, -gate)
                cost[i] = min(old, offer)
                touched[count] = i
                count += np.uint64(old - offer == layout.INF)
    return count


@helper
def _file(grid, cost, buckets, scratch, first, count, least):
    """Puts `count` cells of `touched`, from the place `first` on, into the queue. Returns as how many entries."""
    width, circle = buckets
    touched, batch, queue = scratch
    cells = touched[first:]
    length = np.uint64(circle)
    mask = length - _ONE
    inverse = _ONE32 / np.float32(width)
    _choose(grid[0], cost, _ONE32, inverse, least, cells, count, batch)
    put(queue, cells, count, batch, mask, _ZERO)
    if grid[3] != layout.RULE_OCTILE:
        return count
    _choose(grid[0], cost, layout.SQRT2, inverse, least, cells, count, batch)
    put(queue, cells, count, batch, mask, length)
    return count + count


@helper
def _leave_out(grid, cost, cells, count, aim, asker):
    """Takes the cells that `aim` leaves out from `cells`, and their costs. Returns how many are left. Divides as
    `box_of`."""
    stride, rule = grid[2], grid[3]
    lowest, most, boxes = aim
    row0, col0, row1, col1 = boxes[asker, 0], boxes[asker, 1], boxes[asker, 2], boxes[asker, 3]
    share = 1.0 / stride
    slanted = _DETOUR if rule == layout.RULE_OCTILE else _ZERO32
    left = _ZERO
    for i in range(count):
        v = np.int32(cells[i])
        line = np.int32((v + 0.5) * share)
        row, col = np.float32(line), np.float32(np.int32(v - line * np.int32(stride)))
        down = max(max(row0 - row, row - row1), _ZERO32)
        across = max(max(col0 - col, col - col1), _ZERO32)
        steps = max(down, across) + slanted * min(down, across)
        u = np.uint64(cells[i])
        near = cost[u] + steps * lowest <= most
        cost[u] = cost[u] if near else layout.INF
        cells[left] = cells[i]
        left += np.uint64(near)
    return left


@kernel(f"({layout.GRID}, f4[::1], {layout.BUCKETS}, {_SCRATCH}, i8[::1], i8[::1], i8, {_AIM})")
def grow_by_buckets(grid, cost, buckets, scratch, state, askers, most, aim):
    """Costs to a root. Goes on from `state`, which an earlier call left, or begins.

    buckets  width: below the lowest cell cost, s, so that nothing in a bucket leads back into it. count: of the
             circular queue, a power of two; count * width exceeds the costliest step by two widths
    scratch  as `make_scratch` returns it
    askers   padded cells, passable ones: it stops behind the bucket from which the last of them got its cost.
             Where it aims, those come first which are expected to cost less
    most     it stops as well once this many more cells have a cost. WHOLE: it stops for nothing, and begins with
             the root askers[0]. All of `cost` is written, inf on lethal cells
    Returns the last bucket, or TOO_FINE. No cost exceeds (last + 1) * width. While cells wait, by `state`, a cell
    without a cost costs that at least.

    With octile steps a cell waits twice, under its straight exit key in the first `count` buckets and under its
    diagonal one in as many behind them.
    """
    cell_cost, rule = grid[0], grid[3]
    touched, batch, queue = scratch
    width, circle = buckets
    head, tail = queue[3], queue[4]
    length = np.uint64(circle)
    mask = length - _ONE
    second = length if rule == layout.RULE_OCTILE else _ZERO

    if most == WHOLE:
        open_costs(cell_cost, cost)
        cost[np.uint64(askers[0])] = _ZERO32
        touched[0] = askers[0]
        state[0], state[1], state[2], state[3], state[4] = 0, 0, 0, 1, 0
    if state[1] == 0:
        empty(queue, 2 * circle if rule == layout.RULE_OCTILE else circle)
    current = np.int32(state[0])
    waiting, filed, total = np.uint64(state[1]), np.uint64(state[2]), np.uint64(state[3])
    limit = total + np.uint64(max(most, 0))
    asker = 0
    while True:
        # Cells touched from the last bucket join the queue: their cost is final.
        following = np.int32(current + 1)
        if aim[1] < layout.INF and np.float32(current) * np.float32(width) >= aim[2][asker, 4]:
            total = filed + _leave_out(grid, cost, touched[filed:], total - filed, aim, asker)
            state[4] = 1
        waiting += _file(grid, cost, buckets, scratch, filed, total - filed, following)
        filed = total
        if most != WHOLE:
            while asker < askers.size and cost[np.uint64(askers[asker])] < layout.INF:
                asker += 1
            if asker == askers.size or total >= limit:
                break
        if waiting == _ZERO or current > 1 << 20:
            break
        current = following
        b = np.uint64(current) & mask
        while head[b] == tail[b] and head[b + second] == tail[b + second]:
            current = np.int32(current + 1)
            b = np.uint64(current) & mask
        fresh = touched[total:]
        n = take(queue, b, batch)
        waiting -= n
        if rule == layout.RULE_PAPER:
            total += _offer(grid, cost, _ONE32, _ONE32, batch, n, fresh, _ZERO)
            continue
        count = _offer(grid, cost, _ONE32, None, batch, n, fresh, _ZERO)
        if rule == layout.RULE_OCTILE:
            n = take(queue, b + length, batch)
            waiting -= n
            count = _offer(grid, cost, None, layout.SQRT2, batch, n, fresh, count)
        total += count
    state[0], state[1], state[2], state[3] = current, waiting, filed, total
    if most == WHOLE:
        for i in range(cost.size):
            cost[i] = abs(cost[i])  # inf of a wall
    return current if current <= 1 << 20 or waiting == _ZERO else layout.TOO_FINE


@kernel("void(f4[::1], u4[::1], i8[::1], i8)")
def begin(cost, touched, state, root):
    """Begins the growth of a padded root, or none if that is -1. The cells which the last growth touched cost inf
    again; those that are lethal by now keep WALL."""
    for i in range(state[3]):
        v = np.uint64(touched[i])
        c = cost[v]
        cost[v] = layout.INF if c >= _ZERO32 else c
    state[:] = 0
    if root >= 0:
        cost[root], touched[0], state[3] = _ZERO32, root, 1
