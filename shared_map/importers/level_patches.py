"""Patches of equal height in a height model: connected cells, each as high as the next.

Rows are cut into runs of equal cells, and runs that touch are one patch: a sea is some thousand runs, and a steep
slope has none, so that no array but the labels is as large as the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.terrain.row_bands import bands

_LEAST_ALIKE, _LEAST_ALIKE_MEANS = 2, 3
"""So many of its eight neighbours are as high as a cell of a patch: those of a creek one cell wide are two. Among
means of blocks a chain of equal ones is a contour line."""
_STEPS = ((0, 1), (1, -1), (1, 0), (1, 1))
_RUNS_AT_ONCE = 1 << 18
_COUNTS = ("edge", "differ", "beside", "below", "lower", "ripple", "terrace", "steep")
_RIPPLE_CELLS, _RIPPLE = 3, 4.0
"""A cubic filter undershoots beside a rise by less than a quarter of it, and leaves no more than these cells."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of equal height, and what lies beside them.

    labels    int32 (rows, cols), 1 .. count; 0 is no patch
    height_m  float32 (count + 1,), of the first cell of each; NaN of number 0
    spread_m  float32 (count + 1,), from the lowest to the highest cell
    cells     int64 (count + 1,)
    edge      int64 (count + 1,): sides of its cells beyond which another cell lies
    differ    of these, those with another height beyond: what can be seen of its shore
    beside    of these, those with another patch beyond that is at least a quarter as large
    below     of these, those with such a patch beyond that is lower
    lower     of `differ`, those with a lower height beyond that is no such patch, and no ripple
    ripple    of `differ`, those with a lower height beyond that a filter left at a shore
    terrace   of `beside`, those with a patch beyond that is one rounding away
    steep     of `differ`, those with a height beyond that is more than one rounding away
    border    bool (count + 1,): whether it reaches the border of the model
    """

    labels: NDArray[np.int32]
    height_m: Floats
    spread_m: Floats
    cells: NDArray[np.int64]
    edge: NDArray[np.int64]
    differ: NDArray[np.int64]
    beside: NDArray[np.int64]
    below: NDArray[np.int64]
    lower: NDArray[np.int64]
    ripple: NDArray[np.int64]
    terrace: NDArray[np.int64]
    steep: NDArray[np.int64]
    border: NDArray[np.bool_]


def level_patches(
    elevation_m: Floats, same_m: float, least_cells: int, step_m: float, shore_m: Floats | None = None
) -> Patches:
    """The patches of a height model.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        NaN is a void.
    same_m : float
        Neighbours that differ by no more are equally high.
    least_cells : int
        Smaller patches are none.
    step_m : float
        What heights are rounded to; 0 if they are not.
    shore_m : float32 (rows, cols), m, optional
        Heights also of cells that can be no part of a patch and are NaN in `elevation_m`. They are means, so that
        no filter has left ripples at shores.
    """
    ripples = shore_m is None
    shore_m = elevation_m if shore_m is None else shore_m
    labels, cells = _labelled(
        elevation_m, np.float32(same_m), least_cells, _LEAST_ALIKE if ripples else _LEAST_ALIKE_MEANS
    )
    count = len(cells) - 1
    lowest, highest = np.full(count + 1, np.inf, np.float32), np.full(count + 1, -np.inf, np.float32)
    sides = np.zeros((len(_COUNTS), count + 1), np.int64)
    first = np.full(count + 1, np.nan, np.float32)
    if count:
        for row0, row1 in bands(elevation_m.shape[0]):
            at = np.flatnonzero(labels[row0:row1])
            of_cell, height_m = labels[row0:row1].reshape(-1)[at], elevation_m[row0:row1].reshape(-1)[at]
            np.minimum.at(lowest, of_cell, height_m)
            np.maximum.at(highest, of_cell, height_m)
            numbers, begins = np.unique(of_cell, return_index=True)
            new = np.isnan(first[numbers])
            first[numbers[new]] = height_m[begins[new]]
            _count_sides(shore_m, labels, (row0, row1), (cells, same_m, step_m, ripples), sides)
    border = np.zeros(count + 1, np.bool_)
    for line in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        border[line] = True
    border[0] = False
    with np.errstate(invalid="ignore"):
        spread_m = highest - lowest
    counts: dict[str, NDArray[np.int64]] = dict(zip(_COUNTS, sides, strict=True))
    return Patches(labels, first, spread_m, cells, border=border, **counts)


def _count_sides(
    elevation_m: Floats,
    labels: NDArray[np.int32],
    rows: tuple[int, int],
    known: tuple[NDArray[np.int64], float, float, bool],
    sides: NDArray[np.int64],
) -> None:
    """Add to the counts of `Patches`, `edge` and what follows it, what lies beyond the sides of a band's cells."""
    cells, same_m, step_m, ripples = known
    row0, row1 = rows
    height, width = elevation_m.shape
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        first, end = max(row0, -down), min(row1, height - down)
        left, stop = max(-right, 0), width - max(right, 0)
        if first >= end:
            continue
        of_cell = labels[first:end, left:stop]
        of_next = labels[first + down : end + down, left + right : stop + right]
        row, col = np.nonzero((of_cell > 0) & (of_next != of_cell))
        patch, beyond = of_cell[row, col], of_next[row, col]
        row, col = row + first, col + left
        height_m = elevation_m[row, col]
        above_m = elevation_m[row + down, col + right] - height_m
        far_row = np.clip(row + _RIPPLE_CELLS * down, 0, height - 1)
        far_col = np.clip(col + _RIPPLE_CELLS * right, 0, width - 1)
        far_m = elevation_m[far_row, far_col] - height_m
        with np.errstate(invalid="ignore"):
            differs = np.abs(above_m) > 2 * same_m
            near = np.abs(above_m) <= 1.5 * step_m
            low = differs & (above_m < 0)
            ripple = (far_m > -_RIPPLE * above_m) & ripples
        beside = differs & (beyond > 0) & (4 * cells[beyond] >= cells[patch])
        low_land = low & ~beside
        land = (low_land & ~ripple, low_land & ripple)
        of_kind = (None, differs, beside, beside & low, *land, beside & near, differs & ~near)
        for n, counted in enumerate(of_kind):
            of_side = patch if counted is None else patch[counted]
            sides[n] += np.bincount(of_side, minlength=len(cells))


def _labelled(
    elevation_m: Floats, same_m: np.float32, least_cells: int, least_alike: int
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """(labels, cells of each patch), numbered as they come from the north-west."""
    rows, cols = elevation_m.shape
    labels = np.zeros((rows, cols), np.int32)
    starts, ends = _runs(elevation_m, same_m, least_alike)
    if starts.size == 0:
        return labels, np.zeros(1, np.int64)
    of_run = _connected(starts.size, *_touching(elevation_m.reshape(-1), starts, ends, cols, same_m))
    lengths = ends - starts + 1
    cells = np.bincount(of_run, lengths).astype(np.int64)
    number = np.zeros(cells.size, np.int32)
    kept = np.flatnonzero(cells >= least_cells)
    number[kept] = np.arange(1, kept.size + 1)
    of_run = number[of_run]
    large = np.flatnonzero(of_run)
    flat = labels.reshape(-1)
    for n in range(0, large.size, _RUNS_AT_ONCE):
        some = large[n : n + _RUNS_AT_ONCE]
        long = lengths[some].astype(np.int64)
        before = np.cumsum(long) - long
        at = np.arange(long.sum()) + np.repeat(starts[some] - before, long)
        flat[at] = np.repeat(of_run[some], long)
    return labels, np.concatenate((np.zeros(1, np.int64), cells[kept]))


def _connected(count: int, one: NDArray[np.int32], other: NDArray[np.int32]) -> NDArray[np.int32]:
    """Of each of `count` runs the number of its patch, by pairs of runs that touch; patches come as their first
    runs do."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = coo_array((np.ones(one.size, np.uint8), (one, other)), shape=(count, count))
    return np.asarray(connected_components(pairs.tocsr(), directed=False)[1], np.int32)


def _runs(elevation_m: Floats, same_m: np.float32, least_alike: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """First and last cell of each run of cells that are as high as their neighbours, as flat numbers."""
    rows, cols = elevation_m.shape
    starts, ends = [], []
    for row0, row1 in bands(rows):
        above, below = max(row0 - 1, 0), min(row1 + 1, rows)
        part = elevation_m[above:below]
        alike = np.zeros(part.shape, np.uint8)
        beside = np.zeros(part.shape, np.bool_)
        for down, right in _STEPS:
            first = (slice(None, part.shape[0] - down), slice(max(-right, 0), cols - max(right, 0)))
            second = (slice(down, None), slice(max(right, 0), cols - max(-right, 0)))
            same = np.abs(part[second] - part[first]) <= same_m
            alike[first] += same
            alike[second] += same
            if (down, right) == (0, 1):
                beside[first] = same
        inner = slice(row0 - above, row1 - above)
        level = alike[inner] >= least_alike
        joined = beside[inner, :-1] & level[:, :-1] & level[:, 1:]
        begins, finishes = level.copy(), level.copy()
        begins[:, 1:] &= ~joined
        finishes[:, :-1] &= ~joined
        starts.append((np.flatnonzero(begins) + row0 * cols).astype(np.int32))
        ends.append((np.flatnonzero(finishes) + row0 * cols).astype(np.int32))
    return np.concatenate(starts), np.concatenate(ends)


def _touching(
    flat_m: Floats, starts: NDArray[np.int32], ends: NDArray[np.int32], cols: int, same_m: np.float32
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Numbers of runs, and of runs in the row below that touch them, be it at a corner, and are as high."""
    ones, others = [], []
    for n in range(0, starts.size, _RUNS_AT_ONCE):
        begin, end = starts[n : n + _RUNS_AT_ONCE], ends[n : n + _RUNS_AT_ONCE]
        row = begin // cols
        first = np.searchsorted(ends, np.maximum(begin + (cols - 1), (row + 1) * cols))
        last = np.searchsorted(starts, np.minimum(end + (cols + 1), (row + 2) * cols - 1), "right")
        many = np.maximum(last - first, 0)
        above = np.repeat(np.arange(begin.size), many)
        below = np.arange(above.size) + np.repeat(first - (np.cumsum(many) - many), many)
        at = np.clip(starts[below] - cols, begin[above], end[above])
        under = np.clip(at + cols, starts[below], ends[below])
        same = np.abs(flat_m[at] - flat_m[under]) <= same_m
        ones.append((above[same] + n).astype(np.int32))
        others.append(below[same].astype(np.int32))
    return np.concatenate(ones), np.concatenate(others)
