"""A raster that is named as a terrain: what it holds, and its heights brought onto one square metric grid.

Its numbers may be heights, or codes of land cover.
"""

from __future__ import annotations

import re
import tomllib
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine, from_origin

from shared_map.importers.cover import land_cover
from shared_map.importers.cover.land_cover import TABLES, some
from shared_map.importers.gdal_rasters import NOTES, Numbers, in_memory, middle_of, opened, sampled
from shared_map.importers.georeference import METRES, Placed, check_metres, crs_of, overruled, own_system, plan_grid
from shared_map.importers.terrain_sources import Source
from shared_map.importers.water_and_voids import MOST_SAMPLED, examined, voids_as_nan
from shared_map.terrain.row_bands import Progress
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS

_UNITS = tomllib.loads((Path(__file__).parent / "units.toml").read_text(encoding="utf-8"))
UNITS_M = {unit.removesuffix("s"): metres for unit, metres in _UNITS.items()}
"""Names of units in files, as `_scale_of` leaves them -> metres."""
_MOST_CODES, _LEAST_CODES = 256, 3
"""Different values of a map of codes: as many as a byte has; and with fewer than three a height model in whole
metres holds codes of a table by chance (docs/design/terrain-import.md)."""
_SAMPLE_CELLS = 128
"""Side of the sample that is examined first: most height models are ruled out by 16,384 heights."""


def read_raster(path: Path, config: TerrainConfig, progress: Progress) -> Source:
    """Reads a raster: heights, or the classes of a land-cover map on flat ground.

    Raises TerrainError if it cannot be read, if it is unclear which of them it holds, or if it does not
    fit a grid (see `plan_grid`).
    """
    what = f"terrain {path}"
    with opened(path, "terrain") as dataset, ExitStack() as files:
        is_cover = holds_cover(dataset, what, config)
        crs, transform, notes = _place_of(dataset, path, config, is_cover)
        grid, target, planned = plan_grid(transform, dataset.height, dataset.width, crs, config.resolution_m, what)
        placed = Placed(dataset, grid, transform, crs, target or crs, is_cells=target is None)
        notes = (str(path), *notes, *planned)
        if not is_cover:
            return _heights(placed, path, notes, config, progress, files)
        cover = land_cover.read_cover(path, grid, config, progress)
        alone = "there are no heights: the land cover lies on level ground, and slopes cost nothing"
        level = np.zeros(grid.shape, np.float32)
        return Source(grid, level, cover.classes, factor=cover.factor, notes=(*notes, *cover.notes, alone))


# --- what it holds ------------------------------------------------------------------------------------------


def holds_cover(dataset: Any, what: str, config: TerrainConfig) -> bool:
    """Returns True if a raster holds codes of land cover, by the scenario or else by its values.

    Raises TerrainError, which names the setting that decides, if the values may also be heights.
    """
    if dataset.count >= 3:
        found = f"{dataset.count} bands of {dataset.dtypes[0]}, expected one of elevation"
        how = "a photo goes into terrain.photo; gdal_calc.py unpacks heights from colours"
        raise TerrainError(f"{what} has {found}: {how}, gdal_translate -b 1 takes one band out")
    if config.elevation_encoding is not None:
        return False
    if config.cover is None and (config.cover_codes is not None or config.cover_classes):
        return True
    has_palette = dataset.colorinterp[0] == ColorInterp.palette
    # A first look at the middle of a file: most height models are ruled out by it.
    window = middle_of(dataset, _SAMPLE_CELLS)
    values = dataset.read(1, window=window)[dataset.read_masks(1, window=window) > 0]
    gappy = {key: [*table.grounds, *table.nothing] for key, table in TABLES.items() if table.gappy}
    if not has_palette and not any(np.isin(values, codes).all() for codes in gappy.values()):
        return False
    try:
        sample = land_cover.sampled_codes(dataset, what)
    except TerrainError:  # real numbers
        return False
    codes = np.unique(sample)
    if not 0 < codes.size <= _MOST_CODES:
        return False
    answers = "terrain.cover_codes = {} if it is land cover, terrain.elevation_encoding = 'metres' if heights"
    if has_palette:
        if land_cover.meaning_of(dataset, what, config) is not None:
            return True
        raise TerrainError(
            f"{what} has a palette, and its codes ({some(codes.tolist())}) are those of no built-in table; set "
            + answers.format("a CSV file of code and class")
        )
    fits = [TABLES[key] for key, known in gappy.items() if np.isin(codes, known).all()]
    text = land_cover.text_of(dataset)
    if any(word in text for table in fits for word in table.words):
        return land_cover.recognise(dataset, sample, what) is not None
    if all(np.isin(codes, list(table.grounds)).sum() < _LEAST_CODES for table in fits):
        return False
    titles = " and of ".join(table.title for table in fits)
    raise TerrainError(
        f"{what} holds nothing but {some(codes.tolist())}, codes of {titles}; set "
        + answers.format(" or ".join(repr(table.key) for table in fits))
    )


# --- where it lies ------------------------------------------------------------------------------------------


def _place_of(dataset: Any, path: Path, config: TerrainConfig, is_cover: bool) -> tuple[Any, Any, tuple[str, ...]]:
    """Returns the coordinate system of a raster, its affine transform, and what people should know of both.

    An image without a place lies anywhere, in metres, as numbers of our own reading do that have no system.
    """
    what = f"terrain {path}"
    own, system = dataset.tags().get(NOTES), own_system(dataset, what)
    notes = () if own is None else tuple(own.split("\n"))
    has_place, is_grey = not dataset.transform.is_identity, dataset.driver in ("PNG", "BMP") and not is_cover
    needed = {}
    if not has_place and config.resolution_m is None:
        needed["how large a cell is"] = "terrain.resolution_m (metres)"
    if is_grey and config.height_scale is None:
        needed["how high a grey level is"] = "terrain.height_scale (metres per grey level)"
    if needed:
        raise TerrainError(f"{what} does not say {' and '.join(needed)}; set {' and '.join(needed.values())}")
    if has_place:
        if own is not None and not system and config.crs is None:
            check_metres(dataset.transform.a, dataset.transform.c, what)
            notes = (*notes, "x and y are taken for metres of a system without a name; terrain.crs names it")
            return rasterio.CRS.from_wkt(METRES), dataset.transform, notes
        crs = crs_of(system, config.crs, what)
        if crs.is_projected:
            check_metres(dataset.transform.a, dataset.transform.c, what)
        return crs, dataset.transform, (*notes, *overruled(system, config.crs, dataset.transform))
    if system or config.crs not in (None, "local"):
        notes = (*notes, "! the file has a system, but no place in it: x and y count from its north-west corner")
    anywhere = from_origin(0.0, 0.0, config.resolution_m, config.resolution_m)
    return rasterio.CRS.from_wkt(METRES), anywhere, notes


# --- heights ------------------------------------------------------------------------------------------------


def _heights(
    placed: Placed, path: Path, notes: tuple[str, ...], config: TerrainConfig, progress: Progress, files: ExitStack
) -> Source:
    """Heights of the first band on a square metric grid, some rows at a time. Bilinear; averaged where cells grow
    by half or more."""
    dataset, grid = placed.dataset, placed.grid
    factor, offset, scale_notes = _scale_of(dataset, placed.crs, config)
    if dataset.count == 2:
        scale_notes.append("the file has two bands; heights are taken from the first")
    some = sampled(dataset, 1, MOST_SAMPLED).astype(np.float32).filled(np.nan)
    voids, found, looks = examined(np.where(np.isfinite(some), some, np.float32(np.nan)), config, factor, offset)
    if voids and not placed.is_cells:  # of a second value of no height GDAL would make slopes
        if dataset.height * dataset.width > MAX_CELLS:
            listed = ", ".join(f"{void:g}" for void in voids)
            raise TerrainError(f"terrain {path} has undeclared voids {listed}: gdal_edit.py -a_nodata declares one")
        known = np.where(dataset.read_masks(1) > 0, dataset.read(1).astype(np.float32), np.float32(np.nan))
        whole = Numbers(voids_as_nan(known, voids), placed.transform, placed.crs)
        placed = replace(placed, dataset=in_memory(whole, files))
    stretch = placed.transform @ Affine.scale(dataset.width / found.shape[1], dataset.height / found.shape[0])
    flat = in_memory(Numbers(found.astype(np.float32), stretch, placed.crs), files)
    seen = Placed(flat, grid, stretch, placed.crs, placed.target).on_grid("nearest")
    level = np.concatenate([values > 0 for _, values in seen])
    elevation_m = np.empty(grid.shape, np.float32)
    for rows, stored in placed.on_grid("average" if placed.grows else "bilinear", 1, "reading heights", progress):
        elevation_m[rows] = voids_as_nan(stored, voids) * np.float32(factor) + np.float32(offset)
    classes = np.zeros(elevation_m.shape, np.uint8)
    return Source(grid, elevation_m, classes, level=level, notes=(*notes, *scale_notes, *looks))


def _scale_of(dataset: Any, crs: Any, config: TerrainConfig) -> tuple[float, float, list[str]]:
    """Returns (factor, offset) from stored values to metres, and notes for people."""
    notes = []
    factor, offset = float(dataset.scales[0]), float(dataset.offsets[0])
    if (factor, offset) != (1.0, 0.0):
        notes.append(f"heights are stored as {dataset.dtypes[0]}; scale {factor:g} and offset {offset:g} applied")
    parts = crs.to_dict(projjson=True).get("components", [])
    axes = [axis for part in parts for axis in part["coordinate_system"]["axis"]]
    # A vertical system such as EPSG:5715, or a variable of a netCDF.
    if any(axis["direction"] == "down" for axis in axes) or dataset.tags(1).get("positive") == "down":
        factor, offset = -factor, -offset
        notes.append("the file states depths; heights are their negatives")
    text = str(dataset.units[0] or "").lower()
    # [m], US_survey_foot and ft (US) without their brackets and signs.
    unit = re.sub(r"[\W_]+", " ", text).strip().removesuffix("s")
    unit_m = UNITS_M.get(unit, 1.0)
    if unit and unit not in UNITS_M and config.height_scale is None:
        found = f"heights in {text[:40]!r}, an unknown unit"
        raise TerrainError(f"terrain {config.source} has {found}; set terrain.height_scale (metres in one of it)")
    if unit_m != 1.0:
        factor, offset = factor * unit_m, offset * unit_m
        notes.append(f"heights are in {text}, put into metres")
    elif not unit and config.height_scale is None and crs.is_projected and crs.linear_units_factor[1] != 1.0:
        name, metres = crs.linear_units_factor
        notes.append(
            f"distances are in {name}, and heights, of which the file says nothing, are taken for metres; if"
            f" they are not, terrain.height_scale = {metres:.6g}"
        )
    scale = 1.0 if config.height_scale is None else config.height_scale
    return factor * scale, offset * scale, notes
