"""A raster that is named as a terrain: what it holds, and its heights brought onto one square metric grid.

Heights that are stored as colours, Terrain-RGB and Terrarium, are decoded before anything is interpolated: between
two colours lies no height, as one step of red is 6,553.6 m in the one and 256 m in the other.

Its numbers may be heights, codes of land cover, or colours that stand for heights. rasterio is imported where it is
used: agents never need it.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.transform import Affine, from_origin

from shared_map.array_files import Floats
from shared_map.importers.cover import land_cover
from shared_map.importers.cover.cover_codes import TABLES, legend_of, some
from shared_map.importers.georeference import METRES, check_metres, crs_of, overruled, plan_grid
from shared_map.importers.level_ground import MOST_SAMPLED, looked_at, without
from shared_map.importers.onto_grid import Placed
from shared_map.importers.raster_files import NOTES, READ_ROWS, Numbers, in_memory, middle_of, opened, sampled
from shared_map.importers.sources import Source
from shared_map.terrain.row_bands import Progress, bands
from swarm.config.ground import TerrainConfig
from swarm.config.input_files import size
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS

UNITS_M = tomllib.loads((Path(__file__).parent / "units.toml").read_text(encoding="utf-8"))
"""Names of units in files, as `_scale_of` leaves them -> metres."""
Encoding = Literal["terrain-rgb", "terrarium"]
ENCODINGS: tuple[Encoding, ...] = ("terrain-rgb", "terrarium")
TITLES = {"terrain-rgb": "Terrain-RGB", "terrarium": "Terrarium"}

_LOWEST_M, _HIGHEST_M = -11_500.0, 9_500.0
_RED_M = {"terrain-rgb": 6553.6, "terrarium": 256.0}
"""Height of one step of red (m)."""
_MOST_TORN = 0.7
"""Share of the steps of red. In a photo nearly all are tears, as green follows red; in heights few are."""
_MOST_ROUGH = 0.5
_MOST_SIDE = 1024
_MOST_CELLS = 1 << 26
"""All are decoded at once. Tiles have 256 or 512 cells a side; a mosaic of this width has 32 of them."""
_HALF_WORLD_M = math.pi * 6_378_137.0
"""Half of the side of the web's map, EPSG:3857."""
_DEEPEST_ZOOM = 24
"""A tile of this zoom is 2.4 m wide, and a pixel of it 9 mm: no map is finer, so a larger number is none of a
tile."""
_MOST_CODES, _LEAST_CODES = 256, 3
"""Different values of a map of codes: as many as a byte has; and with fewer than three a height model in whole
metres holds codes of a table by chance (docs/design/terrain-import.md)."""
_LOOK_CELLS = 128
"""Side of the sample that is examined first: most height models are ruled out by 16,384 heights."""


def read_raster(path: Path, config: TerrainConfig, progress: Progress) -> Source:
    """Reads a raster: heights, or the classes of a land-cover map on flat ground.

    Raises TerrainError if it cannot be read, may be one or the other, or does not fit a grid (see `plan_grid`).
    """
    what = f"terrain {path}"
    with opened(path, "terrain") as dataset, ExitStack() as files:
        holds = contents_of(dataset, what, config)
        place = _place_of(dataset, path, config, holds)
        if holds.is_cover:
            return _level_cover(dataset, place, path, config, progress)
        notes = [str(path), *place.notes]
        if holds.encoding is not None:
            notes.insert(1, f"heights are stored as colours, {TITLES[holds.encoding]}, {holds.how}")
            heights, told = heights_decoded(dataset, holds.encoding, path)
            dataset = in_memory(Numbers(heights, place.transform, place.crs), files)
            notes += told
        return _heights(dataset, place, notes, config, progress, files)


def _level_cover(dataset: Any, place: _Place, path: Path, config: TerrainConfig, progress: Progress) -> Source:
    grid, _, notes = plan_grid(
        place.transform, dataset.height, dataset.width, place.crs, config.resolution_m, f"terrain {path}"
    )
    cover = land_cover.read_cover(path, grid, config, progress)
    level = np.zeros((grid.rows, grid.cols), np.float32)
    alone = "there are no heights: the land cover lies on level ground, and slopes cost nothing"
    told = (str(path), *place.notes, *notes, *cover.notes, alone)
    return Source(grid, level, cover.classes, factor=cover.factor, notes=told)


# --- what it holds ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Contents:
    """Kind of a raster's content.

    is_cover  codes of land cover, or a drawing of them
    encoding  how heights are stored as colours; None where numbers are heights
    how       how that is known, for people; empty where it goes without saying
    """

    is_cover: bool = False
    encoding: Encoding | None = None
    how: str = ""


def contents_of(dataset: Any, what: str, config: TerrainConfig) -> Contents:
    """Returns the kind of a raster's content, by the scenario or else by its values.

    Raises TerrainError that names the setting which answers, if it may be one or the other.
    """
    said = config.elevation_encoding
    if said is not None:
        how = f"as terrain.elevation_encoding = {said!r} says"
        return Contents() if said == "metres" else Contents(encoding=said, how=how)
    if config.cover is None and (config.cover_codes is not None or config.cover_classes):
        return Contents(is_cover=True)
    return _of_colours(dataset, what) if dataset.count >= 3 else _of_numbers(dataset, what, config)


def _of_colours(dataset: Any, what: str) -> Contents:
    if dataset.dtypes[0] != "uint8":
        found = f"{dataset.count} bands of {dataset.dtypes[0]}, expected one of heights"
        raise TerrainError(f"{what} has {found}: gdal_translate -b 1 takes it out; a photo goes into terrain.photo")
    fitting = encodings_of(dataset)
    if len(fitting) == 1:
        return Contents(encoding=fitting[0], how="as only so its colours are heights of a landscape")
    settings = " or ".join(f"terrain.elevation_encoding = {encoding!r}" for encoding in TITLES)
    if fitting:
        raise TerrainError(f"{what} may be heights of Terrain-RGB or of Terrarium; set {settings}")
    if legend_of(land_cover.sampled_colours(dataset), what) is not None:
        return Contents(is_cover=True)
    raise TerrainError(
        f"{what} has {dataset.count} bands: a photo? Name it in terrain.photo; of coded heights say {settings}"
    )


def _of_numbers(dataset: Any, what: str, config: TerrainConfig) -> Contents:

    has_palette = dataset.colorinterp[0] == ColorInterp.palette
    # A first look at the middle of a file: most height models are ruled out by it.
    window = middle_of(dataset, _LOOK_CELLS)
    values = dataset.read(1, window=window)[dataset.read_masks(1, window=window) > 0]
    gappy = {key: [*table.grounds, *table.nothing] for key, table in TABLES.items() if table.gappy}
    if not has_palette and not any(np.isin(values, codes).all() for codes in gappy.values()):
        return Contents()
    sample = land_cover.sampled_codes(dataset, what)
    codes = np.unique(sample)
    if not 0 < codes.size <= _MOST_CODES:
        return Contents()
    answers = (
        "terrain.cover_codes = {} if it is land cover, terrain.elevation_encoding = 'metres' if it has heights"
    )
    if has_palette:
        if land_cover.meaning_of(dataset, what, config) is not None:
            return Contents(is_cover=True)
        raise TerrainError(
            f"{what} has a palette, and its codes ({some(codes.tolist())}) are those of no built-in table; set "
            + answers.format("a CSV file of code and class")
        )
    fits = [TABLES[key] for key, known in gappy.items() if np.isin(codes, known).all()]
    if not fits:
        return Contents()
    found = land_cover.evidence_of(dataset, sample)
    if found.names or any(word in found.text for table in fits for word in table.words):
        return Contents(is_cover=land_cover.recognise(found, what) is not None)
    if all(np.isin(codes, list(table.grounds)).sum() < _LEAST_CODES for table in fits):
        return Contents()
    titles = " and of ".join(table.title for table in fits)
    raise TerrainError(
        f"{what} holds nothing but {some(codes.tolist())}, codes of {titles}; set "
        + answers.format(" or ".join(repr(table.key) for table in fits))
    )


# --- where it lies ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Place:
    """Coordinate system and affine transform of a raster, and what people should know of both."""

    crs: Any
    transform: Any
    notes: tuple[str, ...] = ()


def _place_of(dataset: Any, path: Path, config: TerrainConfig, holds: Contents) -> _Place:
    """Returns the georeference of a raster.

    An image without a place lies where its path says if that is the path of a tile of a web map, zoom/x/y.png. Else
    it lies anywhere, in metres, as numbers of our own reading do that have no system.
    """
    what = f"terrain {path}"
    coded = holds.is_cover or holds.encoding is not None
    own = dataset.tags().get(NOTES)
    notes = () if own is None else tuple(own.split("\n"))
    has_place = bool(dataset.crs) or not dataset.transform.is_identity
    if has_place and own is not None and not dataset.crs and config.crs is None:
        check_metres(dataset.transform.a, dataset.transform.c, what)
        notes = (*notes, "x and y are taken for metres of a system without a name; terrain.crs names it")
        return _Place(rasterio.CRS.from_wkt(METRES), dataset.transform, notes)
    if has_place or not (coded or own is not None or path.suffix.lower() == ".png"):
        crs = crs_of(dataset.crs, config.crs, what)
        return _Place(crs, dataset.transform, (*notes, *overruled(dataset.crs, config.crs)))
    tile = re.search(r"(?:^|/)(\d{1,2})/(\d{1,8})/(\d{1,8})(?:@2x)?\.\w+$", path.as_posix())
    if coded and tile is not None and dataset.height == dataset.width and config.crs is None:
        zoom, col, row = (int(number) for number in tile.groups())
        if zoom <= _DEEPEST_ZOOM and max(col, row) < 2**zoom:
            side_m = 2 * _HALF_WORLD_M / 2**zoom
            west, north = -_HALF_WORLD_M + col * side_m, _HALF_WORLD_M - row * side_m
            step_m = side_m / dataset.width
            said = f"placed by its path: tile x {col}, y {row} (from the north) of zoom {zoom} of the web's map"
            return _Place(rasterio.CRS.from_epsg(3857), from_origin(west, north, step_m, step_m), (said,))
    is_grey = not coded and own is None
    if config.resolution_m is None or (is_grey and not config.height_scale):
        scale = " and terrain.height_scale (metres per grey level)" if is_grey else ""
        raise TerrainError(f"{what} does not say how large a cell is; set terrain.resolution_m (metres){scale}")
    anywhere = from_origin(0.0, 0.0, config.resolution_m, config.resolution_m)
    return _Place(rasterio.CRS.from_wkt(METRES), anywhere, notes)


# --- heights ------------------------------------------------------------------------------------------------


def _heights(
    dataset: Any, place: _Place, notes: list[str], config: TerrainConfig, progress: Progress, files: ExitStack
) -> Source:
    """Heights of the first band on a square metric grid, some rows at a time. Bilinear; averaged where cells grow
    by half or more."""
    what = f"terrain {config.source}"
    if dataset.count >= 3:
        raise TerrainError(f"{what} has {dataset.count} bands: a photo? Name it in terrain.photo")
    if np.dtype(dataset.dtypes[0]).kind not in "iuf":
        raise TerrainError(f"{what} holds {dataset.dtypes[0]} values; heights are whole or real numbers")
    shape = dataset.height, dataset.width
    grid, target, planned = plan_grid(place.transform, *shape, place.crs, config.resolution_m, what)
    factor, offset, told = _scale_of(dataset, place.crs, config)
    if dataset.count == 2:
        told.append("the file has two bands; heights are taken from the first")
    some = sampled(dataset, 1, MOST_SAMPLED).astype(np.float32).filled(np.nan)
    voids, found, looks = looked_at(np.where(np.isfinite(some), some, np.float32(np.nan)), config, factor, offset)
    if voids and target is not None:  # GDAL warps one value of no height only; of a second one it would make slopes
        dataset = in_memory(Numbers(_whole(dataset, voids, what), place.transform, place.crs), files)
    placed = Placed(dataset, grid, place.transform, place.crs, target or place.crs, is_cells=target is None)
    stretch = Affine.scale(dataset.width / found.shape[1], dataset.height / found.shape[0])
    flat = in_memory(Numbers(found.astype(np.float32), place.transform @ stretch, place.crs), files)
    with Placed(flat, grid, flat.transform, place.crs, placed.target).on_grid("nearest") as cells:
        level = cells.read(1) > 0
    elevation_m = np.empty(grid.shape, np.float32)
    with placed.on_grid("average" if placed.grows else "bilinear") as cells:
        for row0, row1 in bands(grid.rows, READ_ROWS):
            band = elevation_m[row0:row1]
            band[:] = without(cells.read(1, window=((row0, row1), (0, grid.cols))), voids)
            if (factor, offset) != (1.0, 0.0):
                band *= np.float32(factor)
                band += np.float32(offset)
            progress("reading heights", row1 / grid.rows)
    classes = np.zeros(elevation_m.shape, np.uint8)
    return Source(grid, elevation_m, classes, level=level, notes=(*notes, *planned, *told, *looks))


def _scale_of(dataset: Any, crs: Any, config: TerrainConfig) -> tuple[float, float, list[str]]:
    """Returns (factor, offset) from stored values to metres, and notes for people."""
    notes = []
    factor, offset = float(dataset.scales[0] or 1.0), float(dataset.offsets[0] or 0.0)
    if (factor, offset) != (1.0, 0.0):
        notes.append(f"heights are stored as {dataset.dtypes[0]}; scale {factor:g} and offset {offset:g} applied")
    axes = [
        axis
        for part in crs.to_dict(projjson=True).get("components", [])
        for axis in part["coordinate_system"]["axis"]
    ]
    if any(axis["direction"] == "down" for axis in axes):  # a vertical system such as EPSG:5715
        factor, offset = -factor, -offset
        notes.append("the file states depths; heights are their negatives")
    text = str(dataset.units[0] or "").lower()
    # [m], US_survey_foot and ft (US) without their brackets and signs.
    unit = " ".join("".join(sign if sign.isalnum() else " " for sign in text).split())
    unit_m = UNITS_M.get(unit, 1.0)
    if unit_m != 1.0:
        factor, offset = factor * unit_m, offset * unit_m
        notes.append(f"heights are in {unit}, put into metres")
    elif unit and unit not in UNITS_M and config.height_scale is None:
        notes.append(f"heights are in {unit[:40]!r}, which is unknown, and taken for metres: terrain.height_scale")
    elif not unit and config.height_scale is None and crs.is_projected and crs.linear_units_factor[1] != 1.0:
        name, metres = crs.linear_units_factor
        notes.append(
            f"distances are in {name}, and heights, of which the file says nothing, are taken for metres; if"
            f" they are not, terrain.height_scale = {metres:.6g}"
        )
    scale = 1.0 if config.height_scale is None else config.height_scale
    return factor * scale, offset * scale, notes


def _whole(dataset: Any, voids: Sequence[float], what: str) -> Floats:
    """The whole first band, as stored; NaN where there is no height."""
    if dataset.height * dataset.width > MAX_CELLS:
        raise TerrainError(
            f"{what} has undeclared voids ({', '.join(f'{v:g}' for v in voids)}): gdal_edit.py -a_nodata"
        )
    heights: Floats = dataset.read(1).astype(np.float32)
    heights[dataset.read_masks(1) == 0] = np.nan
    return without(heights, voids)


# --- heights as colours ---------------------------------------------------------------------------------------


def decoded(rgb: NDArray[np.uint8], encoding: Encoding) -> Floats:
    """Heights of colours.

    Parameters
    ----------
    rgb : uint8 (3, rows, cols)
    encoding : str
        terrain-rgb: -10000 + 0.1 (65536 R + 256 G + B); terrarium: 256 R + G + B / 256 - 32768.

    Returns
    -------
    float32 (rows, cols), m
        NaN where the colour is black, which stands for no height in both.
    """
    red, green, blue = rgb.astype(np.int32)
    number = red << 16 | green << 8 | blue
    # Whole numbers below 2**24 are exact in float32, so that each height is rounded once.
    if encoding == "terrain-rgb":
        heights: Floats = (number - 100_000).astype(np.float32) / np.float32(10)
    else:
        heights = (number - (32_768 << 8)).astype(np.float32) / np.float32(256)
    heights[number == 0] = np.nan
    return heights


def is_plausible(rgb: NDArray[np.uint8], shown: NDArray[np.bool_], encoding: Encoding) -> bool:
    """Returns True if colours, decoded, are the heights of a landscape: within those of the Earth, and without a
    tear where red changes by a step, as green and blue make up for it.

    Parameters
    ----------
    rgb : uint8 (3, rows, cols)
        Neighbours as in the file.
    shown : bool (rows, cols)
        Where the image shows anything.
    """
    heights = decoded(rgb, encoding)
    heights[~shown] = np.nan
    known = heights[~np.isnan(heights)]
    if not known.size or known.min() < _LOWEST_M or known.max() > _HIGHEST_M:
        return False
    red = rgb[0].astype(np.int16)
    torn = steps = 0
    rough_m = pairs = 0.0
    for axis in (0, 1):
        rise_m = np.abs(np.diff(heights, axis=axis))
        beside = ~np.isnan(rise_m)
        stepped = beside & (np.diff(red, axis=axis) != 0)
        steps += int(stepped.sum())
        torn += int((rise_m[stepped] > _RED_M[encoding] / 2).sum())
        rough_m += float(rise_m[beside].sum())
        pairs += float(beside.sum())
    # Noise differs from cell to cell by as much as from one end to the other.
    # One colour is no landscape.
    spread_m = float(known.std())
    return spread_m > 0 and torn <= _MOST_TORN * steps and rough_m <= _MOST_ROUGH * spread_m * pairs


def encodings_of(dataset: Any) -> list[Encoding]:
    """The encodings in which an image of three or four bands may be heights: none, one or both."""
    if not _is_colours(dataset):
        return []
    window = middle_of(dataset, _MOST_SIDE)
    rgb = dataset.read((1, 2, 3), window=window)
    shown = dataset.dataset_mask(window=window) > 0
    return [encoding for encoding in ENCODINGS if is_plausible(rgb, shown, encoding)]


def _is_colours(dataset: Any) -> bool:
    return dataset.count in (3, 4) and all(dtype == "uint8" for dtype in dataset.dtypes)


def heights_decoded(dataset: Any, encoding: Encoding, path: Path) -> tuple[Floats, list[str]]:
    """(heights of an image, float32 (rows, cols), m, NaN for none; what people should know of them).

    Raises TerrainError if the image is no such one, too large, or was compressed with loss, which leaves no height
    as it was.
    """
    what = f"terrain {path}"
    if not _is_colours(dataset):
        raise TerrainError(
            f"{what} has {dataset.count} bands of {dataset.dtypes[0]}; {TITLES[encoding]} has three of uint8"
        )
    if _is_lossy(dataset):
        raise TerrainError(
            f"{what} is compressed with loss, which spoils heights stored as colours; fetch it as PNG"
        )
    rows, cols = dataset.height, dataset.width
    if rows * cols > _MOST_CELLS:
        raise TerrainError(f"{what} has {rows} x {cols} pixels, {size(4 * rows * cols)} of heights; crop it")
    heights = np.empty((rows, cols), np.float32)
    for row0, row1 in bands(rows, READ_ROWS):
        window = ((row0, row1), (0, cols))
        heights[row0:row1] = decoded(dataset.read((1, 2, 3), window=window), encoding)
        heights[row0:row1][dataset.dataset_mask(window=window) == 0] = np.nan
    void = float(np.isnan(heights).mean())
    return heights, [f"{void:.1%} of the image is black or transparent: no height"] if void else []


def _is_lossy(dataset: Any) -> bool:
    structure = dataset.tags(ns="IMAGE_STRUCTURE")
    packed = structure.get("COMPRESSION", "").upper()
    return (
        dataset.driver == "JPEG"
        or packed in ("JPEG", "YCBCR JPEG")
        or structure.get("COMPRESSION_REVERSIBILITY", "").upper().startswith("LOSSY")
    )
