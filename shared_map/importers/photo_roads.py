"""Roads on a photo: thin, long, bright lines with darker ground on both of their sides.

Eight directions are tried: how much brighter is a cell than the brighter of its two sides, less how much it differs
from what is before and behind it, averaged along the line, so that a tree over the road does not cut it. The edge
of a shadow or of a meadow is bright on one side only. What is strong is kept where all that hangs together is long.

Measured on the one photo that it was tuned on: docs/terrain-figures.md.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Bytes
from shared_map.terrain.layers import spread
from shared_map.terrain.row_bands import counted, looked_up

COARSEST_M = 30.0
"""On coarser cells a thin line is a ridge, a river or a seam of the photo."""
REACH = 8
"""Rows and columns around a cell that its strength looks at."""
_DIRECTIONS = 8
_SIDE = 2.0
_TAPS = (-4, -2, 0, 2, 4)
_MARGIN = 6
"""Of side and tap together."""
_BRIGHTEST = 40
"""Grey levels over its sides that count at most: one bright roof is no road."""
_FIXED = 8
"""Parts of a grey level while strengths are summed in 16 bits, which is twice as fast as in floats."""
_STRONG = 60
_SHORTEST = 25
"""Cells; specks, roofs and field boundaries are shorter."""

Shorts = NDArray[np.int16]


def line_strength(rgb: Bytes) -> Bytes:
    """How much each cell looks like the crest of a line.

    Parameters
    ----------
    rgb : uint8 (rows, cols, 3), red, green, blue

    Returns
    -------
    uint8 (rows, cols), tenths of a grey level
        0 where there is no crest. The outer `REACH` rows and columns are found from less of the photo.
    """
    from scipy import ndimage

    # A road is bright in red, unlike forest and meadow, and in blue, unlike bare soil.
    grey = np.minimum(rgb[..., 0], rgb[..., 2]).astype(np.float32)
    smooth = (ndimage.gaussian_filter(grey, 0.7, truncate=3) * _FIXED).astype(np.int16)
    padded = np.pad(smooth, _MARGIN, mode="edge")
    here = np.ascontiguousarray(_moved(padded, 2, 0, 0))
    crests = {}
    best = np.zeros(smooth.shape, np.int16)
    crest = np.zeros(smooth.shape, np.bool_)
    for number in range(_DIRECTIONS):
        angle = math.pi * number / _DIRECTIONS
        down, right = math.sin(angle), math.cos(angle)
        contrast = _contrast(padded, here, down, right)
        first, second, *others = (_moved(contrast, 4, tap * down, tap * right) for tap in _TAPS)
        total = first + second
        for other in others:
            total += other
        # Masks and maxima: NumPy's copy "where" costs as much as thirty of them.
        better = total > best
        np.maximum(best, total, out=best)
        beside = round(right), round(-down)
        if beside not in crests:
            sides = np.maximum(*(_moved(padded, _MARGIN, sign * right, -sign * down) for sign in (1, -1)))
            crests[beside] = smooth >= sides
        crest |= better
        crest &= np.logical_not(better) | crests[beside]
    best *= crest
    best //= _FIXED * len(_TAPS) // 10
    return np.minimum(best, 255).astype(np.uint8)


def _contrast(padded: Shorts, here: Shorts, down: float, right: float) -> Shorts:
    """Brighter than both sides, less a quarter of the bend along the line; `_MARGIN` - 4 narrower on each side."""
    ahead, behind, one, other = (
        _moved(padded, 2, _SIDE * by_row, _SIDE * by_col)
        for by_row, by_col in ((down, right), (-down, -right), (right, -down), (-right, down))
    )
    bend = ahead + behind
    bend -= here
    bend -= here
    np.abs(bend, out=bend)
    bend >>= 2
    contrast = np.maximum(one, other)
    np.subtract(here, contrast, out=contrast)
    contrast -= bend
    most = _BRIGHTEST * _FIXED
    return np.clip(contrast, -most, most, out=contrast)


def _moved(array: Shorts, trim: int, down: float, right: float) -> Shorts:
    """The array without `trim` rows and columns on each side, of cells so far away."""
    rows, cols = array.shape
    dr, dc = round(down), round(right)
    return array[trim + dr : rows - trim + dr, trim + dc : cols - trim + dc]


def long_lines(strength: Bytes) -> Bools:
    """The cells of strong lines that are long, over gaps of a cell or two.

    Parameters
    ----------
    strength : uint8 (rows, cols), tenths of a grey level
        From `line_strength`.

    Returns
    -------
    bool (rows, cols)
    """
    from scipy import ndimage

    strong = strength >= _STRONG
    labels, count = ndimage.label(spread(strong, (1, 1)), np.ones((3, 3), np.int8))
    sizes = counted(labels, count + 1, strong)
    line = strong & looked_up(sizes >= _SHORTEST, labels)
    del labels
    padded = np.pad(line, 1)
    rows, cols = line.shape
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        before = padded[1 - down : 1 - down + rows, 1 - right : 1 - right + cols]
        behind = padded[1 + down : 1 + down + rows, 1 + right : 1 + right + cols]
        line |= before & behind
    return np.asarray(line, np.bool_)
