"""A colour photo from a file, brought onto the grid of the elevation."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Bytes
from shared_map.importers.photos.true_colour import MOST_SIDE, why_drawn
from shared_map.importers.rasters.georeference import bounds_in, crs_name, crs_of, resampling
from shared_map.importers.rasters.rasters import opened, thinned
from shared_map.terrain.row_bands import Progress, bands, no_progress
from swarm.errors import TerrainError
from swarm.grid import GridSpec

_READ_ROWS = 512


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo on the terrain's grid.

    rgb    uint8 (rows, cols, 3): red, green, blue; black where it shows nothing
    seen   bool (rows, cols): where it shows anything
    notes  what was done to it, for people
    drawn  that its own pixels are those of a drawn map, for people; None if they may be a photo's
    """

    rgb: Bytes
    seen: Bools
    notes: tuple[str, ...]
    drawn: str | None = None


def read_photo(path: Path, grid: GridSpec, given_crs: str | None, progress: Progress = no_progress) -> Photo:
    """The photo on the terrain's grid.

    Parameters
    ----------
    path : Path
        Whatever rasterio reads. What is not in bytes is stretched from its 2nd to its 98th percentile.
    grid : GridSpec
        Of the terrain.
    given_crs : str or None
        Coordinate system of a photo that has a place but does not name its system.
    progress : callable
        Told what is done and how much of it.

    Raises
    ------
    TerrainError
        If the file cannot be read or names no coordinate system, if it does not overlap the terrain or shows
        nothing of it, or if one of the two has no place on earth and they differ in size.
    """
    import rasterio

    what = f"photo {path}"
    with opened(path, "photo") as dataset:
        georeferenced = dataset.crs or not dataset.transform.is_identity
        same_shape = (dataset.height, dataset.width) == (grid.rows, grid.cols)
        if not georeferenced or grid.crs == "local":
            if not same_shape:
                raise TerrainError(
                    f"{what} has {dataset.height} x {dataset.width} pixels and no place in common with the"
                    f" terrain of {grid.rows} x {grid.cols} cells; georeference both, or make them the same size"
                )
            return _read(dataset, grid, None, None, [], progress)
        crs = crs_of(dataset.crs, given_crs if not dataset.crs else None, what)
        target = rasterio.CRS.from_user_input(grid.crs)
        share = overlap(dataset, crs, target, grid, what)
        notes = [f"photo: {dataset.height} x {dataset.width} pixels, covers {share:.1%} of the terrain"]
        aligned = crs == target and same_shape and dataset.transform.almost_equals(transform_of(grid), 1e-3)
        return _read(dataset, grid, crs, None if aligned else target, notes, progress)


def transform_of(grid: GridSpec) -> Any:
    """The affine transform from (col, row) to metres, as rasterio wants it."""
    from rasterio.transform import from_origin

    return from_origin(grid.west_m, grid.north_m, grid.resolution_m, grid.resolution_m)


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
            f"{what} does not overlap the terrain: it covers x {west:.0f}..{east:.0f}, y {south:.0f}..{north:.0f}"
            f" m, the terrain x {grid.west_m:.0f}..{grid_east:.0f}, y {grid_south:.0f}..{grid.north_m:.0f}"
        )
    return wide * high / (grid.rows * grid.cols * grid.resolution_m**2)


def _read(dataset: Any, grid: GridSpec, crs: Any, target: Any, notes: list[str], progress: Progress) -> Photo:
    indexes, palette = _colour_bands(dataset)
    alpha = _alpha_band(dataset)
    low, high = _stretch(dataset, indexes, notes)
    if len(indexes) == 1 and palette is None:
        notes.append("the photo is grey: without colour, what covers the ground is a guess")
    rgb = np.empty((grid.rows, grid.cols, 3), np.uint8)
    seen = np.empty((grid.rows, grid.cols), np.bool_)
    for row0, row1 in bands(grid.rows, _READ_ROWS):
        raw = [_band(dataset, index, row0, row1, grid, crs, target) for index in indexes]
        inside = (
            np.ones(raw[0].shape, np.bool_) if target is None else _coverage(dataset, row0, row1, grid, crs, target)
        )
        if raw[0].dtype.kind == "f":
            inside &= ~np.any([np.isnan(values) for values in raw], axis=0)
        if dataset.nodata is not None:
            inside &= ~np.all([values == dataset.nodata for values in raw], axis=0)
        if alpha is not None:
            inside &= _band(dataset, alpha, row0, row1, grid, crs, target) > 0
        seen[row0:row1] = inside
        for channel in range(3):
            values = raw[channel % len(raw)]
            if palette is not None:
                values = palette[np.minimum(values.astype(np.intp), 255), channel]
            elif high > low:
                scaled = (values.astype(np.float32) - np.float32(low)) * np.float32(255 / (high - low))
                values = np.clip(np.nan_to_num(scaled), 0, 255)
            rgb[row0:row1, :, channel] = np.where(inside, values, 0)
        progress("reading photo", row1 / grid.rows)
    if not seen.any():
        raise TerrainError(f"photo {dataset.name} shows nothing of the terrain: all of it is nodata or transparent")
    if not seen.all():
        notes.append(f"the photo shows nothing of {1 - seen.mean():.1%} of the terrain, whose class is unknown")
    return Photo(rgb, seen, tuple(notes), _why_drawn(dataset, indexes, palette))


def _why_drawn(dataset: Any, indexes: list[int], palette: NDArray[np.uint8] | None) -> str | None:
    """Looked for in the file's own pixels, in its middle."""
    from rasterio.windows import Window

    if len(indexes) == 1 and palette is None:
        return None
    if any(dataset.dtypes[index - 1] != "uint8" for index in indexes):
        return None
    rows, cols = min(dataset.height, MOST_SIDE), min(dataset.width, MOST_SIDE)
    window = Window((dataset.width - cols) // 2, (dataset.height - rows) // 2, cols, rows)
    stored = dataset.read(indexes, window=window)
    rgb = np.moveaxis(stored, 0, -1) if palette is None else palette[stored[0]]
    return why_drawn(rgb, dataset.dataset_mask(window=window) > 0)


def _band(dataset: Any, index: int, row0: int, row1: int, grid: GridSpec, crs: Any, target: Any) -> NDArray[Any]:
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.warp import Resampling, reproject
    from rasterio.windows import Window

    if target is None:
        window = Window(0, row0, dataset.width, row1 - row0)
        return np.asarray(dataset.read(index, window=window))
    exact = dataset.colorinterp[index - 1] in (ColorInterp.palette, ColorInterp.alpha)
    band = np.zeros((row1 - row0, grid.cols), dataset.dtypes[index - 1])
    reproject(
        rasterio.band(dataset, index),
        band,
        src_crs=crs,
        dst_crs=target,
        dst_transform=_band_transform(grid, row0),
        resampling=Resampling.nearest if exact else resampling(dataset, crs, grid, target),
        num_threads=os.cpu_count() or 1,
    )
    return band


def _coverage(dataset: Any, row0: int, row1: int, grid: GridSpec, crs: Any, target: Any) -> Bools:
    """Which cells of a band lie inside the photo's frame at all: a coarse frame of ones, warped."""
    from rasterio.transform import Affine
    from rasterio.warp import Resampling, reproject

    ones = np.ones((min(dataset.height, 64), min(dataset.width, 64)), np.uint8)
    wide, high = dataset.width / ones.shape[1], dataset.height / ones.shape[0]
    t = dataset.transform
    inside = np.zeros((row1 - row0, grid.cols), np.uint8)
    reproject(
        ones,
        inside,
        src_transform=Affine(t.a * wide, t.b * high, t.c, t.d * wide, t.e * high, t.f),
        src_crs=crs,
        dst_crs=target,
        dst_transform=_band_transform(grid, row0),
        resampling=Resampling.nearest,
    )
    return np.asarray(inside > 0, np.bool_)


def _band_transform(grid: GridSpec, row0: int) -> Any:
    from rasterio.transform import from_origin

    north = grid.north_m - row0 * grid.resolution_m
    return from_origin(grid.west_m, north, grid.resolution_m, grid.resolution_m)


def _colour_bands(dataset: Any) -> tuple[list[int], NDArray[np.uint8] | None]:
    """Which bands are red, green and blue; one grey band stands for all three; a palette is looked up."""
    from rasterio.enums import ColorInterp

    meanings = list(dataset.colorinterp)
    wanted = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if all(colour in meanings for colour in wanted):
        return [meanings.index(colour) + 1 for colour in wanted], None
    if meanings[0] == ColorInterp.palette:
        table = np.zeros((256, 3), np.uint8)
        for value, colour in dataset.colormap(1).items():
            table[value] = colour[:3]
        return [1], table
    return ([1, 2, 3] if dataset.count >= 3 else [1]), None


def _alpha_band(dataset: Any) -> int | None:
    from rasterio.enums import ColorInterp

    meanings = list(dataset.colorinterp)
    return meanings.index(ColorInterp.alpha) + 1 if ColorInterp.alpha in meanings else None


def _stretch(dataset: Any, indexes: list[int], notes: list[str]) -> tuple[float, float]:
    """Darkest and brightest of a photo that is not in bytes; (0, 0) for bytes."""
    if all(dataset.dtypes[index - 1] == "uint8" for index in indexes):
        return 0.0, 0.0
    every = -(-max(dataset.height, dataset.width) // 512)
    sample = thinned(dataset.read, dataset, indexes, every).astype(np.float64)
    sample = sample[np.isfinite(sample) & (sample != (0 if dataset.nodata is None else dataset.nodata))]
    if sample.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(sample, (2, 98)))
    notes.append(f"photo stretched from {low:.4g}..{high:.4g} to bytes")
    return low, max(high, low + 1e-9)
