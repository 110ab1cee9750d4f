"""Land-cover maps: a raster of class codes, or an image in a legend's colours, put on the terrain's grid.

Codes are never interpolated: a cell takes the nearest code, or the most frequent one where cells grow.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.cover.cover_codes import HIGHEST_CODE, NOTHING, CoverTable, joined, some
from shared_map.importers.cover.cover_meaning import Meaning, meaning_of, why_unknown
from shared_map.importers.onto_grid import place_on
from shared_map.importers.raster_files import READ_ROWS, Numbers, in_memory, opened
from shared_map.importers.sources import Source
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.row_bands import Progress, bands, no_progress
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec

_TOLD_CODES = 6
"""Codes that the note names, the most frequent first: a sentence of some 300 characters. Codes listed in a note,
which states how many more there are."""


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
    with opened(path, "land cover") as dataset, ExitStack() as files:
        meaning = meaning_of(dataset, what, config)
        if meaning is None:
            raise TerrainError(why_unknown(dataset, what))
        if meaning.codes is not None:
            codes = _decoded(dataset, meaning.codes, what)
            dataset = in_memory(Numbers(codes, dataset.transform, dataset.crs), files)
        placed = place_on(dataset, grid, None if dataset.crs else config.crs, what)
        notes, how = [], "mode" if placed.grows else "nearest"
        if not placed.is_cells:
            taken, size = {"mode": "most frequent"}.get(how, how), f"{dataset.height} x {dataset.width} pixels"
            notes.append(f"land cover: {size}, each cell takes the {taken} code")
        if placed.share < 0.999:
            notes.append(f"the land cover's frame covers {placed.share:.1%} of the terrain")
        kinds, factors, states = _look_up(meaning.table)
        classes, factor = np.empty(grid.shape, np.uint8), np.empty(grid.shape, np.float32)
        known = np.empty(grid.shape, np.bool_)
        counts = np.zeros(HIGHEST_CODE + 3, np.int64)
        with placed.on_grid(how) as cells:
            for row0, row1 in bands(grid.rows, READ_ROWS):
                at = _entries(cells.read(1, window=((row0, row1), (0, grid.cols))))
                classes[row0:row1], factor[row0:row1], known[row0:row1] = kinds[at], factors[at], states[at] == 0
                counts += np.bincount(at.reshape(-1), minlength=len(counts))
                progress("reading land cover", row1 / grid.rows)
        return Cover(classes, factor, known, (*notes, *_told(what, meaning, counts, states)))


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


def _decoded(dataset: Any, codes: NDArray[np.uint16], what: str) -> Floats:
    """The code of each pixel of a drawing, NaN where it shows nothing: GDAL would mix its colours."""
    if dataset.height * dataset.width > MAX_CELLS:
        raise TerrainError(f"{what} has colours and is too large to look through: crop it")
    found = np.empty((dataset.height, dataset.width), np.float32)
    for row0, row1 in bands(dataset.height, READ_ROWS):
        window = ((row0, row1), (0, dataset.width))
        stored = (
            joined(dataset.read((1, 2, 3), window=window)) if dataset.count >= 3 else dataset.read(1, window=window)
        )
        found[row0:row1] = codes[np.clip(stored, 0, len(codes) - 1).astype(np.intp)]
        found[row0:row1][dataset.dataset_mask(window=window) == 0] = np.nan
    return found


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
