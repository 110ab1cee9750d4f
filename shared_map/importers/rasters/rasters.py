"""GeoTIFF and whatever else rasterio reads, brought north-up onto one square metric grid, a band of rows at a time.

rasterio is imported where it is used: agents never need it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Floats
from shared_map.importers.rasters.georeference import crs_of, overruled, plan_grid, resampling
from shared_map.importers.rasters.raster_kinds import kind_of
from shared_map.importers.water.level_ground import MOST_SAMPLED, looked_at
from shared_map.importers.water.voids import without
from shared_map.terrain.row_bands import Progress, bands, no_progress
from swarm.config.ground import TerrainConfig
from swarm.config.input_files import size
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec

_BY_ROWS = ("GTiff", "SRTMHGT", "VRT", "EHdr", "ENVI", "HFA")
_MAX_PIXELS = 16 * MAX_CELLS
"""Of formats which are read a part at a time. Of others, `MAX_CELLS`."""
_MAX_BLOCK_BYTES = 512 << 20
"""A block is what has to be unpacked at once."""
_MOST_BLOCKS = 1 << 20
"""Of a band of a sparse file."""
_MAX_BANDS = 256
_LONGEST_REASON = 200
_UNITS_M = {
    **dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet"), 0.3048),
    **dict.fromkeys(("us survey foot", "us survey feet", "survey foot", "survey feet", "us foot"), 1200 / 3937),
    **dict.fromkeys(("us feet", "us ft", "ftus", "ft us", "foot us", "usft"), 1200 / 3937),
    **dict.fromkeys(("fathom", "fathoms"), 1.8288),
    **dict.fromkeys(("dm", "decimetre", "decimeter"), 0.1),
    **dict.fromkeys(("cm", "centimetre", "centimeter", "centimetres", "centimeters"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimeter"), 0.001),
    **dict.fromkeys(("km", "kilometre", "kilometer"), 1000.0),
    **dict.fromkeys(("", "m", "metre", "meter", "metres", "meters"), 1.0),
}
"""What a file may call the unit of its heights, in metres. Written as `_plain_unit` leaves it."""
_READ_ROWS = 512


@dataclass(frozen=True, eq=False)
class Raster:
    """Heights on the terrain's grid.

    elevation_m  float32 (rows, cols), m; NaN is a void
    level        bool (rows, cols): level ground of the file
    notes        what was done to them, for people
    """

    grid: GridSpec
    elevation_m: Floats
    level: Bools
    notes: tuple[str, ...]


@contextmanager
def opened(path: Path, what: str) -> Iterator[Any]:
    """A rasterio dataset; `what` names it in errors.

    Raises
    ------
    TerrainError
        If the file is missing, no raster or truncated; also for what goes wrong while it is read.
    """
    import warnings

    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    if not path.is_file():
        raise TerrainError(f"{what} {path} does not exist")
    try:
        name, driver = kind_of(path, what)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # A .vrt names other files: none of them may be somewhere on the network.
            with (
                rasterio.Env(GDAL_CACHEMAX=128, CPL_LOG="/dev/null", CPL_VSIL_CURL_ALLOWED_EXTENSIONS=".none"),
                rasterio.open(name, driver=driver) as dataset,
            ):
                _check_size(dataset, f"{what} {path}")
                if name is path:
                    _check_length(path, dataset, what)
                yield dataset
    except (RasterioError, CPLE_BaseError, UnicodeDecodeError) as error:  # the last of names inside the file
        reason = str(error.__cause__ or error).strip().splitlines()[0][:_LONGEST_REASON]
        raise TerrainError(f"{what} {path} is truncated or no raster: {reason}") from error
    except OSError as error:
        raise TerrainError(f"cannot read {what} {path}: {error.strerror or error}") from error


def _check_size(dataset: Any, what: str) -> None:
    """Refuse what would not fit, before a pixel is read: a file of a megabyte can promise any number of them."""
    if dataset.count == 0:
        held = [name.rsplit(":", 1)[-1][:40] for name in dataset.subdatasets[:8]]
        raise TerrainError(
            f"{what} holds several rasters ({', '.join(held)}), expected one: gdal_translate takes one out"
        )
    rows, cols = dataset.height, dataset.width
    most = _MAX_PIXELS if dataset.driver in _BY_ROWS else MAX_CELLS
    if rows * cols > most:
        raise TerrainError(f"{what} has {rows} x {cols} pixels; at most {most} are read: crop it")
    if dataset.count > _MAX_BANDS:
        raise TerrainError(f"{what} has {dataset.count} bands; at most {_MAX_BANDS} are read")
    widths = [np.dtype(dtype).itemsize for dtype in dataset.dtypes]
    interleaved = str(dataset.tags(ns="IMAGE_STRUCTURE").get("INTERLEAVE", "")).upper() == "PIXEL"
    for (high, wide), width in zip(dataset.block_shapes, widths, strict=True):
        block = high * wide * (sum(widths) if interleaved else width)
        if block > _MAX_BLOCK_BYTES:
            raise TerrainError(
                f"{what} is stored in blocks of {high} x {wide} pixels, {size(block)}; at most"
                f" {size(_MAX_BLOCK_BYTES)} are unpacked at once: gdal_translate -co TILED=YES makes smaller ones"
            )


def _check_length(path: Path, dataset: Any, what: str) -> None:
    """An uncompressed file must be as long as its header says, but for blocks that were never written: a header can
    promise 20 GB."""
    if dataset.driver != "GTiff" or dataset.compression is not None:
        return
    promised = dataset.width * dataset.height * sum(np.dtype(dtype).itemsize for dtype in dataset.dtypes)
    if path.stat().st_size < promised and _is_cut(dataset, path.stat().st_size):
        raise TerrainError(
            f"{what} {path} is truncated: its header promises {dataset.height} x {dataset.width} cells,"
            f" {size(promised)}, and it has {size(path.stat().st_size)}; fetch it again"
        )


def _is_cut(dataset: Any, length: int) -> bool:
    """Whether a block of a GeoTIFF lies beyond the end of its file. A sparse file has blocks that lie nowhere."""
    written = 0
    for band, (high, wide) in enumerate(dataset.block_shapes, 1):
        rows, cols = -(-dataset.height // high), -(-dataset.width // wide)
        if rows * cols > _MOST_BLOCKS:
            return True
        for block in range(rows * cols):
            place = f"{block % cols}_{block // cols}"
            offset = dataset.get_tag_item(f"BLOCK_OFFSET_{place}", "TIFF", bidx=band)
            if offset is None:
                continue
            written += 1
            size_of_block = dataset.get_tag_item(f"BLOCK_SIZE_{place}", "TIFF", bidx=band)
            if int(offset) + int(size_of_block or 0) > length:
                return True
    return written == 0


def read_elevation(path: Path, config: TerrainConfig, progress: Progress = no_progress) -> Raster:
    """Heights of a file on a square metric grid. Bilinear; averaged where cells grow by half or more.

    Parameters
    ----------
    path : Path
        One band of heights; scale, offset and feet that the file declares are applied.
    config : TerrainConfig
        `crs`, `resolution_m` and `height_scale` count.
    progress : callable
        Told what is done and how much of it.

    Raises
    ------
    TerrainError
        If the file cannot be read, holds no heights, or does not fit a grid (see `plan_grid`).
    """
    with opened(path, "terrain") as dataset:
        return elevation_of(dataset, path, config, progress)


def elevation_of(dataset: Any, path: Path, config: TerrainConfig, progress: Progress = no_progress) -> Raster:
    """As `read_elevation`, of a dataset that is open; `path` names it in errors."""
    if dataset.count >= 3:
        raise TerrainError(f"terrain {path} has {dataset.count} bands: a photo? Name it in terrain.photo")
    if np.dtype(dataset.dtypes[0]).kind not in "iuf":
        raise TerrainError(f"terrain {path} holds {dataset.dtypes[0]} values; heights are whole or real numbers")
    crs = crs_of(dataset.crs, config.crs, f"terrain {path}")
    grid, target, notes = plan_grid(
        dataset.transform, dataset.height, dataset.width, crs, config.resolution_m, f"terrain {path}"
    )
    notes += overruled(dataset.crs, config.crs)
    factor, offset = float(dataset.scales[0] or 1.0), float(dataset.offsets[0] or 0.0)
    if (factor, offset) != (1.0, 0.0):
        notes.append(f"heights are stored as {dataset.dtypes[0]}; scale {factor:g} and offset {offset:g} applied")
    unit = _plain_unit(dataset.units[0] or "")
    unit_m = _UNITS_M.get(unit, 1.0)
    if unit_m != 1.0:
        factor, offset = factor * unit_m, offset * unit_m
        notes.append(f"heights are in {unit}, put into metres")
    elif unit not in _UNITS_M and config.height_scale is None:
        notes.append(f"heights are in {unit[:40]!r}, which is unknown, and taken for metres: terrain.height_scale")
    elif not unit and config.height_scale is None and crs.is_projected and crs.linear_units_factor[1] != 1.0:
        name, metres = crs.linear_units_factor
        notes.append(
            f"distances are in {name}, and heights, of which the file says nothing, are taken for metres; if"
            f" they are not, terrain.height_scale = {metres:.6g}"
        )
    if config.height_scale is not None:
        factor, offset = factor * config.height_scale, offset * config.height_scale
    if dataset.count == 2:
        notes.append("the file has two bands; heights are taken from the first")
    sample = _sampled(dataset)
    voids, found, told = looked_at(sample, config, factor, offset)
    notes.extend(told)
    level = _placed_mask(dataset, found, crs, grid, target)
    elevation_m = np.empty((grid.rows, grid.cols), np.float32)
    heights = _heights_without(dataset, voids, path) if voids and target is not None else None
    for row0, row1 in bands(grid.rows, _READ_ROWS):
        band = elevation_m[row0:row1]
        if target is None:
            _read_straight(dataset, row0, row1, band, voids)
        else:
            _read_warped(dataset, heights, crs, grid, target, row0, band)
        if (factor, offset) != (1.0, 0.0):
            band *= np.float32(factor)
            band += np.float32(offset)
        progress("reading heights", row1 / grid.rows)
    return Raster(grid, elevation_m, level, tuple(notes))


def _plain_unit(text: str) -> str:
    """A unit without case, brackets and signs: [m], US_survey_foot, ft (US)."""
    return " ".join("".join(sign if sign.isalnum() else " " for sign in text.lower()).split())


def _sampled(dataset: Any) -> Floats:
    """The first band, or of a large one so many of its cells as fit, float32, as stored; NaN where no height is
    declared."""
    every = math.ceil(math.sqrt(max(dataset.height * dataset.width / MOST_SAMPLED, 1.0)))
    sample: Floats = thinned(dataset.read, dataset, 1, every).astype(np.float32)
    known = thinned(dataset.read_masks, dataset, 1, every) > 0
    sample[~(known & np.isfinite(sample))] = np.nan
    return sample


def thinned(read: Callable[..., NDArray[Any]], dataset: Any, bands_read: Any, every: int) -> NDArray[Any]:
    """Every so many rows and columns of what `read` gives of a dataset. GDAL's own way to read fewer cells unpacks
    a tile again and again: 6 s for a band of 4096 x 4096 that takes 0.1 s as a whole."""
    from rasterio.windows import Window

    if every == 1:
        return np.asarray(read(bands_read))
    parts = []
    for row0, row1 in bands(dataset.height, every * max(_READ_ROWS // every, 1)):
        window = Window(0, row0, dataset.width, row1 - row0)
        parts.append(read(bands_read, window=window)[..., ::every, ::every].copy())
    return np.concatenate(parts, axis=-2)


def _heights_without(dataset: Any, voids: Sequence[float], path: Path) -> Floats:
    """The whole first band, float32, as stored, NaN where there is no height. GDAL warps one value of no height
    only; of a second one it would make slopes."""
    if dataset.height * dataset.width > MAX_CELLS:
        raise TerrainError(
            f"terrain {path} has voids that it does not declare ({', '.join(f'{v:g}' for v in voids)}) and is too"
            " large to mend here: gdal_calc or gdal_edit.py -a_nodata does it"
        )
    heights: Floats = dataset.read(1).astype(np.float32)
    heights[dataset.read_masks(1) == 0] = np.nan
    return without(heights, voids)


def _placed_mask(dataset: Any, mask: Bools, crs: Any, grid: GridSpec, target: Any) -> Bools:
    """A mask of a dataset's ground, of any number of cells, on the terrain's grid: the nearest cell counts."""
    from rasterio.transform import Affine
    from rasterio.warp import Resampling, reproject

    rows, cols = mask.shape
    if target is None:
        at_row = ((np.arange(grid.rows) + 0.5) * (rows / grid.rows)).astype(np.intp)
        at_col = ((np.arange(grid.cols) + 0.5) * (cols / grid.cols)).astype(np.intp)
        return np.asarray(mask[np.ix_(at_row, at_col)], np.bool_)
    placed = np.zeros((grid.rows, grid.cols), np.uint8)
    reproject(
        mask.astype(np.uint8),
        placed,
        src_transform=dataset.transform @ Affine.scale(dataset.width / cols, dataset.height / rows),
        src_crs=crs,
        dst_crs=target,
        dst_transform=_transform_from(grid, 0),
        resampling=Resampling.nearest,
        num_threads=os.cpu_count() or 1,
    )
    return placed > 0


def _transform_from(grid: GridSpec, row0: int) -> Any:
    from rasterio.transform import from_origin

    north = grid.north_m - row0 * grid.resolution_m
    return from_origin(grid.west_m, north, grid.resolution_m, grid.resolution_m)


def _read_straight(dataset: Any, row0: int, row1: int, band: Floats, voids: Sequence[float]) -> None:
    from rasterio.enums import MaskFlags
    from rasterio.windows import Window

    window = Window(0, row0, dataset.width, row1 - row0)
    raw = dataset.read(1, window=window)
    np.copyto(band, raw, casting="unsafe")
    flags = dataset.mask_flag_enums[0]
    if dataset.nodata is not None and MaskFlags.nodata in flags:
        if not math.isnan(dataset.nodata):
            band[raw == np.asarray(dataset.nodata).astype(raw.dtype)] = np.nan
    elif MaskFlags.all_valid not in flags:
        band[dataset.read_masks(1, window=window) == 0] = np.nan
    if voids:
        band[:] = without(band, voids)


def _read_warped(
    dataset: Any, heights: Floats | None, crs: Any, grid: GridSpec, target: Any, row0: int, band: Floats
) -> None:
    """heights  what to warp instead of the dataset's own, NaN where there is none"""
    import rasterio
    from rasterio.warp import reproject

    nodata = dataset.nodata
    if heights is not None or (nodata is None and np.dtype(dataset.dtypes[0]).kind == "f"):
        nodata = math.nan
    reproject(
        rasterio.band(dataset, 1) if heights is None else heights,
        band,
        src_transform=None if heights is None else dataset.transform,
        src_crs=crs,
        src_nodata=nodata,
        dst_crs=target,
        dst_transform=_transform_from(grid, row0),
        dst_nodata=math.nan,
        resampling=resampling(dataset, crs, grid, target),
        num_threads=os.cpu_count() or 1,
    )


def mask_of(path: Path, grid: GridSpec) -> NDArray[np.bool_]:
    """A painted mask, bool (rows, cols): true wherever the first band of the image is not 0.

    Raises TerrainError if the image cannot be read or is not as large as the grid.
    """
    with opened(path, "mask") as dataset:
        if (dataset.height, dataset.width) != (grid.rows, grid.cols):
            raise TerrainError(
                f"mask {path} has {dataset.height} x {dataset.width} pixels, the terrain {grid.rows} x {grid.cols}"
            )
        return np.asarray(dataset.read(1) != 0, np.bool_)
