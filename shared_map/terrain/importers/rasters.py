"""GeoTIFF and whatever else rasterio reads, brought north-up onto one square metric grid, a band of rows at a time.

rasterio is imported where it is used: agents never need it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.terrain.row_bands import Progress, bands, no_progress
from swarm.config.input_files import FileKind, check_bytes, size
from swarm.config.scenario import TerrainConfig
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec

_DRIVERS = {
    b"II*\0": "GTiff",
    b"MM\0*": "GTiff",
    b"II+\0": "GTiff",
    b"MM\0+": "GTiff",
    b"<VRTDataset": "VRT",
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"\0\0\0\x0cjP  ": "JP2OpenJPEG",
    b"RIFF": "WEBP",
    b"BM": "BMP",
}
"""First bytes -> GDAL's driver. GDAL knows 150 formats, most of which nobody has tried to break for long."""
_BY_ROWS = ("GTiff", "SRTMHGT", "VRT")
_MAX_PIXELS = 16 * MAX_CELLS
"""Of formats which are read a part at a time. Of others, `MAX_CELLS`."""
_MAX_BLOCK_BYTES = 512 << 20
"""A block is what has to be unpacked at once."""
_MAX_BANDS = 256
_FEET = {"ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "us survey foot": 1200 / 3937, "ftus": 1200 / 3937}
_SHOWN = ("lat_0", "lat_ts", "lon_0", "zone")
MAX_SPAN_DEG = 12.0
"""Beyond this, a local projection stretches by more than half a percent at its borders."""
HIGHEST_DEG = 85.0
"""Degrees nearer to a pole than this are not put on metres."""
_READ_ROWS = 512


@dataclass(frozen=True, eq=False)
class Raster:
    """Heights on the terrain's grid.

    elevation_m  float32 (rows, cols), m; NaN is a void
    notes        what was done to them, for people
    """

    grid: GridSpec
    elevation_m: Floats
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
        driver = _driver_of(path, what)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # A .vrt names other files: none of them may be somewhere on the network.
            with (
                rasterio.Env(GDAL_CACHEMAX=128, CPL_LOG="/dev/null", CPL_VSIL_CURL_ALLOWED_EXTENSIONS=".none"),
                rasterio.open(path, driver=driver) as dataset,
            ):
                _check_size(dataset, f"{what} {path}")
                _check_length(path, dataset, what)
                yield dataset
    except (RasterioError, CPLE_BaseError) as error:
        reason = str(error.__cause__ or error).strip().splitlines()[0]
        raise TerrainError(f"{what} {path} is truncated or no raster: {reason}") from error
    except OSError as error:
        raise TerrainError(f"cannot read {what} {path}: {error.strerror or error}") from error


def _driver_of(path: Path, what: str) -> str:
    if path.suffix.lower() == ".hgt":
        return "SRTMHGT"
    with path.open("rb") as file:
        head = file.read(16)
    driver = next((driver for magic, driver in _DRIVERS.items() if head.startswith(magic)), None)
    if driver is None:
        known = ", ".join(dict.fromkeys(_DRIVERS.values()))
        raise TerrainError(f"{what} {path} is no raster: it begins with {head[:8]!r}, as none of {known} does")
    if driver == "VRT":
        check_bytes(path, FileKind.VIRTUAL_RASTER)
    return driver


def _check_size(dataset: Any, what: str) -> None:
    """Refuse what would not fit, before a pixel is read: a file of a megabyte can promise any number of them."""
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
    """An uncompressed file must be as long as its header says: a header can promise 20 GB."""
    if dataset.driver != "GTiff" or dataset.compression is not None:
        return
    promised = dataset.width * dataset.height * sum(np.dtype(dtype).itemsize for dtype in dataset.dtypes)
    sparse = dataset.tags(ns="IMAGE_STRUCTURE").get("SPARSE_OK")
    if path.stat().st_size < promised and not sparse:
        raise TerrainError(
            f"{what} {path} is truncated: its header promises {dataset.height} x {dataset.width} cells,"
            f" {size(promised)}, and it has {size(path.stat().st_size)}; fetch it again"
        )


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
        if dataset.count >= 3:
            raise TerrainError(f"terrain {path} has {dataset.count} bands: a photo? Name it in terrain.photo")
        if np.dtype(dataset.dtypes[0]).kind not in "iuf":
            raise TerrainError(
                f"terrain {path} holds {dataset.dtypes[0]} values; heights are whole or real numbers"
            )
        crs = crs_of(dataset.crs, config.crs, f"terrain {path}")
        grid, target, notes = plan_grid(
            dataset.transform, dataset.height, dataset.width, crs, config.resolution_m, f"terrain {path}"
        )
        factor, offset = float(dataset.scales[0] or 1.0), float(dataset.offsets[0] or 0.0)
        if (factor, offset) != (1.0, 0.0):
            notes.append(
                f"heights are stored as {dataset.dtypes[0]}; scale {factor:g} and offset {offset:g} applied"
            )
        unit = (dataset.units[0] or "").lower()
        if unit in _FEET:
            factor, offset = factor * _FEET[unit], offset * _FEET[unit]
            notes.append("heights are in feet, put into metres")
        if config.height_scale is not None:
            factor, offset = factor * config.height_scale, offset * config.height_scale
        if dataset.count == 2:
            notes.append("the file has two bands; heights are taken from the first")
        elevation_m = np.empty((grid.rows, grid.cols), np.float32)
        straight = target is None
        for row0, row1 in bands(grid.rows, _READ_ROWS):
            band = elevation_m[row0:row1]
            if straight:
                _read_straight(dataset, row0, row1, band)
            else:
                _read_warped(dataset, crs, grid, target, row0, band)
            if (factor, offset) != (1.0, 0.0):
                band *= np.float32(factor)
                band += np.float32(offset)
            progress("reading heights", row1 / grid.rows)
    return Raster(grid, elevation_m, tuple(notes))


def _read_straight(dataset: Any, row0: int, row1: int, band: Floats) -> None:
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


def _read_warped(dataset: Any, crs: Any, grid: GridSpec, target: Any, row0: int, band: Floats) -> None:
    import rasterio
    from rasterio.transform import from_origin
    from rasterio.warp import reproject

    nodata = dataset.nodata
    if nodata is None and np.dtype(dataset.dtypes[0]).kind == "f":
        nodata = math.nan
    north = grid.north_m - row0 * grid.resolution_m
    reproject(
        rasterio.band(dataset, 1),
        band,
        src_crs=crs,
        src_nodata=nodata,
        dst_crs=target,
        dst_transform=from_origin(grid.west_m, north, grid.resolution_m, grid.resolution_m),
        dst_nodata=math.nan,
        resampling=resampling(dataset, crs, grid, target),
        num_threads=os.cpu_count() or 1,
    )


def resampling(dataset: Any, crs: Any, grid: GridSpec, target: Any) -> Any:
    """rasterio's `average` where the grid is at least half as coarse again as the file, `bilinear` else."""
    from rasterio.warp import Resampling

    width, height = _pixel_m(dataset.transform, dataset.height, dataset.width, crs, target)
    return Resampling.average if grid.resolution_m >= 1.5 * max(width, height) else Resampling.bilinear


# --- coordinate systems and grids ---------------------------------------------------------------------------


def crs_of(found: Any, given: str | None, what: str) -> Any:
    """The coordinate system that the scenario names for a file (`given`), else the file's own (`found`).

    Raises TerrainError if `given` is not one, or if there is neither; `what` names the file.
    """
    import rasterio
    from rasterio.errors import CRSError

    if given is not None:
        try:
            return rasterio.CRS.from_user_input(given)
        except (CRSError, ValueError) as error:
            raise TerrainError(
                f"terrain.crs {given!r} is no coordinate system; write EPSG:32632 or alike"
            ) from error
    if not found:
        raise TerrainError(
            f"{what} does not say in which coordinate system it is; set terrain.crs, for example 'EPSG:32632'"
        )
    return found


def metric_crs(crs: Any, lon_deg: float, lat_deg: float, lat_span_deg: float) -> Any:
    """The same system if its unit is a true metre, else a local one: equidistant cylindrical while its scale is
    right within 1 % (no voids at the corners), transverse Mercator beyond.

    `lon_deg`, `lat_deg` are the middle of the terrain; `lat_span_deg` is its extent from south to north.
    """
    import rasterio

    if crs.is_projected and crs.to_dict().get("proj", "") not in ("merc", "webmerc"):
        _, metres = crs.linear_units_factor
        if abs(metres - 1.0) < 1e-9:
            return crs
    stretch = math.radians(lat_span_deg / 2) * abs(math.tan(math.radians(lat_deg)))
    if crs.is_geographic and stretch < 0.01:
        text = f"+proj=eqc +lat_ts={lat_deg:.6f} +lon_0={lon_deg:.6f} +datum=WGS84 +units=m +no_defs"
    else:
        text = f"+proj=tmerc +lat_0={lat_deg:.6f} +lon_0={lon_deg:.6f} +datum=WGS84 +units=m +no_defs"
    return rasterio.CRS.from_proj4(text)


def crs_name(crs: Any) -> str:
    """Of a rasterio CRS, for people: EPSG:32632, or +proj=..., or the beginning of what it is."""
    text: str = crs.to_string()
    if not text.startswith("EPSG:") and crs.to_epsg() is None:
        known = crs.to_dict()
        if known.get("proj"):
            text = " ".join(f"+{key}={known[key]}" for key in ("proj", *_SHOWN) if known.get(key))
    return text if len(text) < 60 else text[:57] + "..."


def _placed(transform: Any, at_row: NDArray[Any], at_col: NDArray[Any]) -> tuple[list[float], list[float]]:
    xs = transform.a * at_col + transform.b * at_row + transform.c
    ys = transform.d * at_col + transform.e * at_row + transform.f
    return [float(x) for x in xs], [float(y) for y in ys]


def _border(transform: Any, rows: int, cols: int) -> tuple[list[float], list[float]]:
    """Points all around a raster, in its own coordinates."""
    along = np.linspace(0.0, 1.0, 21)
    zero, one = np.zeros(21), np.ones(21)
    at_col = np.concatenate([along, one, along, zero]) * cols
    at_row = np.concatenate([zero, along, one, along]) * rows
    return _placed(transform, at_row, at_col)


def bounds_in(transform: Any, rows: int, cols: int, crs: Any, target: Any, what: str) -> tuple[float, ...]:
    """(west, south, east, north) of a raster of rows x cols, in units of the system `target`.

    Raises TerrainError if `crs` is not defined everywhere on its border.
    """
    from rasterio.warp import transform as to_crs

    xs, ys = _border(transform, rows, cols)
    if target != crs:
        xs, ys = to_crs(crs, target, xs, ys)
    if not np.isfinite([xs, ys]).all():
        raise TerrainError(f"{what} reaches where its coordinate system {crs_name(crs)} is not defined; crop it")
    return min(xs), min(ys), max(xs), max(ys)


def _pixel_m(transform: Any, rows: int, cols: int, crs: Any, target: Any) -> tuple[float, float]:
    """Width and height in metres of the pixel in the middle."""
    from rasterio.warp import transform as to_crs

    at_row, at_col = np.array([0.0, 0.0, 1.0]) + rows / 2, np.array([0.0, 1.0, 0.0]) + cols / 2
    xs, ys = _placed(transform, at_row, at_col)
    if target is not None and target != crs:
        xs, ys = to_crs(crs, target, xs, ys)
    return math.hypot(xs[1] - xs[0], ys[1] - ys[0]), math.hypot(xs[2] - xs[0], ys[2] - ys[0])


def plan_grid(
    transform: Any, rows: int, cols: int, crs: Any, resolution_m: float | None, what: str
) -> tuple[GridSpec, Any, list[str]]:
    """The grid for a raster: metric, north-up, with square cells.

    Parameters
    ----------
    transform, rows, cols, crs
        Of the raster, as rasterio gives them.
    resolution_m : float or None
        Side of a cell; None keeps that of the raster.
    what : str
        Names the raster in errors.

    Returns
    -------
    grid : GridSpec
    target : rasterio.CRS or None
        What to warp to; None if the raster has that grid already.
    notes : list of str
        What is done, for people.

    Raises
    ------
    TerrainError
        If the georeference is damaged, has neither metres nor degrees, is too near a pole or too wide for one flat
        grid; if no cell fits, or more than `MAX_CELLS` do.
    """
    import rasterio

    if transform.determinant == 0 or not np.isfinite(list(transform)[:6]).all():
        raise TerrainError(
            f"{what} has pixels without a size ({tuple(transform)[:6]}); its georeference is damaged"
        )
    if not crs.is_geographic and not crs.is_projected:
        raise TerrainError(
            f"{what} is in a coordinate system without metres or degrees ({crs_name(crs)});"
            " reproject it (gdalwarp -t_srs EPSG:...) or set terrain.crs"
        )
    degrees = rasterio.CRS.from_epsg(4326)
    west, south, east, north = bounds_in(transform, rows, cols, crs, degrees, what)
    if crs.is_geographic and not -90.000001 <= south <= north <= 90.000001:
        raise TerrainError(f"{what} reaches from latitude {south:.4g} to {north:.4g}; its georeference is damaged")
    if crs.is_geographic and not abs(south + north) / 2 < HIGHEST_DEG:
        raise TerrainError(
            f"{what} lies around latitude {(south + north) / 2:.4g}, where degrees of longitude have no width;"
            " reproject it to a polar system (gdalwarp -t_srs EPSG:3413, in the south EPSG:3031)"
        )
    target = metric_crs(crs, (west + east) / 2, (south + north) / 2, north - south)
    if (
        target != crs
        and max(north - south, (east - west) * math.cos(math.radians((south + north) / 2))) > MAX_SPAN_DEG
    ):
        raise TerrainError(
            f"{what} spans {north - south:.4g} x {east - west:.4g} degrees: no flat grid is true over more than"
            f" {MAX_SPAN_DEG:g}; crop it, or reproject it to metres yourself"
        )
    width, height = _pixel_m(transform, rows, cols, crs, target)
    notes = [f"{rows} x {cols} pixels of {width:.4g} x {height:.4g} m in {crs_name(crs)}"]
    north_up = transform.b == transform.d == 0 and transform.a > 0 > transform.e
    if not north_up:
        notes.append("the file is rotated or upside down; resampled north-up, so that its corners may be voids")
    square = abs(width - height) < 1e-6 * width
    if target == crs and north_up and square and (resolution_m is None or abs(resolution_m - width) < 1e-6 * width):
        check_size(rows, cols, what)
        grid = GridSpec(rows, cols, float(transform.a), float(transform.c), float(transform.f), crs.to_string())
        return grid, None, notes
    resolution = resolution_m or float(f"{math.sqrt(width * height):.4g}")
    west, south, east, north = bounds_in(transform, rows, cols, crs, target, what)
    high, wide = int((north - south) / resolution + 1e-6), int((east - west) / resolution + 1e-6)
    if high < 1 or wide < 1:
        raise TerrainError(
            f"{what} is {north - south:.3g} m x {east - west:.3g} m: no cell of {resolution:g} m fits"
        )
    check_size(high, wide, what)
    notes.append(f"resampled to {high} x {wide} cells of {resolution:g} m in {crs_name(target)}")
    return GridSpec(high, wide, resolution, west, north, target.to_string()), target, notes


def check_size(rows: int, cols: int, what: str) -> None:
    """Raises TerrainError if there are more than `MAX_CELLS` cells."""
    if rows * cols > MAX_CELLS:
        at_least = math.sqrt(rows * cols / MAX_CELLS)
        raise TerrainError(
            f"{what} would be {rows} x {cols} cells, more than {MAX_CELLS}: crop it, or set a terrain.resolution_m"
            f" that is at least {at_least:.1f} times coarser"
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
