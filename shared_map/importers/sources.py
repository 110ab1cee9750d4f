"""Where elevation, photo and classes come from: built-in terrains and files, put on one square metric grid."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from shared_map.arrays import Bools, Floats
from shared_map.importers.ground_cover import classified, with_photo, with_water, without_voids
from shared_map.importers.rasters.degrees import equidistant, metres_per_degree
from shared_map.importers.rasters.raster_kinds import is_raster
from shared_map.importers.source import Source as Source
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.row_bands import Progress, no_progress
from swarm.config.ground import TerrainConfig
from swarm.config.input_files import FileKind, check_bytes
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec

JACKSBORO_RESOLUTION_M = 75.0
JACKSBORO_FILE = "jacksboro_fault_dem.npz"
SYNTHETIC_RESOLUTION_M = 30.0


def load_source(config: TerrainConfig, seed: int, progress: Progress = no_progress) -> Source:
    """Read or make what the scenario names.

    Parameters
    ----------
    config : TerrainConfig
        The section `[terrain]`. Paths are relative to the working folder unless they are absolute.
    seed : int
        Of what is made up, and of learning from labels.
    progress : callable
        Told what is done and how much of it.

    Raises
    ------
    TerrainError
        With one sentence: a file is missing, damaged, of an unknown kind or without heights, a key that it needs is
        not set, photo and terrain do not overlap, or memory does not suffice.
    """
    try:
        return _loaded(config, seed, progress)
    except MemoryError as error:
        raise TerrainError(
            f"terrain {config.source} does not fit into memory; crop it or set a larger terrain.resolution_m"
        ) from error


def _loaded(config: TerrainConfig, seed: int, progress: Progress) -> Source:
    if config.source == "synthetic":
        source = _synthetic(config, seed)
    elif config.source == "jacksboro":
        source = _jacksboro(config, seed)
    else:
        source = _from_file(Path(config.source), config, progress)
    source = without_voids(source, config)
    if config.photo is not None:
        config = _photo_or_cover(config)
    if config.photo is not None:
        source = with_photo(source, Path(config.photo), config, progress)
    if source.photo is not None:
        source = classified(source, config, seed, progress)
    elif config.labels is not None:
        raise TerrainError(f"terrain.labels = {config.labels!r} needs a photo to learn from; set terrain.photo")
    source = with_water(source, config)
    if config.cover is not None:
        from shared_map.importers.cover.land_cover import with_cover

        source = with_cover(source, config, progress)
    return source


def _photo_or_cover(config: TerrainConfig) -> TerrainConfig:
    """The settings with a photo that is a drawn map of land cover named as such."""
    from shared_map.importers.cover.cover_meaning import is_drawn

    if config.photo is None or config.cover is not None or config.labels is not None:
        return config
    return replace(config, photo=None, cover=config.photo) if is_drawn(Path(config.photo), config) else config


# --- built in -----------------------------------------------------------------------------------------------


def _synthetic(config: TerrainConfig, seed: int) -> Source:
    from shared_map.terrain.synthetic.landscape import landscape

    resolution_m = config.resolution_m or SYNTHETIC_RESOLUTION_M
    elevation_m, classes = landscape(config.rows, config.cols, resolution_m, config.relief_m, seed, config.rivers)
    grid = GridSpec(config.rows, config.cols, resolution_m)
    return Source(grid, elevation_m, classes, notes=(f"synthetic landscape, seed {seed}",))


def _jacksboro(config: TerrainConfig, seed: int) -> Source:
    """The elevation model of the Jacksboro fault that comes with matplotlib (USGS, 3 arc seconds)."""
    from shared_map.importers.grids.plain_files import read_npz
    from shared_map.terrain.synthetic.landscape import cover

    plain = read_npz(_jacksboro_path())
    assert plain.heights is not None
    elevation_m, grid, note = _from_degrees(
        plain.heights, plain.step, plain.west, plain.north, config, JACKSBORO_FILE
    )
    classes = cover(elevation_m, grid.resolution_m, seed)
    _, level, told = _looked_at(plain.heights, 1.0, config)
    if config.level_is == "water":
        classes[level[_nearest(level.shape[0], level.shape[1], grid)]] = TerrainClass.WATER
    origin = "Jacksboro fault, Tennessee: USGS 3 arc seconds, public domain, from matplotlib's sample data"
    return Source(grid, elevation_m, classes, notes=(origin, note, *told))


def _jacksboro_path() -> Path:
    # Not matplotlib.cbook.get_sample_data: importing it takes 0.8 s.
    spec = importlib.util.find_spec("matplotlib")
    if spec is None or spec.origin is None:
        raise TerrainError("terrain.source = 'jacksboro' comes with matplotlib, which is not installed")
    path = Path(spec.origin).parent / "mpl-data" / "sample_data" / JACKSBORO_FILE
    if not path.is_file():
        raise TerrainError(f"matplotlib is installed without its sample data: {path} is missing")
    return path


# --- files --------------------------------------------------------------------------------------------------


def _from_file(path: Path, config: TerrainConfig, progress: Progress) -> Source:
    if not path.exists():
        raise TerrainError(f"terrain {path} does not exist: no such file; give one, or jacksboro or synthetic")
    if path.is_dir():
        raise TerrainError(f"terrain {path} is a folder; give a file: {FILE_KINDS}")
    suffix = path.suffix.lower()
    if suffix not in _READERS and not is_raster(path):
        raise TerrainError(f"terrain {path}: {suffix or 'a file without ending'} is unknown; give {FILE_KINDS}")
    return _READERS.get(suffix, _raster)(path, config, progress)


def _raster(path: Path, config: TerrainConfig, progress: Progress) -> Source:
    from shared_map.importers.rasters.coded_rasters import of_other_contents
    from shared_map.importers.rasters.rasters import elevation_of, opened

    _check_hgt(path)
    with opened(path, "terrain") as dataset:
        source = of_other_contents(dataset, path, config, progress)
        if source is not None:
            return source
        raster = elevation_of(dataset, path, config, progress)
    classes = np.zeros(raster.elevation_m.shape, np.uint8)
    return Source(raster.grid, raster.elevation_m, classes, level=raster.level, notes=(str(path), *raster.notes))


def _check_hgt(path: Path) -> None:
    """.hgt has no header: its length is its only description."""
    sides = (1201, 3601)
    length = check_bytes(path, FileKind.VIRTUAL_RASTER if path.suffix.lower() == ".vrt" else FileKind.IMAGE)
    if path.suffix.lower() == ".hgt" and length not in [2 * side * side for side in sides]:
        raise TerrainError(
            f"terrain {path} is truncated or no .hgt: it has {length} bytes; an .hgt of 1201 cells a side has"
            f" {2 * 1201 * 1201}, one of 3601 has {2 * 3601 * 3601}"
        )


def _png(path: Path, config: TerrainConfig, progress: Progress) -> Source:
    """A grey image of heights: needs to be told how many metres a grey level and a cell are."""
    from shared_map.importers.rasters.coded_rasters import of_other_contents
    from shared_map.importers.rasters.georeference import check_size
    from shared_map.importers.rasters.rasters import opened

    with opened(path, "terrain") as dataset:
        source = of_other_contents(dataset, path, config, progress)
        if source is not None:
            return source
        if config.resolution_m is None or config.height_scale is None:
            raise TerrainError(
                f"terrain {path}: an image has no scale; set terrain.resolution_m (metres per pixel) and"
                " terrain.height_scale (metres per grey level)"
            )
        if dataset.count not in (1, 2):
            raise TerrainError(f"terrain {path} has {dataset.count} colour bands; heights are one grey band")
        check_size(dataset.height, dataset.width, f"terrain {path}")
        stored = dataset.read(1).astype(np.float32)
    heights, found, told = _looked_at(stored, config.height_scale, config)
    grid = GridSpec(heights.shape[0], heights.shape[1], config.resolution_m)
    notes = (str(path), f"{config.height_scale:g} m per grey level, {config.resolution_m:g} m per pixel", *told)
    return Source(grid, heights, np.zeros(heights.shape, np.uint8), level=found, notes=notes)


def _looked_at(stored: Floats, scale: float, config: TerrainConfig) -> tuple[Floats, Bools, list[str]]:
    """Heights in metres without undeclared voids, what of them is level, and what people should know of both."""
    from shared_map.importers.water.level_ground import looked_at
    from shared_map.importers.water.voids import without

    voids, level, told = looked_at(stored.astype(np.float32), config, scale)
    return without(stored.astype(np.float32), voids) * np.float32(scale), level, told


def _heights(path: Path, config: TerrainConfig, progress: Progress) -> Source:
    from shared_map.importers.grids.plain_files import read_asc, read_npz
    from shared_map.importers.grids.text_grids import read_text_grid

    suffix = path.suffix.lower()
    read = {".asc": read_asc, ".npz": read_npz}.get(suffix, read_text_grid)
    plain = read(path)
    assert plain.heights is not None
    step, photo = plain.step, plain.photo
    heights, level, told = _looked_at(plain.heights, config.height_scale or 1.0, config)
    if step == (0.0, 0.0):
        if config.resolution_m is None:
            raise TerrainError(f"terrain {path} does not say how large a cell is; set terrain.resolution_m")
        step = (config.resolution_m, config.resolution_m)
    degrees = plain.degrees or _geographic(config.crs)
    if suffix != ".npz" and not degrees and config.crs is None and step[0] < 0.1 and abs(plain.west) <= 180:
        raise TerrainError(
            f"terrain {path}: a cell of {step[0]:g} looks like degrees; set terrain.crs = 'EPSG:4326'"
        )
    if degrees:
        heights, grid, note = _from_degrees(heights, step, plain.west, plain.north, config, str(path))
    else:
        heights, grid, note = _from_metres(heights, step, plain.west, plain.north, config, str(path))
    if photo is not None and photo.shape[:2] != heights.shape:
        photo = photo[_nearest(photo.shape[0], photo.shape[1], grid)]
    classes = np.zeros(heights.shape, np.uint8)
    level = level[_nearest(level.shape[0], level.shape[1], grid)]
    notes = [str(path), *plain.notes, note, *told]
    if read is read_text_grid and plain.step != (0.0, 0.0) and grid.crs == "local":
        notes.append("x and y are taken for metres of a system without a name; terrain.crs names it")
    return Source(grid, heights, classes, photo=photo, level=level, notes=tuple(notes))


def _nearest(rows: int, cols: int, grid: GridSpec) -> tuple[Any, ...]:
    """Which of rows x cols cells over the same ground lie nearest to each cell of a grid."""
    at_row = ((np.arange(grid.rows) + 0.5) * rows / grid.rows).astype(np.intp)
    at_col = ((np.arange(grid.cols) + 0.5) * cols / grid.cols).astype(np.intp)
    return np.ix_(at_row, at_col)


def _geographic(crs: str | None) -> bool:
    if crs is None:
        return False
    from shared_map.importers.rasters.georeference import crs_of

    return bool(crs_of(None, crs, "terrain").is_geographic)


def _map(path: Path, config: TerrainConfig, progress: Progress) -> Source:
    """A map without heights: level, with the pace that the file states."""
    from shared_map.importers.grids.plain_files import read_map, read_ros

    plain = read_map(path) if path.suffix.lower() == ".map" else read_ros(path)
    assert plain.factor is not None
    resolution_m = plain.step[0] or config.resolution_m or 1.0
    if config.resolution_m is not None and abs(config.resolution_m - resolution_m) > 1e-9:
        raise TerrainError(
            f"terrain {path} has cells of {resolution_m:g} m and cannot be resampled without closing gaps;"
            " leave terrain.resolution_m out"
        )
    factor = plain.factor.copy()
    factor[np.isnan(factor)] = 1.0 if config.nodata == "fill" else np.inf
    grid = GridSpec(factor.shape[0], factor.shape[1], resolution_m, plain.west, plain.north)
    level = np.zeros(factor.shape, np.float32)
    notes = (str(path), *plain.notes)
    return Source(grid, level, np.zeros(factor.shape, np.uint8), factor=factor, notes=notes)


_READERS: Mapping[str, Callable[[Path, TerrainConfig, Progress], Source]] = {
    ".tif": _raster,
    ".tiff": _raster,
    ".hgt": _raster,
    ".vrt": _raster,
    ".img": _raster,
    ".bil": _raster,
    ".flt": _raster,
    ".dem": _raster,
    ".nc": _raster,
    ".dt2": _raster,
    ".zip": _raster,
    ".asc": _heights,
    ".npz": _heights,
    ".csv": _heights,
    ".xyz": _heights,
    ".png": _png,
    ".map": _map,
    ".yaml": _map,
    ".yml": _map,
}
"""Ending -> reader. A new kind of file is a row here; a raster of any other name is known by how it begins."""
FILE_KINDS = ", ".join(_READERS)


def is_terrain(path: Path) -> bool:
    """Whether a file is named as one that holds a terrain, or begins as a raster."""
    return path.suffix.lower() in _READERS or is_raster(path)


# --- onto the grid ------------------------------------------------------------------------------------------


def _from_degrees(
    heights: Floats, step: tuple[float, float], west: float, north: float, config: TerrainConfig, what: str
) -> tuple[Floats, GridSpec, str]:
    """Degrees put on metres, equidistant at the mean latitude. Needs no rasterio: the demo builds in a second."""
    middle = north - step[1] * heights.shape[0] / 2
    if not (abs(middle) < 85 and abs(west) <= 360):
        raise TerrainError(f"{what}: its middle is at latitude {middle:g}; degrees must lie between -85 and 85")
    per_lat, per_lon = metres_per_degree(middle)
    crs = equidistant(middle, west)
    metric = (step[0] * per_lon, step[1] * per_lat)
    if what == JACKSBORO_FILE and config.resolution_m is None:
        config = _at(config, JACKSBORO_RESOLUTION_M)
    return _from_metres(heights, metric, 0.0, round(north * per_lat, 3), config, what, crs)


def _at(config: TerrainConfig, resolution_m: float) -> TerrainConfig:
    return replace(config, resolution_m=resolution_m)


def _from_metres(
    heights: Floats,
    step: tuple[float, float],
    west: float,
    north: float,
    config: TerrainConfig,
    what: str,
    crs: str | None = None,
) -> tuple[Floats, GridSpec, str]:
    from shared_map.importers.rasters.resample import resample

    resolution_m = config.resolution_m or float(f"{math.sqrt(step[0] * step[1]):.4g}")
    col_step, row_step = resolution_m / step[0], resolution_m / step[1]
    rows, cols = int(heights.shape[0] / row_step + 1e-6), int(heights.shape[1] / col_step + 1e-6)
    if rows < 1 or cols < 1:
        raise TerrainError(f"terrain.resolution_m = {resolution_m:g} is coarser than the whole of {what}")
    if rows * cols > MAX_CELLS:
        raise TerrainError(f"{what} would be {rows} x {cols} cells; set a larger terrain.resolution_m")
    grid = GridSpec(rows, cols, resolution_m, west, north, crs or config.crs or "local")
    if abs(col_step - 1) < 1e-9 and abs(row_step - 1) < 1e-9:
        return heights, grid, f"{rows} x {cols} cells of {resolution_m:g} m"
    note = f"resampled from {step[1]:.1f} x {step[0]:.1f} m to {resolution_m:g} m"
    return resample(heights, rows, cols, row_step, col_step), grid, note
