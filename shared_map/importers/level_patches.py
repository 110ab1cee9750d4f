"""Patches of equal height in a height model: connected cells, each as high as the next.

Rows are cut into runs of equal cells, and runs that touch are one patch: a sea is some thousand runs, and a steep
slope has none. Models are looked at in a sample of at most `water_and_voids.MOST_SAMPLED` cells, so all are at
hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats

_LEAST_ALIKE, _LEAST_ALIKE_MEANS = 2, 3
"""Number of the eight neighbours that are as high as a cell of a patch: those of a creek one cell wide are two.
Among means of blocks a chain of equal ones is a contour line."""
_STEPS = ((0, 1), (1, -1), (1, 0), (1, 1))
_COUNTS = ("edge", "differ", "beside", "below", "lower", "terrace", "steep")
_SHORE_CELLS, _UNDER, _OVER, _RIPPLED = 3, 0.25, 0.015, 0.1
"""Foot of a shore that a filter leaves on its water: cells within this distance, higher than it by less than this
share of the rise there, or lower by less than a quarter, if a tenth of the cells beside a patch is so. Unfiltered
cells next to water rise by up to a third of what they do within three: one in twenty is so low."""
_MIXED, _HALF = 0.2, 0.045
"""If a fifth of the cells beside a patch is so low, a filter has mixed water and shore in them. Where half
of a cell is water, it then rises by this share of the rise within three cells: on an even slope by 0.056 of it with
a linear filter, 0.042 in means, 0.033 with a cubic filter."""

Labels = NDArray[np.int32]
Counts = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of equal height, and what lies beside them.

    labels    int32 (rows, cols), 1 .. count; 0 is no patch
    height_m  float32 (count + 1,), of the first cell of each; NaN of number 0
    spread_m  float32 (count + 1,), of an even slope whose heights vary as much: the lowest and the highest
              of many cells tell of their number
    cells     int64 (count + 1,)
    edge      int64 (count + 1,): sides of its cells beyond which another cell lies
    differ    of these, those with another height beyond: the visible part of its shore
    beside    of these, those with another patch beyond that is at least a quarter as large
    below     of these, those with such a patch beyond that is lower
    lower     of `differ`, those with a lower height beyond that is no such patch
    terrace   of `beside`, those with a patch beyond that is one rounding away
    steep     of `differ`, those with a height beyond that is more than one rounding away
    border    bool (count + 1,): whether it reaches the border of the model
    """

    labels: Labels
    height_m: Floats
    spread_m: Floats
    cells: Counts
    edge: Counts
    differ: Counts
    beside: Counts
    below: Counts
    lower: Counts
    terrace: Counts
    steep: Counts
    border: NDArray[np.bool_]


def level_patches(
    elevation_m: Floats,
    same_m: float,
    least_cells: int,
    step_m: float,
    shore_m: Floats | None = None,
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
    means = shore_m is not None
    labels, cells = labelled(
        elevation_m, np.float32(same_m), least_cells, _LEAST_ALIKE_MEANS if means else _LEAST_ALIKE
    )
    many = len(cells)

    first = np.full(many, np.nan, np.float32)
    at = np.flatnonzero(labels)[::-1]  # backwards: the value of a patch's first cell is written last
    first[labels.reshape(-1)[at]] = elevation_m.reshape(-1)[at]
    of_cell = labels[labels > 0]
    above_m = elevation_m[labels > 0] - first[of_cell]
    total_m, total_m2 = np.bincount(of_cell, above_m, many), np.bincount(of_cell, above_m**2, many)
    variance = total_m2 / np.maximum(cells, 1) - (total_m / np.maximum(cells, 1)) ** 2
    spread_m = np.sqrt(12 * np.maximum(variance, 0)).astype(np.float32)
    if shore_m is None:
        shore_m = elevation_m
        _grow(elevation_m, labels, first)
        cells = np.bincount(labels.reshape(-1), minlength=many)
        cells[0] = 0
    border = np.zeros(many, np.bool_)
    for line in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        border[line] = True
    border[0] = False
    sides = _sides(shore_m, labels, cells, same_m, step_m)
    return Patches(labels, first, spread_m, cells, border=border, **sides)


def _sides(
    elevation_m: Floats,
    labels: Labels,
    cells: Counts,
    same_m: float,
    step_m: float,
) -> dict[str, Counts]:
    """The counts of `Patches`, `edge` and what follows it: what lies beyond the sides of each patch's cells."""
    height, width = elevation_m.shape
    total = {name: np.zeros(len(cells), np.int64) for name in _COUNTS}
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        here = np.s_[max(-down, 0) : height - max(down, 0), max(-right, 0) : width - max(right, 0)]
        there = np.s_[max(down, 0) : height + min(down, 0), max(right, 0) : width + min(right, 0)]
        at = (labels[here] > 0) & (labels[there] != labels[here])
        patch, beyond = labels[here][at], labels[there][at]
        height_m = elevation_m[here][at]
        above_m = elevation_m[there][at] - height_m
        with np.errstate(invalid="ignore"):
            differs = np.abs(above_m) > 2 * same_m
            near = np.abs(above_m) <= 1.5 * step_m
            low = differs & (above_m < 0)
        beside = differs & (beyond > 0) & (4 * cells[beyond] >= cells[patch])
        kinds = {
            "edge": np.ones_like(low),
            "differ": differs,
            "beside": beside,
            "below": beside & low,
            "lower": low & ~beside,
            "terrace": beside & near,
            "steep": differs & ~near,
        }
        for name, there in kinds.items():
            total[name] += np.bincount(patch[there], minlength=len(cells))
    return total


def _grow(elevation_m: Floats, labels: Labels, height_m: Floats) -> None:
    """Adds to each patch the cells beside it that a filter has put there, at the foot of a shore."""
    from scipy import ndimage

    side = 2 * _SHORE_CELLS + 1
    near = ndimage.maximum_filter(labels, side)
    row, col = np.nonzero((near > 0) & (labels == 0))
    beside = ndimage.maximum_filter(labels, 3)[row, col] > 0
    near = near[row, col]
    rise_m = ndimage.maximum_filter(np.nan_to_num(elevation_m, nan=-np.inf), side)[row, col] - height_m[near]
    above_m = elevation_m[row, col] - height_m[near]

    def count(cells: NDArray[np.bool_]) -> Counts:
        return np.bincount(near[cells], minlength=len(height_m))

    low = (above_m < 0) & (above_m >= -_UNDER * rise_m)
    rippled = count(low) > _RIPPLED * count(np.ones_like(low))
    mixed = count(beside & (np.abs(above_m) <= _OVER * rise_m)) > _MIXED * count(beside)
    taken = (low & rippled[near]) | ((above_m >= 0) & (above_m <= np.where(mixed, _HALF, _OVER)[near] * rise_m))
    labels[row[taken], col[taken]] = near[taken]


def labelled(elevation_m: Floats, same_m: np.float32, least_cells: int, least_alike: int) -> tuple[Labels, Counts]:
    """(labels, cells of each patch), numbered as they come from the north-west."""
    cols = elevation_m.shape[1]
    first = [np.s_[: len(elevation_m) - down, max(-right, 0) : cols - max(right, 0)] for down, right in _STEPS]
    second = [np.s_[down:, max(right, 0) : cols - max(-right, 0)] for down, right in _STEPS]
    sides = list(zip(first, second, strict=True))
    same = [np.abs(elevation_m[other] - elevation_m[one]) <= same_m for one, other in sides]
    alike = np.zeros(elevation_m.shape, np.uint8)
    for (one, other), joined in zip(sides, same, strict=True):
        alike[one] += joined
        alike[other] += joined
    level = alike >= least_alike
    for (one, other), joined in zip(sides, same, strict=True):
        joined &= level[one] & level[other]
    begins = level.copy()
    begins[:, 1:] &= ~same[0]
    run = np.cumsum(begins, dtype=np.int32).reshape(elevation_m.shape) - 1
    pairs = []
    # A patch may change its height along two runs: they are joined wherever they are as high as each other.
    for (one, other), joined in zip(sides[1:], same[1:], strict=True):
        pair = np.stack((run[one][joined], run[other][joined]))
        pairs.append(pair[:, np.diff(pair, prepend=-1).any(axis=0)])
    of_run = _connected(int(run[-1, -1]) + 1, *np.hstack(pairs))
    cells = np.bincount(of_run[run[level]], minlength=1).astype(np.int64)
    kept = np.flatnonzero(cells >= least_cells)
    number = np.zeros(cells.size, np.int32)
    number[kept] = np.arange(1, kept.size + 1)
    labels = np.zeros(elevation_m.shape, np.int32)
    labels[level] = number[of_run[run[level]]]
    return labels, np.concatenate((np.zeros(1, np.int64), cells[kept]))


def _connected(count: int, one: Labels, other: Labels) -> Labels:
    """Returns for each of `count` runs the number of its patch, by pairs of runs that touch; patches are in the
    order of their first runs."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = coo_array((np.ones(one.size, np.uint8), (one, other)), shape=(count, count))
    return np.asarray(connected_components(pairs.tocsr(), directed=False)[1], np.int32)
