"""Making a tree of `pieces` optimal again: tiles are looked at and mended.

A cell is *offered less* where a neighbour's cost and the step to it are less than what it costs. Tiles that may
hold such a cell, which `pieces_risen` finds, are looked at: with one cell around, by vectors; and cells that are
offered less take it, and spread it inside the tile, by a label-correcting search. What that offers to cells of
other tiles is left to these.

The invariant: **what a cell costs is at least what its parent offers**. It holds where costs are what is driven; a
cell that takes less takes whoever offers it as its parent, so that its children are offered no more than
they cost; and only falls. Steps cost something, so costs fall strictly along parents: there is never a cycle.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.heap import heap_lower, heap_pop
from planner_service.kernels.layout import (
    GRID,
    INF,
    RULE_FOUR,
    RULE_OCTILE,
    SQRT2_EXACT,
)
from planner_service.kernels.pieces import (
    BENCH,
    BITS,
    BLIND,
    CELLS,
    FINEST,
    HOOKS,
    LABELLED,
    LED,
    LOOK,
    LOST,
    NEAR,
    PIECES,
    REHOOK,
    ROOM,
    ROOT_PIECE,
    SEEK,
    SIDE,
    TILES,
    TODO,
    TOTAL,
    TURNS,
    WIDE,
    corner_of,
    following,
    moved,
    name_of,
    put_about,
    step_cost,
    where_to,
)
from planner_service.kernels.pieces_labels import drive_tile, keep_tile
from planner_service.kernels.pieces_risen import find_risen
from planner_service.kernels.pieces_totals import begin, evaluate_totals

_ONE = np.uint64(1)


@helper
def _lay_line(count, first, steps, other, grid, labels, total, bench):
    """Put `count` cells of tile `other` on the bench; there is no such tile where cells are lethal.

    first  where the first is on the map, in its tile, on the bench
    steps  from one to the next, in the same order
    """
    cell_cost = grid[0]
    piece, rim = labels[1], labels[2]
    cost, own = bench[1], bench[2]
    g, cell, at = first
    for _ in range(count):
        own[at] = cell_cost[g]
        cost[at] = np.inf
        if cell_cost[g] < INF:
            name = np.int64(piece[other * CELLS + cell])
            cost[at] = total[other * ROOM + name, TOTAL] + rim[other * ROOM + name_of(cell)]
        g += steps[0]
        cell += steps[1]
        at += steps[2]


@helper
def _lay(t, grid, labels, total, tiles, bench):
    """Put a tile on the bench, with the cells around."""
    stride = grid[2]
    piece, across = labels[1], tiles[6]
    cost, inner = bench[1], bench[3]
    drive_tile(t, grid, labels, tiles, bench)
    origin, rows, cols = corner_of(grid, across, t)
    if rows < SIDE or cols < SIDE:
        for i in range(cost.size):
            cost[i] = np.inf
    totals = np.uint64(t * ROOM)
    for row in range(rows):
        i = np.uint64(t * CELLS + (row << BITS))
        at = np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(cols)):
            cost[at + col] = total[totals + np.uint64(piece[i + col]), TOTAL] + inner[at + col]
    for down in range(-1, 2):
        for right in range(-1, 2):
            if not (down or right):
                continue
            # The first cell around on this side, counted from the tile's first; and how many there are.
            row = rows if down > 0 else down
            col = cols if right > 0 else right
            count = 1 if down and right else (cols if down else rows)
            other = t + down * across + right
            cell = ((row & (SIDE - 1)) << BITS) + (col & (SIDE - 1))
            at = (row + 1) * WIDE + col + 1
            g = origin + row * stride + col
            steps = (1, 1, 1) if down else (stride, SIDE, WIDE)
            _lay_line(count, (g, cell, at), steps, other, grid, labels, total, bench)


@helper
def _find_less(cost, own, begin, end, diagonal, corners, least, less):
    """less := 1 where a cell is offered less than it costs by more than `least`, 0 elsewhere. Without a branch,
    so that it vectorises."""
    s = np.uint64(WIDE)
    for i in range(begin, end):
        north, east, south, west = own[i - s], own[i + _ONE], own[i + s], own[i - _ONE]
        best = min(min(cost[i - s] + north, cost[i + _ONE] + east), min(cost[i + s] + south, cost[i - _ONE] + west))
        offer = cost[i - s + _ONE] + own[i - s + _ONE] * diagonal
        best = min(best, offer if corners or max(north, east) < np.inf else np.inf)
        offer = cost[i + s + _ONE] + own[i + s + _ONE] * diagonal
        best = min(best, offer if corners or max(south, east) < np.inf else np.inf)
        offer = cost[i + s - _ONE] + own[i + s - _ONE] * diagonal
        best = min(best, offer if corners or max(south, west) < np.inf else np.inf)
        offer = cost[i - s - _ONE] + own[i - s - _ONE] * diagonal
        best = min(best, offer if corners or max(north, west) < np.inf else np.inf)
        best = best if own[i] < np.inf else np.inf
        less[i] = 1 if best + least < cost[i] else 0


@helper
def _open(own, around, rule, corners, at, code):
    """Whether there is a step between a passable cell on the bench and the one in this direction."""
    if not code & 1:
        return True
    if rule == RULE_FOUR:
        return False
    return corners or max(own[at + around[code - 1]], own[at + around[(code + 1) & 7]]) < np.inf


@helper
def _take_less(at, t, cell, grid, labels, pieces, tiles, bench, least):
    """Have a cell of a tile, `at` on the bench, take the least that it is offered. Returns whether that is less."""
    _, _, stride, rule, corners = grid
    parent, piece, _, _ = labels
    cost, own, inner, around = bench[1], bench[2], bench[3], bench[9]
    across = tiles[6]
    best, by = np.inf, 0
    for code in range(8):
        u = at + around[code]
        if _open(own, around, rule, corners, at, code):
            offer = cost[u] + step_cost(rule, own[u], code)
            if offer < best:
                best, by = offer, code
    if not best + least < cost[at]:
        return False
    cost[at] = best
    origin, _, _ = corner_of(grid, across, t)
    parent[origin + (cell >> BITS) * stride + (cell & (SIDE - 1))] = by
    other, beside = where_to(across, t, cell, by)
    i = t * CELLS + cell
    if other == t:
        u = at + around[by]
        piece[i] = piece[t * CELLS + beside]
        inner[at] = inner[u] + step_cost(rule, own[u], by)
        return True
    name = name_of(cell)
    if piece[i] != name or inner[at] > 0.0:
        exits, many = tiles[0], tiles[1]
        exits[t * ROOM + many[t]] = name
        many[t] += 1
        piece[i] = name
        inner[at] = 0.0
    total = pieces[0]
    total[t * ROOM + name, TOTAL] = best
    return True


@helper
def _spread(t, grid, labels, tiles, bench, count, least):
    """Spread what the `count` cells of the heap cost, inside the tile, the least first: most cells are then written
    once. Cells around that are offered less have their tile looked at."""
    _, offsets, stride, rule, corners = grid
    parent, piece, _, _ = labels
    span, wanted, across = tiles[2], tiles[3], tiles[6]
    cost, own, inner, around = bench[1], bench[2], bench[3], bench[9]
    queue, keys, spot = bench[5], bench[6], bench[13]
    first = t * CELLS
    origin, rows, cols = corner_of(grid, across, t)
    while count > 0:
        at = np.int64(queue[0])
        heap_pop(keys, queue, spot, count)
        count -= 1
        row, col = at // WIDE - 1, at % WIDE - 1
        v = origin + row * stride + col
        rim = row == 0 or col == 0 or row == rows - 1 or col == cols - 1
        for code in range(8):
            u = at + around[code]
            offer = cost[at] + step_cost(rule, own[at], code)
            child = parent[v + offsets[code]] == (code + 4) & 7
            # A child always follows, so that what a cell is said to cost is what is driven.
            if not offer + (0.0 if child else least) < cost[u] or not own[u] < np.inf:
                continue
            if not child and not _open(own, around, rule, corners, at, code):
                continue
            down, right = moved(code)
            down += row
            right += col
            if rim and (down | right) & -SIDE:
                other = t + (down >> BITS) * across + (right >> BITS)
                # A child's tile sees that its total changes.
                wanted[other] |= LED if child else LOOK
                continue
            cost[u] = offer
            piece[first + (down << BITS) + right] = piece[first + (row << BITS) + col]
            inner[u] = inner[at] + step_cost(rule, own[at], code)
            span[t] = max(span[t], inner[u])
            parent[v + offsets[code]] = (code + 4) & 7
            count = heap_lower(keys, queue, spot, count, np.float32(offer), u)


@helper
def _mend(t, grid, labels, pieces, tiles, bench):
    """Look at a tile; returns whether a parent has changed."""
    _, _, _, rule, corners = grid
    piece = labels[1]
    total = pieces[0]
    exits, many, span, _, _, _, across = tiles
    names, cost, own, less = bench[0], bench[1], bench[2], bench[4]
    queue, keys, spot = bench[5], bench[6], bench[13]
    _lay(t, grid, labels, total, tiles, bench)
    _, rows, cols = corner_of(grid, across, t)
    farthest = 0.0
    for j in range(many[t]):
        one = total[t * ROOM + np.int64(exits[t * ROOM + j]), TOTAL]
        farthest = max(farthest, one if one < np.inf else 0.0)
    least = (farthest + span[t]) * FINEST
    diagonal = np.inf if rule == RULE_FOUR else (SQRT2_EXACT if rule == RULE_OCTILE else 1.0)
    _find_less(*(cost, own, np.uint64(WIDE + 1), np.uint64((rows + 1) * WIDE - 1), diagonal, corners, least, less))
    count = 0
    for row in range(rows):
        first = np.uint64((row + 1) * WIDE + 1)
        some = np.int32(0)
        for col in range(np.uint64(cols)):
            some |= less[first + col]
        if some:
            for col in range(cols):
                at = (row + 1) * WIDE + col + 1
                if less[at] and _take_less(
                    *(at, t, (row << BITS) + col, grid, labels, pieces, tiles, bench, least)
                ):
                    count = heap_lower(keys, queue, spot, count, np.float32(cost[at]), at)
    if count == 0:
        return False
    _spread(t, grid, labels, tiles, bench, count, least)
    keep_tile(t, labels, bench)
    # Exits whose way leads on inside the tile by now are none any more; nobody leads over them.
    kept = 0
    for j in range(many[t]):
        name = np.int64(exits[t * ROOM + j])
        if name == ROOT_PIECE or piece[t * CELLS + names[name]] == name:
            exits[t * ROOM + kept] = name
            kept += 1
    many[t] = kept
    return True


@helper
def _is_first(t, across, turns):
    """Whether no tile about this one, of those to be looked at, has an earlier turn."""
    _, place, turn, _, _, sets, _ = turns
    row, col = t // across, t % across
    down = place.size // across
    for i in range(max(row - 1, 0), min(row + 2, down)):
        for j in range(max(col - 1, 0), min(col + 2, across)):
            other = i * across + j
            if turn[other] < turn[t] and sets[TODO, place[other]]:
                return False
    return True


@helper
def _any_lost(t, wanted, across):
    """Whether a piece of a tile, or of those about it, has no way."""
    row, col = t // across, t % across
    down = wanted.size // across
    what = np.uint8(0)
    for i in range(max(row - 1, 0), min(row + 2, down)):
        for j in range(max(col - 1, 0), min(col + 2, across)):
            what |= wanted[i * across + j]
    return what & LOST != 0


@kernel(f"({GRID}, {LABELLED}, {PIECES}, {TILES}, {BENCH}, {TURNS}, f8)")
def mend_tiles(grid, labels, pieces, tiles, bench, turns, most):
    """Evaluate totals, look at tiles and mend them, until the tree is optimal or `most` tiles have been looked at;
    one that was mended counts three times. Returns (tiles looked at, mended, rounds, whether some are left to be
    looked at).

    turns  (order, place, turn, now, stack, sets, words):
           order  int64 (n,), all tiles, those nearest the root first
           turn   float64 (n,): of tiles beside each other the one with the least is looked at first, and totals are
                  evaluated before the other is. All alike, all are looked at in each round
           now    of `evaluate_totals`, the first time
    """
    wanted, falls, across = tiles[3], tiles[4], tiles[6]
    order, place, _, now, _, sets, words = turns
    looked = mended = rounds = 0
    begin(tiles, turns)
    evaluate_totals(grid, labels, pieces, tiles, bench[0], turns, now)
    while True:
        rounds += 1
        find_risen(labels, pieces, tiles, bench, turns)
        n = following(TODO, 0, sets, words)
        if n >= order.size or looked + 2 * mended > most:
            return looked, mended, rounds, n < order.size
        while n < order.size:
            t = order[n]
            if _is_first(t, across, turns):
                looked += 1
                wanted[t] &= ~(LOOK | SEEK | BLIND)
                wanted[t] |= BLIND if _any_lost(t, wanted, across) else np.uint8(0)
                falls[2, t] = 0.0
                sets[NEAR, n] = 1
                if _mend(t, grid, labels, pieces, tiles, bench):
                    # Until totals are evaluated its own are what its exits were offered, and those of others too
                    # high.
                    wanted[t] |= REHOOK
                    put_about(HOOKS, t, across, place, sets)
                    put_about(NEAR, t, across, place, sets)
                    mended += 1
            n = following(TODO, n + 1, sets, words)
        evaluate_totals(grid, labels, pieces, tiles, bench[0], turns, np.int32(0))
