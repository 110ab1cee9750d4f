"""The weights of a map: padded, changed, their range; a window cut out of them, and merged back.

Arrays are flat and padded as `rules` says. Positive float32 numbers sort as their bits do, read as integers: the
least of integers is found by vectors, the least of floats one by one, in 4 times the time.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit

INF = np.float32(np.inf)
_INF_BITS = np.int32(0x7F800000)
_ONE = np.uint64(1)


@njit
def pad_weights(pace, resolution, extra, stride, weight):
    """weight := pace * resolution + extra, everywhere. Returns cells whose pace is NaN, zero or negative."""
    bad = 0
    for row in range(pace.shape[0]):
        base = np.uint64((row + 1) * stride + 1)
        for col in range(np.uint64(pace.shape[1])):
            p = pace[row, col]
            w = p * resolution + extra
            bad += not (p > 0 and w > 0)
            weight[base + col] = w
    return bad


@njit
def changed_cells(pace, resolution, extra, box, stride, weight, cells, before):
    """The padded cells of a window whose weight differs from their pace, and their weight before; updates weight.

    box = (row0, col0, row1, col1); cells, before have room for the whole window. Returns (count, cells whose pace
    is NaN, zero or negative: these are not applied; smallest, largest finite new weight: inf, 0 if there is none).
    """
    row0, col0, row1, col1 = box
    count = 0
    bad = 0
    low = INF
    high = np.float32(0.0)
    for row in range(row0, row1):
        base = (row + 1) * stride + 1
        for col in range(col0, col1):
            p = pace[row, col]
            new = p * resolution + extra
            if not (p > 0 and new > 0):
                bad += 1
                continue
            old = weight[base + col]
            if new != old:
                cells[count] = base + col
                before[count] = old
                count += 1
                weight[base + col] = new
                low = min(low, new)
                high = max(high, new if new < INF else high)
    return count, bad, low, high


@njit
def weight_range(weight):
    """(smallest, largest finite) weight; (inf, 0) if all cells are lethal."""
    bits = weight.view(np.int32)
    low = _INF_BITS
    high = np.int32(0)
    for i in range(bits.size):
        w = bits[i]
        low = min(low, w)
        high = max(high, w if w < _INF_BITS else np.int32(0))
    found = np.array((low, high), np.int32).view(np.float32)
    return found[0], found[1]


@njit
def cut_window(weight, stride, box, part):
    """The weights of a window as a padded grid of its own. Returns their range, as `weight_range` does."""
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    low = _INF_BITS
    high = np.int32(0)
    bits = weight.view(np.int32)
    taken = part.view(np.int32)
    part[:width] = INF
    part[part.size - width :] = INF
    for row in range(row0, row1):
        a = np.uint64((row + 1) * stride + 1 + col0)
        b = np.uint64((row - row0 + 1) * width + 1)
        part[b - _ONE] = INF
        for col in range(np.uint64(col1 - col0)):
            w = bits[a + col]
            taken[b + col] = w
            low = min(low, w)
            high = max(high, w if w < _INF_BITS else np.int32(0))
        part[b + np.uint64(col1 - col0)] = INF
    found = np.array((low, high), np.int32).view(np.float32)
    return found[0], found[1]


@njit
def merge_window(part, box, offset, old_root, cost, stride):
    """Costs of a window grown around a new root improve a tree whose costs are stored less `offset`.

    Only what gets cheaper is rewritten, and the old root, so that costs stay upper bounds of what is driven and
    grow strictly along every way.
    """
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    for row in range(row0, row1):
        a = np.uint64((row + 1) * stride + 1 + col0)
        b = np.uint64((row - row0 + 1) * width + 1)
        for col in range(np.uint64(col1 - col0)):
            cost[a + col] = min(cost[a + col], part[b + col] - offset)
    row = old_root // stride - 1
    col = old_root % stride - 1
    cost[old_root] = part[(row - row0 + 1) * width + col - col0 + 1] - offset


@njit
def find_rim(part, box, rows, stride, rim, rim_cost):
    """The cells with a cost from which a step leads out of a window, padded in the whole grid of `rows` rows, and
    their costs. rim, rim_cost have room for all of the window's border. Returns how many there are."""
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
