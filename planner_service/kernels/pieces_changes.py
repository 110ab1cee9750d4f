"""What a moved root and a changed map do to a tree of `pieces`, before it is mended: parents of a window are taken
over, cells lose their way."""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import helper, kernel
from planner_service.kernels.layout import (
    BOX,
    GRID,
    INF,
    NONE,
    cuts_corner,
)
from planner_service.kernels.pieces import (
    ALTERED,
    BENCH,
    BITS,
    CELLS,
    DEARER,
    LABELLED,
    LOST,
    NO_PIECE,
    PIECES,
    ROOM,
    SIDE,
    TILES,
    TOTAL,
    corner_of,
    on_bench,
    tile_of,
)
from planner_service.kernels.pieces_labels import drive_tile
from planner_service.kernels.pieces_risen import settle

_WINDOW = f"Tuple((f4[::1], u1[::1], {BOX}, f8))"


@helper
def _merge_tile(t, grid, labels, total, across, window, inner, old_root, changed):
    """`merge_parents` in one tile, which is on the bench."""
    stride = grid[2]
    parent, piece, _, root = labels
    part, part_parent, box, way = window
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    top, left = t // across * SIDE, t % across * SIDE
    for row in range(max(row0, top), min(row1, top + SIDE)):
        for col in range(max(col0, left), min(col1, left + SIDE)):
            i = (row - row0 + 1) * width + col - col0 + 1
            if not part[i] < INF:
                continue
            v = (row + 1) * stride + col + 1
            cell = ((row - top) << BITS) + col - left
            cost = total[t * ROOM + np.int64(piece[t * CELLS + cell]), TOTAL] + inner[on_bench(cell)]
            code = NONE if v == root else part_parent[i]
            if (part[i] < cost + way or v == old_root) and parent[v] != code:
                parent[v] = code
                changed[t] = ALTERED


@kernel(f"({GRID}, {LABELLED}, {PIECES}, {TILES}, {BENCH}, {_WINDOW}, i8, u1[::1])")
def merge_parents(grid, labels, pieces, tiles, bench, window, old_root, changed):
    """Take the parents of a window that was grown around a new root (`labels`), where its costs are less than the
    tree's and the way from the old root to the new one.

    window   (part, part_parent, box, way): its costs and parents, and the way between the roots, s
    changed  uint8 (n,), set to ALTERED for tiles in which a parent has changed
    Costs stay what they are until totals are evaluated. There is no cycle: with the lesser of the two costs, every
    cell's parent has a lower one.
    """
    across = tiles[6]
    row0, col0, row1, col1 = window[2]
    for row in range(row0 >> BITS, ((row1 - 1) >> BITS) + 1):
        for col in range(col0 >> BITS, ((col1 - 1) >> BITS) + 1):
            t = row * across + col
            drive_tile(t, grid, labels, tiles, bench)
            _merge_tile(t, grid, labels, pieces[0], across, window, bench[3], old_root, changed)
    for v in (labels[3], old_root):
        t, _ = tile_of(v, grid[2], across)
        changed[t] = ALTERED


@kernel(f"({GRID}, {LABELLED}, i8, i8[::1], f4[::1], u1[::1])")
def cut_ways(grid, labels, across, cells, before, changed):
    """Cells that became lethal, and those whose step they forbid, lose their parent.

    cells, before  padded cells whose cost changed, and their cell cost before, s
    changed        uint8 (n,), DEARER or ALTERED for tiles of cells that step into one of these, or are one
    """
    cell_cost, offsets, stride, _, corners = grid
    parent = labels[0]
    for j in range(cells.size):
        x = cells[j]
        t, _ = tile_of(x, stride, across)
        what = DEARER if cell_cost[x] > before[j] else ALTERED
        changed[t] |= what
        lethal = not cell_cost[x] < INF and before[j] < INF
        if lethal:
            parent[x] = NONE
        for code in range(8):
            v = x + offsets[code]
            way = parent[v]
            if way == NONE:
                continue
            into = way == (code + 4) & 7
            if into or (lethal and not corners and cuts_corner(v, way, x, offsets)):
                t, _ = tile_of(v, stride, across)
                changed[t] |= what
                if lethal:
                    parent[v] = NONE


@kernel(f"({GRID}, {LABELLED}, {PIECES}, {TILES}, i8[::1])")
def drop_lost(grid, labels, pieces, tiles, which):
    """Cells of these tiles that have no way lose their parent, and pieces that lead nowhere go."""
    _, _, stride, _, _ = grid
    parent, piece, _, root = labels
    total = pieces[0]
    exits, many, _, wanted, _, _, across = tiles
    for n in range(which.size):
        t = which[n]
        wanted[t] &= ~LOST
        origin, rows, cols = corner_of(grid, across, t)
        for row in range(rows):
            for col in range(cols):
                i = t * CELLS + (row << BITS) + col
                v = origin + row * stride + col
                if not total[t * ROOM + np.int64(piece[i]), TOTAL] < np.inf and v != root:
                    parent[v] = NONE
                    piece[i] = NO_PIECE
        count = 0
        for j in range(many[t]):
            name = np.int64(exits[t * ROOM + j])
            if total[t * ROOM + name, TOTAL] < np.inf:
                exits[t * ROOM + count] = name
                count += 1
        many[t] = count
        settle(t, tiles)
