"""Exact growth over cell costs of any ratio, by approximate buckets (B. V. Cherkassky, A. V. Goldberg, T. Radzik,
"Shortest paths algorithms: theory and experimental evaluation", Mathematical Programming 73, 1996, 129-174) whose
width follows the map.

As in `queue_dial`, all neighbours of a cell are offered the same exit key per kind of step, and cells are served a
bucket at a time. But a bucket may be wider than the cheapest steps: a cell whose exit key falls back into the
bucket that touched it is served again at once, until none is offered less (label correction). Then all that the
bucket has touched is final, as later keys are larger, and waits once under its exit keys, as there.

Any width is therefore exact, and the width is chosen by the costs met. After each circle of buckets it grows where
these held few cells. A bucket in which too many are served again is undone: what it touched loses its cost, and all
that waits is put into narrower ones. Keys beyond a circle wait behind it, until the circle is filled again from its
lowest key on; cells without a neighbour that could still be touched are then dropped.

Arrays, beside those of `layout`:
    touched         uint32  (size + AHEAD,)  padded cells that got their cost from the last bucket
    batch, slanted  uint32  (size + AHEAD,)  those of the bucket that is served, by straight and by diagonal steps
    places          uint32  (size + AHEAD,)  where in the queue cells go; a ring of those to serve again
    queue           as in `heap_and_buckets`; for each kind of step `CIRCLE` buckets and one for keys behind them

While a bucket is served, the cost of a cell that waits to be served again is negative, and WALL on lethal cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.decorators import helper, kernel
from planner_service.kernels.heap_and_buckets import QUEUE, Queue, empty, make_queue, put, take
from planner_service.kernels.layout import GRID, INF, RULE_OCTILE, RULE_PAPER, SQRT2, WALL, diagonal_length, is_shut
from planner_service.kernels.queue_dial import (
    AHEAD,
    close_costs,
    offer_around,
    offer_diagonal,
    offer_straight,
    open_costs,
)

_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_ONE32 = np.float32(1.0)
_ZERO32 = np.float32(0.0)
_EVERY_BIT = np.uint64(0xFFFFFFFF)
"""Mask of `put` where the places are a line, no circle."""
_FAR = np.float32(1 << 30)
"""No bucket has a larger number, so that it fits int32."""
CIRCLE = 1 << 9
"""Buckets of each kind of step."""
_CIRCLE, _MASK = np.int32(CIRCLE), np.int32(CIRCLE - 1)
_STRAIGHT, _DIAGONAL = np.uint64(0), np.uint64(CIRCLE + 1)
"""The first bucket of each kind of step."""
_BEHIND = np.uint64(CIRCLE)
"""Counted from there, the one behind the circle."""
_LAST = 1 << 20
"""Buckets are counted from 0 again beyond this one: float32 distinguishes this number."""
_SPARSE = np.uint64(32)
"""Buckets that hold fewer cells, in the mean of a circle, get wider."""
_WIDER, _NARROWER = np.float32(8.0), np.float32(1 / 8)
"""Factors by which the width of buckets is changed. Chosen, not measured."""
_FEW, _AGAIN = np.uint64(1024), np.uint64(2)
"""Number of cells that may be served again in a bucket, and for each cell of it."""
_ANY = np.uint64(1 << 62)
"""More than are ever served: at the least width there is no limit."""
_SCRATCH = f"Tuple((u4[::1], u4[::1], u4[::1], u4[::1], {QUEUE}))"

Scratch = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32], Queue]


def make_scratch(size: int, rule: int) -> Scratch:
    """(touched, batch, slanted, places, queue) for a growth over `size` padded cells, for the worst case: the
    system keeps no page that was not written."""
    kinds = 2 if rule == RULE_OCTILE else 1
    # Each cell is touched once; an offer to a cell that has a cost writes one place behind.
    touched, batch, slanted, places = (np.empty(size + AHEAD, np.uint32) for _ in range(4))
    return touched, batch, slanted, places, make_queue(kinds * size, kinds * (CIRCLE + 1))


@helper
def _bucket(key, base, inverse):
    return np.int32(min((key - base) * inverse, _FAR))


@helper
def _file(cell_cost, cost, length, first, era, current, cells, count, queue, left, places):
    """Puts those cells into the queue whose exit key lies beyond the bucket `current`: into the circle of this kind
    of step, which begins at `first`, or behind it if their turn does not come within a circle. Returns how many."""
    base, inverse = era
    n = _ZERO
    for i in range(count):
        v = np.uint64(cells[i])
        b = _bucket(cost[v] + cell_cost[v] * length, base, inverse)
        left[n] = v
        places[n] = first + np.uint64(b & _MASK if b - current < _CIRCLE else _CIRCLE)
        n += np.uint64(b > current)
    put(queue, left, n, places, _EVERY_BIT, _ZERO)
    return n


@helper
def _put_behind(queue, cells, count, first, places):
    for i in range(count):
        places[i] = first + _BEHIND
    put(queue, cells, count, places, _EVERY_BIT, _ZERO)


@helper
def _gather(grid, cost, queue, kind, length, first, least, cells, batch):
    """Takes all entries that wait by a kind of step (1 of diagonal ones, 2 of both) out of the queue, and keeps
    those with a neighbour that has no cost yet: if most cells are expensive, most wait in vain. Returns (how many
    are in `cells`, the lowest of their exit keys and `least`)."""
    cell_cost, offsets, _, _, _ = grid
    kept = _ZERO
    for b in range(first, first + _BEHIND + _ONE):
        n = take(queue, b, batch)
        for i in range(n):
            v = np.uint64(batch[i])
            wanted = False
            for k in range(kind & 1, 8, 1 if kind == 2 else 2):
                wanted |= cost[v + np.uint64(offsets[k])] == INF
            cells[kept] = v
            kept += np.uint64(wanted)
            key = cost[v] + cell_cost[v] * length
            least = min(least, key if wanted else INF)
    return kept, least


@helper
def _begin_anew(grid, cost, width, batch, slanted, places, queue):
    """Fills the circles from the lowest exit key on. Returns (that key, how many wait)."""
    cell_cost, _, _, rule, _ = grid
    n, base = _gather(grid, cost, queue, 2 if rule == RULE_PAPER else 0, _ONE32, _STRAIGHT, INF, batch, places)
    m = _ZERO
    if rule == RULE_OCTILE:
        m, base = _gather(grid, cost, queue, 1, SQRT2, _DIAGONAL, base, slanted, places)
    era = base, _ONE32 / width
    none = np.int32(-1)
    _file(cell_cost, cost, _ONE32, _STRAIGHT, era, none, batch, n, queue, batch, places)
    _file(cell_cost, cost, SQRT2, _DIAGONAL, era, none, slanted, m, queue, slanted, places)
    return base, n + m


@helper
def _serve_again(grid, cost, era, current, touched, count, ring, most):
    """Serves those touched cells whose exit key falls back into the bucket that touched them, until none is offered
    less.

    Returns (how many cells are touched now, how many were served, whether they are no more than `most`; if not,
    costs are not right yet)."""
    cell_cost, offsets, _, rule, corners = grid
    base, inverse = era
    slant = diagonal_length(rule)
    size = np.uint64(ring.size)
    head = tail = _ZERO
    for i in range(count):
        v = np.uint64(touched[i])
        back = _bucket(cost[v] + cell_cost[v], base, inverse) <= current
        ring[tail] = v
        tail += np.uint64(back)
        cost[v] = -cost[v] if back else cost[v]
    served = _ZERO
    waiting = tail
    while waiting > _ZERO and served <= most:
        u = np.uint64(ring[head])
        head = head + _ONE if head + _ONE < size else _ZERO
        waiting -= _ONE
        served += _ONE
        own = -cost[u]
        cost[u] = own
        straight = own + cell_cost[u]
        diagonal = own + cell_cost[u] * slant
        if _bucket(diagonal, base, inverse) > current:
            diagonal = INF
        for k in range(8):
            v = u + np.uint64(offsets[k])
            old = cost[v]
            key = diagonal if k & 1 else straight
            if not key < abs(old) or old == WALL:
                continue
            if k & 1 and not corners and is_shut(cell_cost, offsets, u, k):
                continue
            if old == INF:
                touched[count] = v
                count += _ONE
            waits = old < _ZERO32
            back = waits or _bucket(key + cell_cost[v], base, inverse) <= current
            cost[v] = -key if back else key
            if back and not waits:
                ring[tail] = v
                tail = tail + _ONE if tail + _ONE < size else _ZERO
                waiting += _ONE
    return count, served, waiting == _ZERO


@kernel(f"({GRID}, f4[::1], i8, f8, {_SCRATCH})")
def grow_by_wide_buckets(grid, cost, root, narrowest, scratch):
    """Costs to `root`, a padded, passable cell. `cost` is written whole.

    narrowest  s; how wide a bucket is at least: a little less than the lowest cell cost
    scratch    as `make_scratch` returns it
    Returns a bound, s, that no cost exceeds.
    """
    cell_cost, _, stride, rule, corners = grid
    touched, batch, slanted, places, queue = scratch
    head, tail = queue[3], queue[4]
    octile = rule == RULE_OCTILE
    slants = _DIAGONAL if octile else _STRAIGHT
    empty(queue, head.size)
    open_costs(cell_cost, cost)
    cost[np.uint64(root)] = _ZERO32
    touched[0] = root
    count = _ONE
    width = least_width = np.float32(narrowest)
    base = _ZERO32
    current, until = np.int32(-1), np.int32(CIRCLE)
    waiting = turned = served = again = _ZERO
    s = np.uint64(stride)
    while True:
        # Cells touched by the last bucket are final.
        era = base, _ONE32 / width
        waiting += _file(cell_cost, cost, _ONE32, _STRAIGHT, era, current, touched, count, queue, batch, places)
        if octile:
            waiting += _file(cell_cost, cost, SQRT2, _DIAGONAL, era, current, touched, count, queue, batch, places)
        if waiting == _ZERO:
            close_costs(cost)
            return np.float64(base) + (np.float64(current) + 1.0) * np.float64(width) * 1.000001
        current += np.int32(1)
        b = np.uint64(current & _MASK)
        while current < until and head[b] == tail[b] and head[b + slants] == tail[b + slants]:
            current += np.int32(1)
            b = np.uint64(current & _MASK)
        factor = _ONE32
        anew = current > _LAST
        if current == until:
            until += _CIRCLE
            anew |= head[_BEHIND] != tail[_BEHIND] or head[_BEHIND + slants] != tail[_BEHIND + slants]
            if served < _SPARSE * turned:
                factor = _WIDER
            elif again > served:
                factor = _NARROWER
            turned = served = again = _ZERO
        settled = False
        n = m = more = _ZERO
        while not settled:
            if anew or factor != _ONE32:
                wider = max(width * factor, least_width)
                lowest, waiting = _begin_anew(grid, cost, wider, batch, slanted, places, queue)
                if waiting == _ZERO:  # all that waited did so in vain
                    count = more = _ZERO
                    break
                width, base = wider, lowest
                era = base, _ONE32 / width
                current, until = np.int32(0), _CIRCLE
                b = _ZERO
            n = take(queue, b, batch)
            if rule == RULE_PAPER:
                count = offer_around(cell_cost, cost, s, corners, batch, n, touched)
            else:
                count = offer_straight(cell_cost, cost, s, batch, n, touched)
            if octile:
                m = take(queue, b + slants, slanted)
                count = offer_diagonal(cell_cost, cost, s, corners, slanted, m, touched, count)
            most = _FEW + _AGAIN * (n + m) if width > least_width else _ANY
            count, more, settled = _serve_again(grid, cost, era, current, touched, count, places, most)
            if not settled:
                for i in range(count):
                    cost[np.uint64(touched[i])] = INF
                _put_behind(queue, batch, n, _STRAIGHT, places)
                _put_behind(queue, slanted, m, _DIAGONAL, places)
                factor = _NARROWER
        waiting -= n + m
        turned += _ONE
        served += n + m
        again += more
