"""Rasters brought onto the square metric grid of a terrain."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from shared_map.importers.georeference import bounds_in, crs_name, crs_of, pixel_m
from swarm.errors import TerrainError
from swarm.grid import GridSpec


def transform_of(grid: GridSpec, row0: int = 0) -> Any:
    """The affine transform from (col, row) of a grid, counted from a row on, to metres."""
    from rasterio.transform import from_origin

    north = grid.north_m - row0 * grid.resolution_m
    return from_origin(grid.west_m, north, grid.resolution_m, grid.resolution_m)


@dataclass(frozen=True, eq=False)
class Placed:
    """Transformation of a raster onto the grid of a terrain.

    transform, crs  affine transform and coordinate system of the raster
    target          the grid's system; None if the raster's pixels are the terrain's cells
    share           of the terrain, within the raster's frame
    """

    dataset: Any
    grid: GridSpec
    transform: Any
    crs: Any
    target: Any
    share: float = 1.0

    @property
    def grows(self) -> bool:
        """True if the grid is at least half as coarse again: then its cells are averaged or counted."""
        size = self.dataset.height, self.dataset.width
        width, height = pixel_m(self.transform, *size, self.crs, self.target)
        return self.grid.resolution_m >= 1.5 * max(width, height)

    def warp(self, source: Any, onto: NDArray[Any], how: str, row0: int = 0, **given: Any) -> NDArray[Any]:
        """Brings a band, or an array in its place, onto rows of the grid, in place.

        Parameters
        ----------
        source : int or array (rows, cols)
            Number of a band, or any number of cells over the same ground as the raster.
        onto : array (rows, grid.cols)
            Cells that the source does not reach become `dst_nodata`, or stay as they are.
        how : str
            The name of one of rasterio's resamplings.
        row0 : int
            Row of the grid that is the first of `onto`.
        **given
            For `rasterio.warp.reproject`.
        """
        import rasterio
        from rasterio.transform import Affine
        from rasterio.vrt import WarpedVRT
        from rasterio.warp import Resampling, reproject

        place = {
            "src_crs": self.crs,
            "dst_crs": self.target or self.crs,
            "dst_transform": transform_of(self.grid, row0),
        }
        with contextlib.ExitStack() as files:
            dataset = self.dataset
            if (dataset.crs, dataset.transform) != (self.crs, self.transform):
                # Of a band, GDAL takes the file's own place, whatever it is told.
                frame = {"transform": self.transform, "width": dataset.width, "height": dataset.height}
                said = {"src_crs": self.crs, "src_transform": self.transform, "crs": self.crs}
                dataset = files.enter_context(WarpedVRT(dataset, **said, **frame))
            if isinstance(source, int):
                source = rasterio.band(dataset, source)
            else:
                rows, cols = source.shape
                stretch = Affine.scale(dataset.width / cols, dataset.height / rows)
                place["src_transform"] = self.transform @ stretch
            threads = os.cpu_count() or 1
            reproject(source, onto, **place, **given, resampling=Resampling[how], num_threads=threads)
        return onto


def place_on(dataset: Any, grid: GridSpec, given: str | None, what: str) -> Placed:
    """Returns the transformation of a file onto the terrain's grid.

    Raises TerrainError if one of the two has no place on Earth and they differ in size, the file does not say in
    which system it is (nor does `given`), or does not overlap the terrain.
    """
    import rasterio

    same_shape = (dataset.height, dataset.width) == grid.shape
    if not (dataset.crs or not dataset.transform.is_identity) or grid.crs == "local":
        if not same_shape:
            raise TerrainError(
                f"{what} has {dataset.height} x {dataset.width} pixels and no place in common with the terrain of"
                f" {grid.rows} x {grid.cols} cells; georeference both, or make them the same size"
            )
        return Placed(dataset, grid, dataset.transform, None, None)
    crs = crs_of(dataset.crs, given if not dataset.crs else None, what)
    target = rasterio.CRS.from_user_input(grid.crs)
    share = overlap(dataset, crs, target, grid, what)
    is_cells = crs == target and same_shape and dataset.transform.almost_equals(transform_of(grid), 1e-3)
    return Placed(dataset, grid, dataset.transform, crs, None if is_cells else target, share)


def overlap(dataset: Any, crs: Any, target: Any, grid: GridSpec, what: str) -> float:
    """Share of the terrain within a file's frame. Raises TerrainError if there is none."""
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import RasterioError

    try:
        west, south, east, north = bounds_in(dataset.transform, dataset.height, dataset.width, crs, target, what)
    except (RasterioError, CPLE_BaseError) as error:
        names = crs_name(crs), crs_name(target)
        raise TerrainError(
            f"{what} is in {names[0]}, from which no way leads to the terrain's {names[1]}"
        ) from error
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
