"""Rasters brought onto the square metric grid of a terrain."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import rasterio
from rasterio.transform import from_origin
from rasterio.vrt import WarpedVRT
from rasterio.warp import Resampling

from shared_map.array_files import Floats
from shared_map.importers.georeference import METRES, bounds_in, going_on, pixel_m, reprojecting, systems_of
from shared_map.importers.raster_files import READ_ROWS
from shared_map.terrain.row_bands import Progress, bands, no_progress
from swarm.errors import TerrainError
from swarm.grid import GridSpec


def transform_of(grid: GridSpec) -> Any:
    """The affine transform from (col, row) of a grid to metres."""
    return from_origin(grid.west_m, grid.north_m, grid.resolution_m, grid.resolution_m)


@dataclass(frozen=True, eq=False)
class Placed:
    """Transformation of a raster onto the grid of a terrain.

    transform, crs  affine transform and coordinate system of the raster
    target          the grid's system
    share           of the terrain, within the raster's frame
    is_cells        whether the raster's pixels are the terrain's cells, which then are taken as they are
    """

    dataset: Any
    grid: GridSpec
    transform: Any
    crs: Any
    target: Any
    share: float = 1.0
    is_cells: bool = False

    @property
    def grows(self) -> bool:
        """True if the grid is at least half as coarse again: then its cells are averaged or counted."""
        size = self.dataset.height, self.dataset.width
        width, height = pixel_m(self.transform, *size, self.crs, self.target)
        return self.grid.resolution_m >= 1.5 * max(width, height)

    def on_grid(
        self, how: str, indexes: Any = 1, what: str = "", progress: Progress = no_progress
    ) -> Iterator[tuple[slice, Floats]]:
        """Some rows of the grid at a time, and their values, float32; NaN where the raster shows nothing.

        how       the name of one of rasterio's resamplings
        indexes   a band, or several
        what      the current step, as `progress` tells it
        """
        grid, dataset = self.grid, self.dataset
        is_real = np.dtype(dataset.dtypes[0]).kind == "f"
        void = math.nan if dataset.nodata is None and is_real else dataset.nodata
        resampling = Resampling.nearest if self.is_cells else Resampling[how]
        place = transform_of(grid)
        own = place if self.is_cells else self.transform
        size = {"width": grid.cols, "height": grid.rows, "dtype": "float32", "nodata": math.nan}
        crs = going_on(self.crs, own, dataset.height, dataset.width)
        source = {"src_crs": crs, "src_transform": own, "src_nodata": void}
        # A photo shows nothing only where no band does.
        target = {"crs": self.target, "transform": place, "NUM_THREADS": "ALL_CPUS", "UNIFIED_SRC_NODATA": "YES"}
        with WarpedVRT(dataset, resampling=resampling, **source, **target, **size) as cells:
            for row0, row1 in bands(grid.rows, READ_ROWS):
                yield slice(row0, row1), cells.read(indexes, window=((row0, row1), (0, grid.cols)))
                progress(what, row1 / grid.rows)


def place_on(dataset: Any, grid: GridSpec, given: str | None, what: str, key: str = "terrain.crs") -> Placed:
    """Returns the transformation of a file onto the terrain's grid.

    given  its system, as the value of `key` in the scenario; "local" is that of a terrain without a place

    Raises TerrainError if one of the two has no place on Earth and they differ in size, the file does not say in
    which system it is (nor does `given`), or does not overlap the terrain.
    """
    same_shape = (dataset.height, dataset.width) == grid.shape
    has_place = bool(dataset.crs) or not dataset.transform.is_identity
    if not has_place or (grid.crs == "local" and given is None):
        if not same_shape:
            raise TerrainError(
                f"{what} has {dataset.height} x {dataset.width} pixels and no place in common with the terrain of"
                f" {grid.rows} x {grid.cols} cells; georeference both, or make them the same size"
            )
        metres = rasterio.CRS.from_wkt(METRES)
        return Placed(dataset, grid, dataset.transform, metres, metres, is_cells=True)
    target, crs = systems_of(grid, dataset.crs, given, what, key)
    if target is None:
        target = crs = rasterio.CRS.from_wkt(METRES)
    share = _overlap(dataset, crs, target, grid, what)
    is_cells = crs == target and same_shape and dataset.transform.almost_equals(transform_of(grid), 1e-3)
    return Placed(dataset, grid, dataset.transform, crs, target, share, is_cells)


def _overlap(dataset: Any, crs: Any, target: Any, grid: GridSpec, what: str) -> float:
    """Share of the terrain within a file's frame. Raises TerrainError if there is none."""
    with reprojecting(what, crs, target):
        west, south, east, north = bounds_in(dataset.transform, dataset.height, dataset.width, crs, target)
    grid_east = grid.west_m + grid.cols * grid.resolution_m
    grid_south = grid.north_m - grid.rows * grid.resolution_m
    wide = min(east, grid_east) - max(west, grid.west_m)
    high = min(north, grid.north_m) - max(south, grid_south)
    if wide <= 0 or high <= 0:
        raise TerrainError(
            f"{what} does not overlap the terrain: it covers x {west:.7g}..{east:.7g}, y {south:.7g}..{north:.7g},"
            f" the terrain x {grid.west_m:.7g}..{grid_east:.7g}, y {grid_south:.7g}..{grid.north_m:.7g}"
        )
    return wide * high / (grid.rows * grid.cols * grid.resolution_m**2)
