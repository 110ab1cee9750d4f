"""Cells without a height: found, be they declared or not, and filled on request."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.terrain.row_bands import bands

HIGHEST_M = 20_000.0
"""Heights beyond this, up or down, are undeclared voids."""
_SEARCH_CELLS = 64
_CODES = (-32768.0, -32767.0, -99999.0, -9999.0, -9998.0, -999.0, -500.0, 9999.0, 32767.0, 65535.0)
"""What programs write where they know no height."""
_GAPS_M = {**dict.fromkeys(_CODES, 100.0), 0.0: 30.0}
_ALONE = 3.0
"""A code is a void if no other height is nearer to it than its gap, and than so many times the widest gap between
other heights: real ground is never alone in its height."""
_BIN_M = 0.25
"""Gaps between heights are measured in steps of this."""


def undeclared_voids(
    heights: NDArray[np.floating] | NDArray[np.integer], scale: float = 1.0, offset: float = 0.0
) -> tuple[float, ...]:
    """The values of a height model that stand for no height, though the file does not say so.

    Parameters
    ----------
    heights : (rows, cols), as stored
        NaN is a declared void.
    scale, offset : float
        They make metres of what is stored. Codes are looked for as they are stored, gaps are measured in metres.

    Returns
    -------
    tuple of float
        Usual codes for "no height", and 0, where no other height is near them.
    """
    codes = _codes_in(heights)
    if not codes:
        return ()
    nearest = dict.fromkeys(codes, np.inf)
    occupied = np.zeros(int(2 * HIGHEST_M / _BIN_M) + 1, np.bool_)
    for row0, row1 in bands(heights.shape[0]):
        band = heights[row0:row1]
        rest = band[np.isfinite(band) & ~np.isin(band, np.array(codes, band.dtype))].astype(np.float64)
        rest_m = rest * scale + offset
        there = np.abs(rest_m) <= HIGHEST_M  # what lies beyond is a void anyway
        if not there.any():
            continue
        occupied[((rest_m[there] + HIGHEST_M) / _BIN_M).astype(np.intp)] = True
        for code in codes:
            nearest[code] = min(nearest[code], float(np.abs(rest[there] - code).min()) * abs(scale))
    at = np.flatnonzero(occupied)
    if at.size == 0:
        # Nothing but the sea is a map; nothing but -9999 is none.
        return tuple(code for code in codes if code != 0)
    widest = float(np.diff(at).max(initial=0)) * _BIN_M
    return tuple(code for code in codes if nearest[code] >= _GAPS_M[code] and nearest[code] > _ALONE * widest)


def _codes_in(heights: NDArray[np.floating] | NDArray[np.integer]) -> list[float]:
    """Which of the usual codes are among heights, the lowest first."""
    found: set[float] = set()
    fit = [code for code in _GAPS_M if np.array(code).astype(heights.dtype) == code]
    for row0, row1 in bands(heights.shape[0]):
        band = heights[row0:row1]
        if band.size:
            lowest, highest = np.fmin.reduce(band, axis=None), np.fmax.reduce(band, axis=None)
            near = [code for code in fit if code not in found and lowest <= code <= highest]
            found.update(code for code in near if (band == code).any())
    return sorted(found)


def without(heights: Floats, voids: Sequence[float]) -> Floats:
    """Heights as stored, with NaN for each value that stands for no height."""
    if not voids:
        return heights
    return np.where(np.isin(heights, np.array(voids, np.float32)), np.float32(np.nan), heights)


def voids_of(elevation_m: Floats) -> int:
    """Make NaN of whatever is no height, and count it.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        Changed in place: infinities, and what lies beyond `HIGHEST_M` up or down, become NaN.

    Returns
    -------
    int
        Cells that are NaN now.
    """
    count = 0
    for row0, row1 in bands(elevation_m.shape[0]):
        band = elevation_m[row0:row1]
        with np.errstate(invalid="ignore"):
            good = np.abs(band) <= np.float32(HIGHEST_M)
        if not good.all():
            band[~good] = np.nan
            count += int(good.size - np.count_nonzero(good))
    return count


def fill_voids(elevation_m: Floats) -> Floats:
    """Voids filled from their surroundings (GDAL's inverse distance), far from any height by the nearest one.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        NaN is a void; at least one cell has a height. It is not changed.

    Returns
    -------
    float32 (rows, cols), m
        A copy without NaN.
    """
    from rasterio.fill import fillnodata
    from scipy import ndimage

    known = ~np.isnan(elevation_m)
    filled: Floats = fillnodata(
        np.where(known, elevation_m, np.float32(0)), known.astype(np.uint8), max_search_distance=_SEARCH_CELLS
    )
    # Where GDAL finds nothing near enough, it leaves what it was given.
    distance, nearest = ndimage.distance_transform_edt(~known, return_indices=True)
    far = distance >= _SEARCH_CELLS
    filled[far] = elevation_m[tuple(nearest)][far]
    return filled
