"""Cells without a height: found, and filled on request."""

from __future__ import annotations

import numpy as np

from shared_map.arrays import Floats
from shared_map.terrain.row_bands import bands

HIGHEST_M = 20_000.0
"""Heights beyond this, up or down, are undeclared voids."""
_SEARCH_CELLS = 64


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
