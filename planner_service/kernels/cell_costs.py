"""Cell costs of a map: padded, changed, their range; a window cut out of them, and merged back.

Arrays, beside those of `layout`:
    pace    float32  (rows, cols)  s/m; inf is lethal; NaN, zero and negative ones are errors
    part    float32  ((row1 - row0 + 2) * width,)  cell costs or costs of a window as a padded grid of its own,
                     whose stride is width = col1 - col0 + 2
    *_bits  int32    the same array as without it, its numbers read as integers

Positive float32 numbers sort as their bits do, read as integers: the least of integers is found by vectors, the
least of floats one by one, in 4 times the time.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.decorators import kernel
from planner_service.kernels.layout import BOX, INF

CHEAPEST_S, DEAREST_S = np.float32(2.0**-40), np.float32(2.0**40)
"""Lowest and highest cost of a cell, s: a picosecond, 35,000 years. No path over the largest grid, and no quotient
of two costs, therefore leaves float32."""
_INF_BITS = np.int32(0x7F800000)
"""Bits of inf in float32: larger ones are NaN."""
_ONE = np.uint64(1)
BLOCK = 1 << 10
"""Cells of a block, whose range is kept."""


@kernel(f"(f4[:, ::1], f8, f8, {BOX}, i8, f4[::1], i8[::1], f4[::1])")
def changed_cells(pace, resolution, extra, box, stride, cell_cost, cells, before):
    """Updates the cell costs of a window, and lists what changed: pace * resolution + extra, between `CHEAPEST_S`
    and `DEAREST_S`, inf where a cell is lethal.

    pace           none of the window is NaN, zero or negative
    resolution     m; extra: s
    cells, before  int64 padded cells and float32 cost before, written; both have room for the whole window
    Returns how many cells have changed.
    """
    row0, col0, row1, col1 = box
    resolution, extra = np.float32(resolution), np.float32(extra)
    count = 0
    for row in range(row0, row1):
        base = (row + 1) * stride + 1
        for col in range(col0, col1):
            p = pace[row, col]
            new = min(max(p * resolution, CHEAPEST_S) + extra, DEAREST_S) if p < INF else INF
            old = cell_cost[base + col]
            if new != old:
                cells[count] = base + col
                before[count] = old
                count += 1
                cell_cost[base + col] = new
    return count


@kernel("(i4[::1], i8[::1], i4[:, ::1])")
def block_ranges(bits, which, ranges):
    """ranges := (lowest, highest finite, highest) cell cost of blocks, as bits; the first two those of (inf, 0)
    where all cells are lethal.

    which   int64, of the blocks of `BLOCK` cells those that are looked at
    ranges  int32 (3, n), of all blocks
    """
    for j in range(which.size):
        lowest = _INF_BITS
        highest = np.int32(0)
        last = np.int32(0)
        begin = np.uint64(which[j] * BLOCK)
        for i in range(begin, min(begin + np.uint64(BLOCK), np.uint64(bits.size))):
            c = bits[i]
            lowest = min(lowest, c)
            highest = max(highest, c if c < _INF_BITS else np.int32(0))
            last = max(last, c)
        ranges[0, which[j]], ranges[1, which[j]], ranges[2, which[j]] = lowest, highest, last


@kernel(f"(i4[::1], i8, {BOX}, i4[::1])")
def cut_window(cell_cost_bits, stride, box, part_bits):
    """part := the cell costs of a window, behind a lethal border. Returns the lowest and the highest finite one, as
    bits; those of (inf, 0) if all are lethal."""
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    lowest = _INF_BITS
    highest = np.int32(0)
    for i in range(np.uint64(width)):
        part_bits[i] = _INF_BITS
        part_bits[np.uint64(part_bits.size) - _ONE - i] = _INF_BITS
    for row in range(row0, row1):
        a = np.uint64((row + 1) * stride + 1 + col0)
        b = np.uint64((row - row0 + 1) * width + 1)
        part_bits[b - _ONE] = _INF_BITS
        for col in range(np.uint64(col1 - col0)):
            c = cell_cost_bits[a + col]
            part_bits[b + col] = c
            lowest = min(lowest, c)
            highest = max(highest, c if c < _INF_BITS else np.int32(0))
        part_bits[b + np.uint64(col1 - col0)] = _INF_BITS
    return lowest, highest


@kernel(f"(f4[::1], {BOX}, f8, i8, f4[::1], i8)")
def merge_window(part, box, offset, old_root, cost, stride):
    """Lowers a tree's costs, which are stored less `offset` (s), to those of a window grown around a new root
    (`part`).

    Only cells that get cheaper are rewritten, and the old root, so that costs stay upper bounds of the cost driven
    and grow strictly along every path.
    """
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    offset = np.float32(offset)
    for row in range(row0, row1):
        a = np.uint64((row + 1) * stride + 1 + col0)
        b = np.uint64((row - row0 + 1) * width + 1)
        for col in range(np.uint64(col1 - col0)):
            cost[a + col] = min(cost[a + col], part[b + col] - offset)
    row = old_root // stride - 1
    col = old_root % stride - 1
    cost[old_root] = part[(row - row0 + 1) * width + col - col0 + 1] - offset


@kernel(f"(f4[::1], {BOX}, i8, i8, i8[::1], f8[::1])")
def find_rim(part, box, rows, stride, rim, rim_cost):
    """The cells of a window that have a path, and from which a step leads out of it.

    rim, rim_cost  int64 cells, padded in the whole grid of `rows` rows, and float64 costs (s); written, both with
                   room for all of the window's border
    Returns how many there are.
    """
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    count = 0
    for row in range(row0, row1):
        across = (row == row0 and row0 > 0) or (row == row1 - 1 and row1 < rows)
        step = 1 if across or col1 - col0 == 1 else col1 - col0 - 1
        for col in range(col0, col1, step):
            if not across and not (col == col0 and col0 > 0) and not (col == col1 - 1 and col1 < stride - 2):
                continue
            c = part[(row - row0 + 1) * width + col - col0 + 1]
            if c < INF:
                rim[count] = (row + 1) * stride + col + 1
                rim_cost[count] = c
                count += 1
    return count
