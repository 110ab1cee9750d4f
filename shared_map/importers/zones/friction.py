"""A raster of paces or factors of the user's own, brought onto the terrain's grid."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from shared_map.arrays import Floats
from shared_map.importers.rasters.georeference import bounds_in, crs_name, resampling
from shared_map.importers.rasters.rasters import opened
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec


def values_on(path: Path, grid: GridSpec, crs: str | None, where: str) -> tuple[Floats, str]:
    """The first band of a raster on a grid, float32, NaN where it has no value, and the name of its system. The
    nearest cell counts, or the mean where cells of the grid are half as large again.

    crs  its system, where the file does not say it; "local" is that of a terrain without a place

    Raises TerrainError if it cannot be read, has several bands, or does not touch the grid.
    """
    import rasterio
    from rasterio.errors import CRSError
    from rasterio.transform import from_origin
    from rasterio.warp import Resampling, reproject

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
        try:
            own = None if crs in (None, "local") else rasterio.CRS.from_user_input(crs)
        except (CRSError, ValueError) as error:
            raise TerrainError(f"{what}: crs {crs!r} is no coordinate system; write EPSG:32632 or alike") from error
        own = own or dataset.crs
        if crs != "local" and own is None:
            raise TerrainError(f"{what} does not say in which coordinate system it is; set crs, or 'local'")
        if crs != "local" and grid.crs == "local":
            raise TerrainError(f"{what} is in {crs_name(own)}, and the terrain has no place; set crs = 'local'")
        target = rasterio.CRS.from_user_input("EPSG:3857" if crs == "local" else grid.crs)
        own = target if crs == "local" else own  # metres of the same map: which one does not matter
        whole = (dataset.transform, dataset.height, dataset.width, own, target, what)
        west, south, east, north = bounds_in(*whole)
        if not (
            west < grid.west_m + grid.cols * grid.resolution_m
            and east > grid.west_m
            and south < grid.north_m
            and north > grid.north_m - grid.rows * grid.resolution_m
        ):
            raise TerrainError(
                f"{what} does not touch the terrain: it reaches from {west:.7g}, {south:.7g} to {east:.7g},"
                f" {north:.7g}, the terrain from {grid.west_m:.7g},"
                f" {grid.north_m - grid.rows * grid.resolution_m:.7g} to"
                f" {grid.west_m + grid.cols * grid.resolution_m:.7g}, {grid.north_m:.7g}; is crs right?"
            )
        stored: Floats = dataset.read(1).astype(np.float32)
        stored[dataset.read_masks(1) == 0] = np.nan
        stored *= np.float32(dataset.scales[0] or 1.0)
        stored += np.float32(dataset.offsets[0] or 0.0)
        mean = resampling(dataset, own, grid, target) == Resampling.average
        values = np.full((grid.rows, grid.cols), np.nan, np.float32)
        reproject(
            stored,
            values,
            src_transform=dataset.transform,
            src_crs=own,
            src_nodata=math.nan,
            dst_crs=target,
            dst_transform=from_origin(grid.west_m, grid.north_m, grid.resolution_m, grid.resolution_m),
            dst_nodata=math.nan,
            resampling=Resampling.average if mean else Resampling.nearest,
            num_threads=os.cpu_count() or 1,
        )
        return values, "local" if crs == "local" else crs_name(own)
