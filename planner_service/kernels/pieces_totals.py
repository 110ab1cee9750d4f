"""What the pieces of a tree cost, and by it any cell: see `pieces`."""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.layout import GRID, NONE, check_cells
from planner_service.kernels.pieces import (
    BEFORE,
    BENCH,
    BITS,
    CELLS,
    FINEST,
    HOOK,
    INSIDE,
    LABELLED,
    LENGTH,
    LOOK,
    PIECES,
    REHOOK,
    ROOM,
    ROOT_PIECE,
    SIDE,
    STAMP,
    TILES,
    TOTAL,
    TURNS,
    corner_of,
    moved,
    name_of,
    step_cost,
    tile_of,
    where_to,
)
from planner_service.kernels.pieces_labels import want

_WAITS, _CHANGED = np.uint8(4), np.uint8(8)
"""What is to be done to a tile, beside `LOOK` and `REHOOK`, while totals are added up."""
_DRIFT = 4.0
"""How many times that a tile's totals may come apart before it is looked at."""


@helper
def _hook_tile(t, grid, labels, pieces, tiles, names):
    """Write where the pieces of a tile lead, and how far that is."""
    cell_cost, offsets, stride, rule, _ = grid
    parent, piece, rim, _ = labels
    total, hook = pieces
    exits, many, _, _, _, _, across = tiles
    origin, _, _ = corner_of(grid, across, t)
    for j in range(many[t]):
        name = np.int64(exits[t * ROOM + j])
        y = t * ROOM + name
        if name == ROOT_PIECE:
            hook[y, HOOK] = -1
            total[y, LENGTH] = 0.0
            continue
        cell = np.int64(names[name])
        v = origin + (cell >> BITS) * stride + (cell & INSIDE)
        way = np.int64(parent[v])
        other, beside = where_to(across, t, cell, way)
        hook[y, HOOK] = other * ROOM + np.int64(piece[other * CELLS + beside])
        total[y, LENGTH] = rim[other * ROOM + name_of(beside)] + step_cost(rule, cell_cost[v + offsets[way]], way)


@helper
def _add_up(t, pieces, tiles):
    """Totals of a tile := what its exits are offered. Returns whether one has changed."""
    total, hook = pieces
    exits, many = tiles[0], tiles[1]
    changed = False
    for j in range(many[t]):
        y = t * ROOM + np.int64(exits[t * ROOM + j])
        next = np.int64(hook[y, HOOK])
        cost = total[y, LENGTH] + (total[next, TOTAL] if next >= 0 else 0.0)
        changed |= cost != total[y, TOTAL]
        total[y, TOTAL] = cost
    return changed


@helper
def _add_up_all(pieces, tiles, order, now, stack):
    """The same for all tiles, each piece after the one that it leads into."""
    total, hook = pieces
    exits, many, _, wanted, _, _, _ = tiles
    for n in range(order.size):
        t = order[n]
        wanted[t] = (wanted[t] & LOOK) | _CHANGED
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
                total[y, TOTAL] = cost
                hook[y, STAMP] = now


@helper
def _note_changes(t, pieces, tiles):
    """Write `falls` and `ends` of a tile whose totals have changed."""
    total = pieces[0]
    exits, many, _, _, falls, ends, _ = tiles
    least, most, near, far = np.inf, -np.inf, np.inf, 0.0
    for j in range(many[t]):
        y = t * ROOM + np.int64(exits[t * ROOM + j])
        cost = total[y, TOTAL]
        change = 0.0
        if cost < np.inf or total[y, BEFORE] < np.inf:
            change = cost - total[y, BEFORE]
        total[y, BEFORE] = cost
        least = min(least, change)
        most = max(most, change)
        near = min(near, cost)
        far = max(far, cost)
    falls[0, t] = least
    falls[1, t] = most
    ends[0, t] = near
    ends[1, t] = far


@helper
def evaluate_totals(grid, labels, pieces, tiles, names, order, now, stack):
    """Totals := what is driven from each exit to the root.

    order  all tiles, those nearest the root first
    now    0, or a number that `now` never was: most totals are expected to have changed, as when the root has moved
    If not, tiles about one whose totals have changed are added up, sweep by sweep. That takes a tenth of the time
    where few change; where all do, each tile of 4096 x 4096 cells would be added up 7 times. Either way it ends, as
    no piece leads to itself.
    """
    many, wanted = tiles[1], tiles[3]
    for t in range(many.size):
        if wanted[t] & REHOOK:
            _hook_tile(t, grid, labels, pieces, tiles, names)
            wanted[t] = (wanted[t] & ~REHOOK) | _WAITS | _CHANGED
    if now:
        _add_up_all(pieces, tiles, order, now, stack)
    again = not now
    while again:
        again = False
        for n in range(order.size):
            t = order[n]
            if not wanted[t] & _WAITS:
                continue
            wanted[t] &= ~_WAITS
            if _add_up(t, pieces, tiles):
                wanted[t] |= _CHANGED
                want(tiles, t, _WAITS)
                wanted[t] &= ~_WAITS
                again = True


@helper
def find_risen(pieces, tiles, todo):
    """Returns how many tiles are to be looked at, and writes 1 to `todo` for these, 0 for others: where it is
    wanted, and where totals have risen by more than others about them since this was last called."""
    _, many, _, wanted, falls, ends, across = tiles
    down = many.size // across
    for t in range(many.size):
        falls[0, t], falls[1, t] = (0.0, 0.0) if many[t] else (np.inf, -np.inf)
        if wanted[t] & _CHANGED:
            wanted[t] &= ~_CHANGED
            _note_changes(t, pieces, tiles)
    count = 0
    for row in range(down):
        for col in range(across):
            t = row * across + col
            least = np.inf
            for i in range(max(row - 1, 0), min(row + 2, down)):
                for j in range(max(col - 1, 0), min(col + 2, across)):
                    least = min(least, falls[0, i * across + j])
            # Its own pieces have risen by no more than those about it that offer them less.
            if falls[1, t] > least:
                falls[2, t] += falls[1, t] - least
            elif least == -np.inf:
                # It has no way, or had none: that it has not risen by more than who has got one says nothing.
                falls[2, t] = np.inf
            near = ends[0, t] if ends[0, t] < np.inf else 0.0
            todo[t] = 1 if wanted[t] & LOOK or falls[2, t] > _DRIFT * FINEST * near else 0
            count += todo[t]
    return count


@kernel(f"({GRID}, {LABELLED}, {PIECES}, {TILES}, i2[::1], {TURNS})")
def add_up(grid, labels, pieces, tiles, names, turns):
    """Evaluate totals, and note where they have risen."""
    order, _, now, stack, todo = turns
    evaluate_totals(grid, labels, pieces, tiles, names, order, now, stack)
    find_risen(pieces, tiles, todo)


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
