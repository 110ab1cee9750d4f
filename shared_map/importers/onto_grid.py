"""Rasters and arrays of heights brought onto the square metric grid of a terrain."""

from __future__ import annotations

import contextlib
import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats
from shared_map.importers.georeference import (
    bounds_in,
    crs_name,
    crs_of,
    equidistant,
    is_kept,
    metres_per_degree,
    pixel_m,
)
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec

# --- rasters ------------------------------------------------------------------------------------------------


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

        place = {"src_crs": self.crs, "dst_crs": self.target, "dst_transform": transform_of(self.grid, row0)}
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


# --- arrays, without rasterio: the demo builds its ground in a second ------------------------------------------


Steps = tuple[float, float]
"""Width and height of a cell."""


def from_degrees(
    heights: Floats, step: Steps, west: float, north: float, resolution_m: float | None, what: str
) -> tuple[Floats, GridSpec, str]:
    """Degrees put on metres, equidistant at the mean latitude. Else as `from_metres`."""
    middle = north - step[1] * heights.shape[0] / 2
    if not (abs(middle) < 85 and abs(west) <= 360):
        raise TerrainError(f"{what}: its middle is at latitude {middle:g}; degrees must lie between -85 and 85")
    per_lat, per_lon = metres_per_degree(middle)
    metric = (step[0] * per_lon, step[1] * per_lat)
    crs = equidistant(middle, west)
    return from_metres(heights, metric, 0.0, round(north * per_lat, 3), resolution_m, what, crs)


def from_metres(
    heights: Floats, step: Steps, west: float, north: float, resolution_m: float | None, what: str, crs: str
) -> tuple[Floats, GridSpec, str]:
    """Returns heights on a metric grid, the grid, and the notes for people.

    Parameters
    ----------
    heights : float32 (rows, cols), m
    step, west, north
        The size of a cell, and the outer corner of cell (0, 0), m.
    resolution_m : float or None
        Side of a cell of the grid; None keeps that of the heights.
    what : str
        Names the file in errors.
    crs : str
        Of the grid.

    Raises
    ------
    TerrainError
        If no cell fits, or more than `MAX_CELLS` do.
    """
    if is_kept(*step, max(heights.shape), resolution_m):
        resolution_m, step = step[0], (step[0], step[0])
    resolution_m = resolution_m or float(f"{math.sqrt(step[0] * step[1]):.4g}")
    col_step, row_step = resolution_m / step[0], resolution_m / step[1]
    rows, cols = int(heights.shape[0] / row_step + 1e-6), int(heights.shape[1] / col_step + 1e-6)
    if rows < 1 or cols < 1:
        raise TerrainError(f"terrain.resolution_m = {resolution_m:g} is coarser than the whole of {what}")
    if rows * cols > MAX_CELLS:
        raise TerrainError(f"{what} would be {rows} x {cols} cells; set a larger terrain.resolution_m")
    grid = GridSpec(rows, cols, resolution_m, west, north, crs)
    if col_step == row_step == 1:
        return heights, grid, f"{rows} x {cols} cells of {resolution_m:g} m"
    note = f"resampled from {step[1]:.1f} x {step[0]:.1f} m to {resolution_m:g} m"
    return resample(heights, rows, cols, row_step, col_step), grid, note


def nearest(array: NDArray[Any], grid: GridSpec) -> tuple[Any, ...]:
    """An index into an array over the same ground as a grid: the cell nearest to each cell of the grid."""
    rows, cols = array.shape[:2]
    at_row = ((np.arange(grid.rows) + 0.5) * rows / grid.rows).astype(np.intp)
    at_col = ((np.arange(grid.cols) + 0.5) * cols / grid.cols).astype(np.intp)
    return np.ix_(at_row, at_col)


def resample(values: Floats, rows: int, cols: int, row_step: float, col_step: float) -> Floats:
    """Heights on another grid with the same north-west corner.

    Parameters
    ----------
    values : float32 (source rows, source cols), m
        NaN is a void; it spreads to what it touches.
    rows, cols : int
        Cells of the result, within the extent of the source.
    row_step, col_step : float
        Source cells per cell. From 1.5 on cells are averaged, below that interpolated.

    Returns
    -------
    float32 (rows, cols), m
    """
    return np.ascontiguousarray(_along_rows(_along_rows(values, rows, row_step).T, cols, col_step).T)


def _along_rows(values: Floats, count: int, step: float) -> Floats:
    if step >= 1.5:
        return _averaged(values, count, step)
    at = np.clip((np.arange(count) + 0.5) * step - 0.5, 0, values.shape[0] - 1)
    low = np.minimum(at.astype(np.intp), max(values.shape[0] - 2, 0))
    part = (at - low).astype(np.float32)[:, None]
    high = np.minimum(low + 1, values.shape[0] - 1)
    between: Floats = values[low] * (np.float32(1) - part) + values[high] * part
    return between


def _averaged(values: Floats, count: int, step: float) -> Floats:
    """Mean over each cell's extent, by how much of each source cell lies in it."""
    averaged = np.empty((count, values.shape[1]), np.float32)
    for n in range(count):
        start, end = n * step, min((n + 1) * step, float(values.shape[0]))
        first, last = int(start), max(int(np.ceil(end)), int(start) + 1)
        weights = np.minimum(np.arange(first, last) + 1, end) - np.maximum(np.arange(first, last), start)
        weights = np.maximum(weights, 0)
        averaged[n] = np.tensordot(weights / weights.sum(), values[first:last], axes=1)
    return averaged
