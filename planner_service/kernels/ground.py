"""The weights of a map: padded, changed, their range; a window cut out of them, and merged back.

Arrays are flat and padded as `rules` says.
"""

from __future__ import annotations

import numpy as np
from numba import njit

INF = np.float32(np.inf)


@njit(cache=True, nogil=True)
def pad_weights(pace, resolution, extra, stride, weight):
    """weight := pace * resolution + extra, everywhere. Returns cells whose pace is NaN, zero or negative."""
    bad = 0
    for row in range(pace.shape[0]):
        base = (row + 1) * stride + 1
        for col in range(pace.shape[1]):
            p = pace[row, col]
            w = p * resolution + extra
            bad += not (p > 0 and w > 0)
            weight[base + col] = w
    return bad


@njit(cache=True, nogil=True)
def changed_cells(pace, resolution, extra, box, stride, weight, cells, before):
    """The padded cells of a window whose weight differs from their pace, and their weight before; updates weight.

    box = (row0, col0, row1, col1); cells, before have room for the whole window. Returns (count, cells whose pace
    is NaN, zero or negative: these are not applied).
    """
    row0, col0, row1, col1 = box
    count = 0
    bad = 0
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
    return count, bad


@njit(cache=True, nogil=True)
def weight_range(weight):
    """(smallest, largest finite) weight; (inf, 0) if all cells are lethal."""
    low = INF
    high = np.float32(0.0)
    for i in range(weight.size):
        w = weight[i]
        low = min(low, w)
        high = max(high, w if w < INF else np.float32(0.0))
    return low, high


@njit(cache=True, nogil=True)
def cut_window(weight, stride, box, part):
    """The weights of a window as a padded grid of its own."""
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    for i in range(part.size):
        part[i] = INF
    for row in range(row0, row1):
        a = (row + 1) * stride + 1 + col0
        b = (row - row0 + 1) * width + 1
        for col in range(col1 - col0):
            part[b + col] = weight[a + col]


@njit(cache=True, nogil=True)
def merge_window(part, box, offset, old_root, cost, stride):
    """Costs of a window grown around a new root improve a tree whose costs are stored less `offset`.

    Only what gets cheaper is rewritten, and the old root, so that costs stay upper bounds of what is driven and
    grow strictly along every way. Returns cells rewritten.
    """
    row0, col0, row1, col1 = box
    width = col1 - col0 + 2
    rewritten = 0
    for row in range(row0, row1):
        a = (row + 1) * stride + 1 + col0
        b = (row - row0 + 1) * width + 1
        for col in range(col1 - col0):
            new = part[b + col] - offset
            if new < cost[a + col] or a + col == old_root:
                cost[a + col] = new
                rewritten += 1
    return rewritten
