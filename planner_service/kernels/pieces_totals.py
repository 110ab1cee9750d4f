"""What the pieces of a tree cost, and by it any cell: see `pieces`."""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import helper, kernel, prefetch
from planner_service.kernels.layout import GRID, NONE, check_cells
from planner_service.kernels.pieces import (
    BEFORE,
    BENCH,
    BITS,
    CELLS,
    CHANGED,
    HOOK,
    HOOKS,
    INSIDE,
    LABELLED,
    LED,
    LENGTH,
    LOOK,
    NEAR,
    NOTED,
    PIECES,
    REHOOK,
    ROOM,
    ROOT_PIECE,
    SEEK,
    SIDE,
    STAMP,
    TILES,
    TODO,
    TOTAL,
    TURNS,
    WAITS,
    corner_of,
    following,
    moved,
    name_of,
    put_about,
    step_cost,
    tile_of,
    where_to,
)
from planner_service.kernels.pieces_risen import find_risen, note_changes


@helper
def _forget(total, y):
    """Changes of a piece's total are reckoned from now on."""
    cost, before = total[y, TOTAL], total[y, BEFORE]
    total[y, BEFORE] = cost if cost < np.inf else (-abs(before) if before < np.inf else np.inf)


@helper
def _forget_all(t, total, exits, many):
    """Changes of a tile's totals are reckoned from now on."""
    for j in range(many[t]):
        _forget(total, t * ROOM + np.int64(exits[t * ROOM + j]))


@helper
def _hook(t, name, grid, labels, pieces, across, names):
    """Write where a piece leads, and how far that is."""
    cell_cost, offsets, stride, rule, _ = grid
    parent, piece, rim, _ = labels
    total, hook = pieces
    y = t * ROOM + name
    if name == ROOT_PIECE:
        hook[y, HOOK] = -1
        total[y, LENGTH] = 0.0
        return
    origin, _, _ = corner_of(grid, across, t)
    cell = np.int64(names[name])
    v = origin + (cell >> BITS) * stride + (cell & INSIDE)
    way = np.int64(parent[v])
    other, beside = where_to(across, t, cell, way)
    hook[y, HOOK] = other * ROOM + np.int64(piece[other * CELLS + beside])
    total[y, LENGTH] = rim[other * ROOM + name_of(beside)] + step_cost(rule, cell_cost[v + offsets[way]], way)


@helper
def _hook_all(grid, labels, pieces, tiles, names, turns):
    """Hook the pieces of tiles of `HOOKS` whose parents have changed, and those that lead there."""
    total, hook = pieces
    exits, many, _, wanted, _, _, across = tiles
    order, _, _, _, _, sets, words = turns
    n = following(HOOKS, 0, sets, words)
    while n < order.size:
        t = order[n]
        anew = wanted[t] & REHOOK != 0
        if anew:
            sets[WAITS, n] = sets[CHANGED, n] = 1
            _forget_all(t, total, exits, many)
        for j in range(many[t] if wanted[t] & (REHOOK | LED) else 0):
            name = np.int64(exits[t * ROOM + j])
            y = t * ROOM + name
            if anew or (hook[y, HOOK] >= 0 and wanted[hook[y, HOOK] // ROOM] & REHOOK):
                _hook(t, name, grid, labels, pieces, across, names)
                sets[WAITS, n] = 1
        n = following(HOOKS, n + 1, sets, words)
    n = following(HOOKS, 0, sets, words)
    while n < order.size:
        sets[HOOKS, n] = 0
        wanted[order[n]] &= ~(REHOOK | LED)
        n = following(HOOKS, n + 1, sets, words)


@helper
def _add_up(t, pieces, exits, many, first):
    """Totals of a tile := what its exits are offered. Returns whether one has changed. `first`: none of them has
    before in this evaluation."""
    total, hook = pieces
    changed = False
    for j in range(many[t]):
        y = t * ROOM + np.int64(exits[t * ROOM + j])
        next = np.int64(hook[y, HOOK])
        cost = total[y, LENGTH] + (total[next, TOTAL] if next >= 0 else 0.0)
        if cost != total[y, TOTAL]:
            if first and not changed:
                _forget_all(t, total, exits, many)
            changed = True
            total[y, TOTAL] = cost
    return changed


@helper
def _add_up_all(pieces, tiles, turns):
    """The same for all tiles, each piece after the one that it leads into."""
    total, hook = pieces
    exits, many = tiles[0], tiles[1]
    order, _, _, now, stack, sets, _ = turns
    for n in range(order.size):
        t = order[n]
        next = order[min(n + 1, order.size - 1)]
        for j in range(many[next]):
            prefetch(total, (next * ROOM + np.int64(exits[next * ROOM + j])) * 4)
        sets[WAITS, n] = sets[CHANGED, n] = 0
        sets[NOTED, n] = sets[NEAR, n] = 1
        for j in range(many[t]):
            y = t * ROOM + np.int64(exits[t * ROOM + j])
            steps = 0
            while y >= 0 and hook[y, STAMP] != now:
                stack[steps] = y
                steps += 1
                y = np.int64(hook[y, HOOK])
            cost = total[y, TOTAL] if y >= 0 else 0.0
            for i in range(steps - 1, -1, -1):
                y = np.int64(stack[i])
                cost += total[y, LENGTH]
                _forget(total, y)
                total[y, TOTAL] = cost
                hook[y, STAMP] = now
        note_changes(t, pieces, tiles)


@helper
def evaluate_totals(grid, labels, pieces, tiles, names, turns, now):
    """Totals := what is driven from each exit to the root, after what has changed about tiles of `HOOKS`.

    now    0, or a number that `now` never was: most totals are expected to have changed, as when the root has moved
    If not, tiles about one whose totals have changed are added up, those nearest the root first. That takes a tenth
    of the time where few change; where all do, each tile of 4096 x 4096 cells would be added up 7 times. Either way
    it ends, as no piece leads to itself.
    """
    across = tiles[6]
    order, place, _, _, _, sets, words = turns
    _hook_all(grid, labels, pieces, tiles, names, turns)
    if now:
        _add_up_all(pieces, tiles, turns)
    n = following(WAITS, 0, sets, words)
    while n < order.size:
        sets[WAITS, n] = 0
        if _add_up(order[n], pieces, tiles[0], tiles[1], not sets[CHANGED, n]):
            sets[CHANGED, n] = 1
            put_about(WAITS, order[n], across, place, sets)
            sets[WAITS, n] = 0
        n = following(WAITS, n + 1, sets, words)
        if n >= order.size:
            n = following(WAITS, 0, sets, words)


@helper
def begin(tiles, turns):
    """Make the sets from what is wanted of tiles."""
    wanted, falls, across = tiles[3], tiles[4], tiles[6]
    order, place, _, _, _, sets, _ = turns
    for n in range(order.size):
        t = order[n]
        if wanted[t] & REHOOK:
            put_about(HOOKS, t, across, place, sets)
        sets[NEAR, n] = wanted[t] & (LOOK | SEEK) != 0 or falls[2, t] > 0.0
        sets[TODO, n] = 0


@kernel(f"({GRID}, {LABELLED}, {PIECES}, {TILES}, {BENCH}, {TURNS})")
def add_up(grid, labels, pieces, tiles, bench, turns):
    """Evaluate totals, and note where they have risen."""
    begin(tiles, turns)
    evaluate_totals(grid, labels, pieces, tiles, bench[0], turns, turns[3])
    find_risen(labels, pieces, tiles, bench, turns)


@kernel(f"({GRID}, {LABELLED}, {PIECES}, {BENCH}, i8, i8[::1], f8[::1])")
def costs_at(grid, labels, pieces, bench, across, cells, costs):
    """costs := float64, s, of padded cells; inf where there is no way. Raises ValueError where one is no cell."""
    cell_cost, offsets, stride, rule, _ = grid
    parent, piece, _, _ = labels
    total, steps_s, kept, place = pieces[0], bench[1], bench[10], bench[11]
    check_cells(cells, cell_cost.size)
    for i in range(cells.size):
        v = cells[i]
        t, cell = tile_of(v, stride, across)
        costs[i] = total[t * ROOM + np.int64(piece[t * CELLS + cell]), TOTAL]
        if place[t] >= 0:
            costs[i] += kept[np.int64(place[t]) * CELLS + cell]
            continue
        row, col = cell >> BITS, cell & INSIDE
        way = np.int64(parent[v])
        steps = 0
        while way != NONE:
            down, right = moved(way)
            row += down
            col += right
            if (row | col) & -SIDE:
                break
            v += offsets[way]
            steps_s[steps] = step_cost(rule, cell_cost[v], way)
            steps += 1
            way = np.int64(parent[v])
        # Summed from the exit, as elsewhere: the same numbers in another order are another sum.
        inner = 0.0
        for step in range(steps - 1, -1, -1):
            inner += steps_s[step]
        costs[i] += inner
