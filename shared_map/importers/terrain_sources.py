"""Sources of terrain: built in, or from a file of any kind, put on one square metric grid."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.gdal_rasters import DRIVERS_BY_ENDING, PLAIN, Numbers, is_named, is_raster
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.row_bands import Progress, no_progress
from swarm.config.ground import TerrainConfig
from swarm.config.input_files import FileKind, check_file
from swarm.errors import TerrainError, require
from swarm.grid import GridSpec

if TYPE_CHECKING:
    from shared_map.importers.cover.photos import Photo

JACKSBORO_RESOLUTION_M = 75.0
"""Its heights are 3 arc seconds apart, at 36.6 degrees north 74.5 m from west to east and 92.5 m from north to
south: cells as fine as the closer of the two."""
JACKSBORO_FILE = "jacksboro_fault_dem.npz"
_SOME = 7
"""Every n-th height is shown in an error."""
SYNTHETIC_RESOLUTION_M = 30.0
"""The resolution of the elevation models that cover the world, Copernicus GLO-30 and SRTM."""


@dataclass(frozen=True, eq=False)
class Source:
    """Everything known about the ground on one grid.

    elevation_m  float32 (rows, cols), m; NaN is a void
    classes      uint8 (rows, cols), TerrainClass
    readings     uint8 (rows, cols), possible classes of an unknown cell, bits of `pace_layers.READABLE`; 0 where
                 none is known; None without readings
    photo        the colour photo, uint8 (rows, cols, 3); black where it shows nothing
    factor       float32 (rows, cols), pace relative to open ground that the file itself states; inf is lethal
    level        bool (rows, cols), flat cells of the file, before any resampling; None if not examined
    notes        origin and processing steps, for people
    """

    grid: GridSpec
    elevation_m: Floats
    classes: Bytes
    _: KW_ONLY
    readings: Bytes | None = None
    photo: Bytes | None = None
    factor: Floats | None = None
    level: Bools | None = None
    notes: tuple[str, ...] = ()


def load_source(config: TerrainConfig, seed: int, progress: Progress = no_progress) -> Source:
    """Reads or makes the source that the scenario names.

    Parameters
    ----------
    config : TerrainConfig
        The section `[terrain]`. Paths are relative to the working folder unless they are absolute.
    seed : int
        Of what is made up.
    progress : callable
        Called with the current step and the share of it that is done.

    Raises
    ------
    TerrainError
        With one sentence: a file is missing, damaged, of an unknown kind or without heights, a key that it needs is
        not set, or photo and terrain do not overlap. Also if `source` is no path, as of an array from Python.
    """
    given: object = config.source  # Python's callers may give anything
    if not isinstance(given, str | os.PathLike):
        how = "numpy.savez('heights.npz', elevation=ARRAY, resolution_m=10.0) makes a file of an array"
        raise TerrainError(f"terrain.source is of type {type(given).__name__}, expected a path: {how}")
    if config.source == "synthetic":
        source = _synthetic(config, seed)
    elif config.source == "jacksboro":
        source = _jacksboro(config, seed)
    else:
        from shared_map.importers.height_rasters import read_raster

        path = Path(config.source)
        check_file(path, FileKind.TEXT_GRID)
        source = _map(path, config) if is_named(path, _FLAT_MAPS) else read_raster(path, config, progress)
    source = without_voids(source, config)
    if config.photo is not None:
        from shared_map.importers.cover.photos import read_photo

        photo = read_photo(Path(config.photo), source.grid, config.crs, progress)
        source = with_photo(source, photo, config, progress)
    elif config.labels is not None:
        raise TerrainError(f"terrain.labels = {config.labels!r} needs a photo to learn from; set terrain.photo")
    source = with_water(source, config)
    if config.cover is not None:
        from shared_map.importers.cover.land_cover import with_cover

        source = with_cover(source, Path(config.cover), config, progress)
    return source


# --- built in -----------------------------------------------------------------------------------------------


def _synthetic(config: TerrainConfig, seed: int) -> Source:
    from shared_map.terrain.synthetic import landscape

    resolution_m = config.resolution_m or SYNTHETIC_RESOLUTION_M
    elevation_m, classes = landscape(config.rows, config.cols, resolution_m, config.relief_m, seed, config.rivers)
    grid = GridSpec(config.rows, config.cols, resolution_m)
    return Source(grid, elevation_m, classes, notes=(f"synthetic landscape, seed {seed}",))


def _jacksboro(config: TerrainConfig, seed: int) -> Source:
    """The elevation model of the Jacksboro fault that comes with matplotlib (USGS, 3 arc seconds)."""
    from shared_map.importers.height_rasters import read_raster
    from shared_map.terrain.synthetic import cover

    resolution_m = config.resolution_m or JACKSBORO_RESOLUTION_M
    config = msgspec.structs.replace(config, resolution_m=resolution_m, crs=None)
    source = read_raster(_jacksboro_path(), config, no_progress)
    classes = cover(source.elevation_m, source.grid.resolution_m, seed)
    if config.level_is == "water":
        classes[source.level] = TerrainClass.WATER
    origin = "Jacksboro fault, Tennessee: USGS 3 arc seconds, public domain, from matplotlib's sample data"
    return replace(source, classes=classes, level=None, notes=(origin, *source.notes[1:]))


def _jacksboro_path() -> Path:
    # Not matplotlib.cbook.get_sample_data: importing it takes 0.8 s.
    require("terrain.source = 'jacksboro'", "matplotlib")
    spec = importlib.util.find_spec("matplotlib")
    return Path(str(spec and spec.origin)).parent / "mpl-data" / "sample_data" / JACKSBORO_FILE


# --- files --------------------------------------------------------------------------------------------------


def _map(path: Path, config: TerrainConfig) -> Source:
    """A map without heights: level, with the pace that the file states."""
    from rasterio.transform import from_origin

    from shared_map.importers import grids_without_gdal

    found: Numbers = getattr(grids_without_gdal, _FLAT_MAPS[path.suffix.lower()])(path)
    side_m = config.resolution_m or 1.0
    place = found.transform or from_origin(0.0, 0.0, side_m, side_m)
    resolution_m = float(place.a)
    if config.resolution_m is not None and abs(config.resolution_m - resolution_m) > 1e-9:
        raise TerrainError(f"terrain {path}: to resample it would close gaps; leave terrain.resolution_m out")
    factor = found.numbers
    factor[np.isnan(factor)] = 1.0 if config.nodata == "fill" else np.inf
    grid = GridSpec(factor.shape[0], factor.shape[1], resolution_m, place.c, place.f)
    level = np.zeros(factor.shape, np.float32)
    return Source(grid, level, np.zeros(factor.shape, np.uint8), factor=factor, notes=(str(path), *found.notes))


_FLAT_MAPS = {".map": "read_map", ".yaml": "read_ros", ".yml": "read_ros"}
"""Endings of maps without heights -> their reader in `grids_without_gdal`."""
_ENDINGS = (*DRIVERS_BY_ENDING, ".zip", *PLAIN, *_FLAT_MAPS)
"""Endings of terrains; a raster of any other name is known by how it begins."""
FILE_KINDS = ", ".join(_ENDINGS)


def is_terrain(path: Path) -> bool:
    """Returns True if a file is named as one that holds a terrain, or begins as a raster."""
    return path.suffix.lower() in _ENDINGS or is_raster(path)


# --- what covers the ground ---------------------------------------------------------------------------------


def without_voids(source: Source, config: TerrainConfig) -> Source:
    """Voids counted, and filled if asked for; nothing is done in silence."""
    from shared_map.importers.water_and_voids import clear_voids, fill_voids

    elevation_m = np.require(source.elevation_m, requirements="W")
    some_m = elevation_m[::_SOME, ::_SOME].copy()
    count = clear_voids(elevation_m)
    if count == 0:
        return replace(source, elevation_m=elevation_m)
    share = count / elevation_m.size
    if share == 1.0 and np.isfinite(some_m).any():
        found = f"{np.nanmin(some_m):g} to {np.nanmax(some_m):g}"
        how = f"terrain.height_scale ({config.height_scale or 1:g}; of centimetres 0.01) to the metres of its unit"
        raise TerrainError(f"terrain {config.source} has heights of {found} m, expected less than 20 km: set {how}")
    if share == 1.0:
        raise TerrainError(f"terrain {config.source} has no heights at all: every cell is void, NaN or infinite")
    if config.nodata == "fill":
        note = f"{count} voids ({share:.1%}) filled from their surroundings"
        return replace(source, elevation_m=fill_voids(elevation_m), notes=(*source.notes, note))
    hint = "; crop the file, or set terrain.nodata = 'fill'" if share > 0.05 else ""
    note = f"{count} voids ({share:.1%} of the cells) are lethal{hint}"
    return replace(source, elevation_m=elevation_m, notes=(*source.notes, note))


def with_water(source: Source, config: TerrainConfig) -> Source:
    """Flat areas of the file, and cells lower than the scenario's limit, are water unless other evidence
    contradicts."""
    water = np.zeros(source.classes.shape, np.bool_)
    if source.level is not None and config.level_is == "water":
        water |= source.level
    notes = source.notes
    if config.water_below_m is not None:
        with np.errstate(invalid="ignore"):
            low = source.elevation_m < np.float32(config.water_below_m)
        water |= low
        notes = (*notes, f"{low.mean():.1%} of the cells are lower than {config.water_below_m:g} m: water")
    classes = source.classes.copy()
    classes[water & (classes == TerrainClass.UNKNOWN)] = TerrainClass.WATER
    return replace(source, classes=classes, notes=notes)


def with_photo(source: Source, photo: Photo, config: TerrainConfig, progress: Progress) -> Source:
    """The source with a photo, and with the classes that it shows unless it is no true-colour one."""
    from shared_map.importers.cover.classify import class_readings, learnt, read_labels

    inputs = (photo.rgb, source.elevation_m, source.grid.resolution_m)
    classes, readings = source.classes, None
    if config.labels is not None:
        labels = read_labels(Path(config.labels), source.grid)
        classes = learnt(*inputs, labels.classes, progress) * photo.seen
        note = f"classes from the photo, learnt from {labels.count} labels"
    elif photo.other is not None:
        note = (
            f"the photo is {photo.other}; no classes are read from it: give a true-colour one, terrain.labels, or"
            " its codes as terrain.cover"
        )
    else:
        classes, readings = (each * photo.seen for each in class_readings(*inputs, progress))
        doubtful = float((classes[photo.seen] == TerrainClass.UNKNOWN).mean())
        note = (
            f"classes from the photo, by rules; {doubtful:.0%} of what it shows would be another class in a photo"
            " exposed a little differently, is unknown and costs as the costliest of these classes: see"
            " terrain.labels and cost.class_factor.unknown"
        )
    notes = (*source.notes, *photo.notes, note)
    return replace(source, classes=classes, readings=readings, photo=photo.rgb, notes=notes)
