"""Land-cover maps: a raster of class codes, or an image in a legend's colours, put on the terrain's grid.

Codes are never interpolated: a cell takes the nearest code, or the most frequent one where cells grow.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.cover.cover_codes import HIGHEST_CODE, NOTHING, CoverTable, joined, some
from shared_map.importers.cover.cover_meaning import Meaning, meaning_of, why_unknown
from shared_map.importers.onto_grid import place_on
from shared_map.importers.raster_files import READ_ROWS, opened
from shared_map.importers.sources import Source
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.row_bands import Progress, bands, no_progress
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec

_TOLD_CODES = 6
"""Codes that the note names, the most frequent first: a sentence of some 300 characters. Codes listed in a note,
which states how many more there are."""
_NO_CODE = -1
"""Below every code: cells that the file does not reach."""


@dataclass(frozen=True, eq=False)
class Cover:
    """Land cover of the terrain.

    classes  uint8 (rows, cols), TerrainClass
    factor   float32 (rows, cols), pace relative to open ground beside that of the class; inf is lethal
    known    bool (rows, cols): where it says anything
    notes    the file and how it was read, for people
    """

    classes: Bytes
    factor: Floats
    known: Bools
    notes: tuple[str, ...]


def with_cover(source: Source, config: TerrainConfig, progress: Progress) -> Source:
    """The source with the classes of `terrain.cover`: they win over the photo's, but for its roads, which maps of
    land cover lack, and over level ground."""
    if config.cover is None:
        return source
    cover = read_cover(Path(config.cover), source.grid, config, progress)
    known = cover.known & (source.classes != TerrainClass.ROAD)
    wet = known & (source.classes == TerrainClass.WATER) & (cover.classes != TerrainClass.WATER)
    wet &= np.isfinite(cover.factor)
    notes = [*source.notes, *cover.notes]
    if wet.any():
        share = f"{wet.mean():.1%} of the terrain is water by photo or heights and ground by the land cover"
        notes.append(
            f"{share}, which counts; where it is too coarse for a lake, paint a forbidden zone (cost.zones)"
        )
    factor = np.where(known, cover.factor, np.float32(1))
    if source.factor is not None:
        factor *= source.factor
    return replace(
        source, classes=np.where(known, cover.classes, source.classes), factor=factor, notes=tuple(notes)
    )


def read_cover(path: Path, grid: GridSpec, config: TerrainConfig, progress: Progress = no_progress) -> Cover:
    """A land-cover map on the terrain's grid.

    Parameters
    ----------
    path : Path
        One band of whole numbers, or an image in the colours of a built-in table's legend.
    grid : GridSpec
        Of the terrain.
    config : TerrainConfig
        `cover_codes`, `cover_classes` and `crs` count.
    progress : callable
        Called with the current step and the share of it that is done.

    Raises
    ------
    TerrainError
        If the file cannot be read, holds no codes, has no place in common with the terrain, or if its table is
        unknown or one of several: then it names the setting that answers.
    """
    what = f"land cover {path}"
    with opened(path, "land cover") as dataset:
        meaning = meaning_of(dataset, what, config)
        if meaning is None:
            raise TerrainError(why_unknown(dataset, what))
        placed = place_on(dataset, grid, config.crs, what)
        notes, how = [], "mode" if placed.target is not None and placed.grows else "nearest"
        if placed.target is not None:
            taken, size = {"mode": "most frequent"}.get(how, how), f"{dataset.height} x {dataset.width} pixels"
            notes.append(f"land cover: {size}, each cell takes the {taken} code")
        if placed.share < 0.999:
            notes.append(f"the land cover's frame covers {placed.share:.1%} of the terrain")

        def codes_of(row0: int, row1: int) -> NDArray[Any]:
            if placed.target is None:
                return _codes(dataset, meaning, row0, row1) if stored is None else stored[row0:row1]
            codes = np.full((row1 - row0, grid.cols), _NO_CODE, np.int32)
            nodata = dataset.nodata if stored is None else NOTHING
            source = 1 if stored is None else stored
            return placed.warp(source, codes, how, row0, src_nodata=nodata, dst_nodata=_NO_CODE)

        stored = _codes_in_memory(dataset, meaning)
        kinds, factors, states = _look_up(meaning.table)
        classes, factor = np.empty(grid.shape, np.uint8), np.empty(grid.shape, np.float32)
        known = np.empty(grid.shape, np.bool_)
        cells = np.zeros(HIGHEST_CODE + 3, np.int64)
        for row0, row1 in bands(grid.rows, READ_ROWS):
            at = _entries(codes_of(row0, row1))
            classes[row0:row1], factor[row0:row1], known[row0:row1] = kinds[at], factors[at], states[at] == 0
            cells += np.bincount(at.reshape(-1), minlength=len(cells))
            progress("reading land cover", row1 / grid.rows)
        return Cover(classes, factor, known, (*notes, *_told(what, meaning, cells, states)))


_STRANGE, _EMPTY = HIGHEST_CODE + 1, HIGHEST_CODE + 2
"""Rows of the look-up after those of all codes."""


def _entries(codes: NDArray[Any]) -> NDArray[np.intp]:
    """Returns the table index of each value: a code at itself, an unknown code at _STRANGE, no data at _EMPTY."""
    with np.errstate(invalid="ignore"):
        empty = ~(codes >= 0) | (codes == NOTHING) | (codes == np.inf)
        strange = ~empty & (codes > HIGHEST_CODE)
        at: NDArray[np.intp] = np.where(empty | strange, 0, codes).astype(np.intp)
    at[strange], at[empty] = _STRANGE, _EMPTY
    return at


def _look_up(table: CoverTable) -> tuple[Bytes, Floats, Bytes]:
    """Class, factor and state of each entry: 0 known, 1 a code that the table lacks, 2 no data."""
    kinds = np.zeros(HIGHEST_CODE + 3, np.uint8)
    factors = np.ones(HIGHEST_CODE + 3, np.float32)
    states = np.ones(HIGHEST_CODE + 3, np.uint8)
    for code, ground in table.grounds.items():
        if code <= HIGHEST_CODE:
            kinds[code], factors[code], states[code] = ground.kind, ground.factor, 0
    states[[code for code in table.nothing if code <= HIGHEST_CODE] + [_EMPTY]] = 2
    return kinds, factors, states


def _codes_in_memory(dataset: Any, meaning: Meaning) -> NDArray[Any] | None:
    """Returns the codes of the whole file, if GDAL cannot warp it as stored: colours, and cells that a mask
    hides."""
    from rasterio.enums import MaskFlags

    hidden = MaskFlags.per_dataset in dataset.mask_flag_enums[0]
    if meaning.codes is None and not hidden:
        return None
    if dataset.height * dataset.width > MAX_CELLS:
        raise TerrainError(
            f"land cover {dataset.name} has colours or a mask and is too large to look through: crop it"
        )
    codes = np.empty((dataset.height, dataset.width), np.uint16)
    for row0, row1 in bands(dataset.height, READ_ROWS):
        found = _codes(dataset, meaning, row0, row1)
        codes[row0:row1] = np.where((found >= 0) & (found <= NOTHING), found, NOTHING)
    return codes


def _codes(dataset: Any, meaning: Meaning, row0: int, row1: int) -> NDArray[Any]:
    """Codes of some rows of a file; what it does not show is NOTHING."""
    from rasterio.windows import Window

    window = Window(0, row0, dataset.width, row1 - row0)
    if dataset.count >= 3:
        assert meaning.codes is not None
        codes = meaning.codes[joined(dataset.read((1, 2, 3), window=window))].astype(np.float64)
        codes[dataset.dataset_mask(window=window) == 0] = NOTHING
        return codes
    codes = np.asarray(dataset.read(1, window=window), np.float64).copy()
    shown = dataset.read_masks(1, window=window) > 0
    if meaning.codes is not None:
        codes = meaning.codes[np.clip(codes, 0, len(meaning.codes) - 1).astype(np.intp)].astype(np.float64)
    codes[~shown] = NOTHING
    return codes


def _told(what: str, meaning: Meaning, cells: NDArray[np.int64], states: Bytes) -> Iterable[str]:
    """Returns notes for people: the table, the codes that it has and those that it lacks, cells without any.

    Raises TerrainError if the table has none of the codes: then it is that of another map.
    """
    total, table = int(cells.sum()), meaning.table
    there = np.flatnonzero(cells)
    strange = [code for code in there.tolist() if states[code] == 1]
    if strange and not cells[states == 0].any():
        raise TerrainError(
            f"{what}: none of its codes on the terrain ({some(strange)}) is in the table, {table.title};"
            " terrain.cover_codes names another"
        )
    most = sorted((code for code in there.tolist() if states[code] == 0), key=lambda code: -cells[code])
    listed = [
        f"{code} {table.grounds[code].name} {cells[code] / total:.1%} ({table.grounds[code].shown})".replace(
            "  ", " "
        )
        for code in most[:_TOLD_CODES]
    ]
    more = f" and {len(most) - _TOLD_CODES} more" if len(most) > _TOLD_CODES else ""
    yield f"land cover: {table.title}, {meaning.how}: {', '.join(listed) or 'none of its codes'}{more}"
    if strange:
        share = cells[strange].sum() / total
        codes = [code for code in strange if code <= HIGHEST_CODE]
        above = f"codes above {HIGHEST_CODE}" if meaning.codes is None else "colours that its legend lacks"
        yield (
            f"land cover: {f'codes {some(codes)}' if codes else above} on {share:.1%} of the terrain are not in the"
            " table and count as unknown ground; terrain.cover_classes says what they are"
        )
    empty = cells[states == 2].sum() / total
    if empty:
        yield (
            f"land cover: no data on {empty:.1%} of the terrain, where photo and heights say what it is, else open"
            " ground"
        )
