"""A raster of paces or factors of the user's own, brought onto the terrain's grid."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from shared_map.arrays import Floats
from shared_map.importers.georeference import crs_name, grows, overlap, system_named, warped
from shared_map.importers.raster_files import opened
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec


def values_on(path: Path, grid: GridSpec, crs: str | None, where: str) -> tuple[Floats, str]:
    """The first band of a raster on a grid, float32, NaN where it has no value, and the name of its system. The
    nearest cell counts, or the mean where cells of the grid are half as large again.

    crs  its system, where the file does not say it; "local" is that of a terrain without a place

    Raises TerrainError if it cannot be read, has several bands, or does not touch the grid.
    """
    import rasterio

    what = f"{where} {path}"
    with opened(path, where) as dataset:
        if dataset.count != 1:
            raise TerrainError(f"{what} has {dataset.count} bands, expected one")
        if np.dtype(dataset.dtypes[0]).kind not in "iuf":
            raise TerrainError(f"{what} holds {dataset.dtypes[0]} values, expected whole or real numbers")
        if dataset.height * dataset.width > MAX_CELLS:
            raise TerrainError(
                f"{what} has {dataset.height} x {dataset.width} pixels; at most {MAX_CELLS} are read"
            )
        own = dataset.crs if crs in (None, "local") else system_named(str(crs), f"{what}: crs")
        if crs == "local":
            own = rasterio.CRS.from_epsg(3857)  # metres of the terrain's own map: which one does not matter
        elif own is None:
            raise TerrainError(f"{what} does not say in which coordinate system it is; set crs, or 'local'")
        elif grid.crs == "local":
            raise TerrainError(f"{what} is in {crs_name(own)}, and the terrain has no place; set crs = 'local'")
        target = own if crs == "local" else rasterio.CRS.from_user_input(grid.crs)
        overlap(dataset, own, target, grid, what)
        stored: Floats = dataset.read(1).astype(np.float32)
        stored[dataset.read_masks(1) == 0] = np.nan
        stored *= np.float32(dataset.scales[0] or 1.0)
        stored += np.float32(dataset.offsets[0] or 0.0)
        how = "average" if grows(dataset, dataset.transform, own, grid, target) else "nearest"
        values = np.full((grid.rows, grid.cols), np.nan, np.float32)
        place = {"src_transform": dataset.transform, "src_nodata": math.nan, "dst_nodata": math.nan}
        warped(stored, values, grid, own, target, how, **place)
        return values, "local" if crs == "local" else crs_name(own)
