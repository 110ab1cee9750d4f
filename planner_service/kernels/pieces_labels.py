"""Which piece of a tree each cell of a tile is of, and what it costs inside the tile: `pieces` says more."""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.layout import GRID, NONE
from planner_service.kernels.pieces import (
    BENCH,
    BITS,
    CELLS,
    DEARER,
    LABELLED,
    LED,
    LOOK,
    NO_PIECE,
    REHOOK,
    ROOM,
    ROOT_PIECE,
    SIDE,
    TILES,
    WIDE,
    corner_of,
    on_bench,
    step_cost,
    tile_of,
    where_to,
)


@helper
def _load_own(t, grid, across, bench):
    """Put cell costs of a tile on the bench."""
    cell_cost, _, stride, _, _ = grid
    own = bench[2]
    origin, rows, cols = corner_of(grid, across, t)
    if rows < SIDE or cols < SIDE:
        for i in range(own.size):
            own[i] = np.inf
    for row in range(rows):
        g, at = np.uint64(origin + row * stride), np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(cols)):
            own[at + col] = cell_cost[g + col]


@helper
def _load_ways(t, grid, labels, across, bench):
    """Put the parents of a tile on the bench. What its cells cost inside it is less than 0 until known, and they
    have no name."""
    stride, parent = grid[2], labels[0]
    inner, code, name = bench[3], bench[7], bench[8]
    origin, rows, cols = corner_of(grid, across, t)
    if rows < SIDE or cols < SIDE:
        for i in range(inner.size):
            inner[i] = 0.0
            code[i] = NONE
            name[i] = NO_PIECE
    for row in range(rows):
        g, at = np.uint64(origin + row * stride), np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(cols)):
            code[at + col] = parent[g + col]
            name[at + col] = NO_PIECE
        for col in range(np.uint64(cols)):
            inner[at + col] = 0.0 if parent[g + col] == NONE else -1.0


@helper
def _follow(t, grid, across, bench):
    """Costs inside a tile, and names, of all cells on the bench by their parents, where those of its exits are
    known."""
    rule = grid[3]
    own, inner, queue, code, name, around = bench[2], bench[3], bench[5], bench[7], bench[8], bench[9]
    _, rows, cols = corner_of(grid, across, t)
    for row in range(rows):
        for col in range(cols):
            at = (row + 1) * WIDE + col + 1
            steps = 0
            while inner[at] < 0.0:
                queue[steps] = at
                steps += 1
                at += around[code[at]]
            for i in range(steps - 1, -1, -1):
                u = at
                at = np.int64(queue[i])
                inner[at] = inner[u] + step_cost(rule, own[u], np.int64(code[at]))
                name[at] = name[u]


@helper
def drive_tile(t, grid, labels, tiles, bench):
    """Put cell costs of a tile on the bench, and what each cell costs inside it."""
    exits, many, across = tiles[0], tiles[1], tiles[6]
    names, inner, kept, place = bench[0], bench[3], bench[10], bench[11]
    _load_own(t, grid, across, bench)
    if place[t] >= 0:
        for row in range(SIDE):
            i = np.uint64((np.int64(place[t]) << 2 * BITS) + (row << BITS))
            at = np.uint64((row + 1) * WIDE + 1)
            for col in range(np.uint64(SIDE)):
                inner[at + col] = kept[i + col]
        return
    _load_ways(t, grid, labels, across, bench)
    for j in range(many[t]):
        name = exits[t * ROOM + j]
        if name != ROOT_PIECE:  # which has no parent
            inner[on_bench(np.int64(names[name]))] = 0.0
    _follow(t, grid, across, bench)
    _keep(t, bench)


@helper
def _keep(t, bench):
    """Keep what the cells of a tile cost inside it, from the bench, in the place of another tile where all places
    are taken: of the one that has had its place for longest."""
    inner, kept, place, holder = bench[3], bench[10], bench[11], bench[12]
    if place[t] < 0:
        next = holder[holder.size - 1]
        if holder[next] >= 0:
            place[holder[next]] = -1
        holder[next] = t
        place[t] = next
        holder[holder.size - 1] = next + 1 if next + 2 < holder.size else 0
    for row in range(SIDE):
        i = np.uint64((np.int64(place[t]) << 2 * BITS) + (row << BITS))
        at = np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(SIDE)):
            kept[i + col] = inner[at + col]


@helper
def keep_tile(t, labels, bench):
    """Keep what the cells of a tile cost inside it, from the bench: those on its border for good."""
    rim = labels[2]
    names, inner = bench[0], bench[3]
    for each in range(4 * SIDE - 4):
        rim[t * ROOM + each] = inner[on_bench(np.int64(names[each]))]
    _keep(t, bench)


@helper
def relabel_tile(t, grid, labels, tiles, bench):
    """Write which piece each cell of a tile is of, and what it costs inside the tile, by the parents. Cells behind
    one that has no parent have no way."""
    _, piece, _, root = labels
    exits, many, span, _, _, _, across = tiles
    names, inner, code, name = bench[0], bench[3], bench[7], bench[8]
    _load_own(t, grid, across, bench)
    _load_ways(t, grid, labels, across, bench)
    count = 0
    home, cell = tile_of(root, grid[2], across)
    if home == t:
        at = on_bench(cell)
        name[at] = ROOT_PIECE
        inner[at] = 0.0
        exits[t * ROOM] = ROOT_PIECE
        count = 1
    for each in range(4 * SIDE - 4):
        cell = np.int64(names[each])
        at = on_bench(cell)
        way = code[at]
        if way == NONE:
            continue
        other, _ = where_to(across, t, cell, way)
        if other != t:
            name[at] = each
            inner[at] = 0.0
            exits[t * ROOM + count] = each
            count += 1
    many[t] = count
    _follow(t, grid, across, bench)
    longest = 0.0
    for row in range(SIDE):
        i, at = np.uint64(t * CELLS + (row << BITS)), np.uint64((row + 1) * WIDE + 1)
        for col in range(np.uint64(SIDE)):
            piece[i + col] = name[at + col]
            longest = max(longest, inner[at + col] if name[at + col] != NO_PIECE else 0.0)
    span[t] = longest
    keep_tile(t, labels, bench)


@helper
def want(tiles, t, what):
    """Ask something of a tile, and of those about it."""
    across = tiles[6]
    wanted = tiles[3]
    row, col = t // across, t % across
    down = wanted.size // across
    for i in range(max(row - 1, 0), min(row + 2, down)):
        for j in range(max(col - 1, 0), min(col + 2, across)):
            wanted[i * across + j] |= what


@kernel(f"({GRID}, {LABELLED}, {TILES}, {BENCH}, i8[::1], u1[::1])")
def relabel_tiles(grid, labels, tiles, bench, which, changed):
    """Label these tiles anew, whose parents or cell costs have changed, and have them looked at; and those about
    them, unless all that has changed is that cells got dearer (`changed` is `DEARER`, uint8 (n,)): that offers
    nobody less, and whoever leads there sees its totals rise."""
    wanted = tiles[3]
    for i in range(which.size):
        t = which[i]
        relabel_tile(t, grid, labels, tiles, bench)
        want(tiles, t, LED if changed[t] == DEARER else LOOK | LED)
        wanted[t] |= LOOK | REHOOK
