"""Land-cover maps: a raster of class codes, or an image in a legend's colours, put on the terrain's grid.

Codes are never interpolated: a cell takes the nearest code, or the most frequent one where cells grow.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.cover import cover_codes
from shared_map.importers.cover.cover_codes import HIGHEST_CODE, some
from shared_map.importers.onto_grid import place_on
from shared_map.importers.raster_files import READ_ROWS, Numbers, in_memory, middle_of, opened, sampled
from shared_map.importers.sources import Source
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.row_bands import Progress, bands, no_progress
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec

_LEAST_ALIKE = 0.8
"""Share of a file's codes that must have the colours or the names of a table."""
_LEAST_KNOWN = 0.95
"""Share of a file's cells that must have a code of a table."""
_MOST_XML = 4 << 20
"""GDAL's description of a file: room for a text of 60 bytes, tags included, for each of the 65,534 codes. To parse
so much takes less than 0.1 s."""
_MOST_SAMPLED = 1 << 20
"""Every cell of 1024 x 1024: of a larger file still a hundred of a code that a ten-thousandth of it has."""
_LOOK_CELLS = 256
"""Side of the sample that is examined first, in cells. Among 65,536 pixels a photo has far more than
`cover_codes.MOST_COLOURS`, so it is not read as a whole."""
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


def with_cover(source: Source, path: Path, config: TerrainConfig, progress: Progress) -> Source:
    """The source with the classes of `terrain.cover`: they win over the photo's, but for its roads, which maps of
    land cover lack, and over level ground."""
    cover = read_cover(path, source.grid, config, progress)
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


def _entries(codes: Floats) -> NDArray[np.intp]:
    """The entry of the look-up for each value: a code itself, NO_COLOUR of a larger number, else NOTHING."""
    empty = ~(codes >= 0) | (codes == cover_codes.NOTHING) | (codes == np.inf)
    return np.where(empty, cover_codes.NOTHING, np.minimum(codes, cover_codes.NO_COLOUR)).astype(np.intp)


def _look_up(table: cover_codes.CoverTable) -> tuple[Bytes, Floats, Bytes]:
    """Class, factor and state of each entry: 0 known, 1 a code that the table lacks, 2 no data."""
    kinds = np.zeros(HIGHEST_CODE + 3, np.uint8)
    factors = np.ones(HIGHEST_CODE + 3, np.float32)
    states = np.ones(HIGHEST_CODE + 3, np.uint8)
    for code, ground in table.grounds.items():
        if code <= HIGHEST_CODE:
            kinds[code], factors[code], states[code] = ground.kind, ground.factor, 0
    states[[code for code in table.nothing if code <= HIGHEST_CODE] + [cover_codes.NOTHING]] = 2
    return kinds, factors, states


def _decoded(dataset: Any, codes: NDArray[np.uint16], what: str) -> Floats:
    """The code of each pixel of a drawing, NaN where it shows nothing: GDAL would mix its colours."""
    if dataset.height * dataset.width > MAX_CELLS:
        raise TerrainError(f"{what} has colours and is too large to look through: crop it")
    found = np.empty((dataset.height, dataset.width), np.float32)
    for row0, row1 in bands(dataset.height, READ_ROWS):
        window = ((row0, row1), (0, dataset.width))
        stored = (
            cover_codes.joined(dataset.read((1, 2, 3), window=window))
            if dataset.count >= 3
            else dataset.read(1, window=window)
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
        found = f"none of its codes on the terrain ({some(strange)}) is in the table, {table.title}"
        raise TerrainError(f"{what}: {found}; terrain.cover_codes names another")
    most = sorted((code for code in there.tolist() if states[code] == 0), key=lambda code: -cells[code])
    names = {code: f"{code} {table.grounds[code].name}".strip() for code in most[:_TOLD_CODES]}
    listed = [f"{name} {cells[at] / total:.1%} ({table.grounds[at].shown})" for at, name in names.items()]
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
        yield f"land cover: no data on {empty:.1%} of the terrain, where photo and heights say what it is"


# --- what its values mean ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Meaning:
    """Conversion of a file's values into grounds.

    table  what the codes stand for
    how    how that is known, for people
    codes  code of each colour (`legend_codes`) or of each entry of a palette; None where values are codes
    """

    table: cover_codes.CoverTable
    how: str
    codes: NDArray[np.uint16] | None = None


def meaning_of(dataset: Any, what: str, config: TerrainConfig) -> Meaning | None:
    """Returns how the values of a land-cover file are converted to terrain classes; None if the file gives no hint
    of its code table.

    Raises TerrainError if the values of the file are not codes (whole numbers), if several code tables fit, or if
    it is a coloured image and the configured table has no colours.
    """
    own = cover_codes.own_grounds(config.cover_classes)
    given = None if config.cover_codes is None else cover_codes.table_named(config.cover_codes)
    said = f"as terrain.cover_codes = {config.cover_codes!r} says"
    if dataset.count >= 3:
        how = "drawn in the colours of its legend" if given is None else f"drawn in its colours, {said}"
        table = given or cover_codes.legend_of(sampled_colours(dataset), what)
        if table is None:
            return None
        if not any(ground.colour for ground in table.grounds.values()):
            raise TerrainError(f"{what} has colours, and terrain.cover_codes names a table without; expected codes")
        return Meaning(table.replaced(own), how, cover_codes.legend_codes(table))
    sample = sampled_codes(dataset, what)
    if given is not None:
        return Meaning(given.replaced(own), said)
    only_own = Meaning(cover_codes.CoverTable("own", "codes of one's own", own), "as terrain.cover_classes says")
    if own and set(np.unique(sample).tolist()) <= own.keys() | {0}:
        return only_own
    found = evidence_of(dataset, sample)
    known = recognise(found, what)
    if known is not None:
        return Meaning(known[0].replaced(own), f"known by {known[1]}")
    if found.palette:
        colours = np.zeros(max(found.palette) + 1, np.int32)
        for code, (red, green, blue) in found.palette.items():
            colours[code] = red << 16 | green << 8 | blue
        table = cover_codes.legend_of(colours[sample[sample < len(colours)].astype(np.intp)], what)
        if table is not None:
            how = "its palette has the colours of its legend"
            return Meaning(table.replaced(own), how, cover_codes.legend_codes(table)[colours])
    return only_own if own else None


# --- what a file shows --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Evidence:
    """Evidence in a file for the meaning of its codes.

    counts   cells of each code, of some cells of the file; no-data left out
    palette  colour of each code; empty if it has none
    names    name of each code; empty if it has none
    text     its name, tags and descriptions, in lower case
    """

    counts: Mapping[int, int]
    palette: Mapping[int, cover_codes.Rgb]
    names: Mapping[int, str]
    text: str

    def share(self, codes: Iterable[int]) -> float:
        """Returns the share of the cells that has one of these codes."""
        return sum(self.counts.get(code, 0) for code in codes) / max(sum(self.counts.values()), 1)


def evidence_of(dataset: Any, sample: NDArray[Any]) -> Evidence:
    """Returns the evidence in a file of one band; `sample` has codes of some of its cells, (cells,), no-data left
    out."""
    codes, cells = np.unique(sample, return_counts=True)
    has_palette = dataset.colorinterp[0] == ColorInterp.palette
    palette = {code: colour[:3] for code, colour in dataset.colormap(1).items()} if has_palette else {}
    tags = [f"{key} {value}" for key, value in [*dataset.tags().items(), *dataset.tags(1).items()]]
    words = [Path(str(dataset.name)).name, *tags, *dataset.descriptions[:1]]
    return Evidence(
        dict(zip(codes.astype(int).tolist(), cells.tolist(), strict=True)),
        palette,
        _names(dataset),
        " ".join(str(word)[:2000] for word in words if word).lower(),
    )


def _names(dataset: Any) -> dict[int, str]:
    """Category names. rasterio does not read them; GDAL's description of a file has them."""
    faults = (RasterioError, OSError, ElementTree.ParseError)
    with tempfile.TemporaryDirectory() as folder, suppress(*faults):
        path = Path(folder) / "described.vrt"
        rasterio.shutil.copy(dataset, str(path), driver="VRT")
        if path.stat().st_size < _MOST_XML:
            categories = enumerate(ElementTree.fromstring(path.read_bytes()).iterfind(".//Category"))
            return {code: node.text.strip() for code, node in categories if node.text}
    return {}


def sampled_codes(dataset: Any, what: str) -> NDArray[Any]:
    """Values of some cells, (cells,), as stored, no-data left out. Raises TerrainError if they are not whole."""
    kind = np.dtype(dataset.dtypes[0]).kind
    values = sampled(dataset, 1, _MOST_SAMPLED).compressed()
    if kind == "f":
        values = values[np.isfinite(values)]
    if kind not in "iuf" or (kind == "f" and (values % 1 != 0).any()):
        raise TerrainError(f"{what} holds {'real' if kind == 'f' else dataset.dtypes[0]} numbers; codes are whole")
    return np.asarray(values[values >= 0])


def sampled_colours(dataset: Any) -> NDArray[np.int32]:
    """Returns the colours of some cells of an image, (cells,), red << 16 | green << 8 | blue; masked cells left
    out.

    None of an image that has too many colours for a drawing in its middle: a photo is not read twice.
    """
    none = np.zeros(0, np.int32)
    if any(dtype != "uint8" for dtype in dataset.dtypes[:3]):
        return none
    middle = cover_codes.joined(dataset.read((1, 2, 3), window=middle_of(dataset, _LOOK_CELLS)))
    if np.unique(middle).size > cover_codes.MOST_COLOURS:
        return none
    stored = sampled(dataset, (1, 2, 3), _MOST_SAMPLED)
    return cover_codes.joined(stored.data)[~np.ma.getmaskarray(stored).all(axis=0)]


# --- which table --------------------------------------------------------------------------------------------


def recognise(found: Evidence, what: str) -> tuple[cover_codes.CoverTable, str] | None:
    """The built-in table of a file of codes, and how it is known; None if none is that of nearly all its cells.

    Raises TerrainError that asks, if several are.
    """
    there = found.counts.keys()
    fits = [
        table
        for table in cover_codes.TABLES.values()
        if there & table.grounds.keys() and found.share({*table.grounds, *table.nothing}) >= _LEAST_KNOWN
    ]
    # Whole numbers from 1 on, in colours that are not CORINE's, are anybody's codes.
    by_codes = [
        table for table in fits if there <= {*table.grounds, *table.nothing} and (table.gappy or not found.palette)
    ]
    for how, chosen in (
        ("its palette", [table for table in fits if _has_its_colours(found, table)]),
        ("the names of its categories", [table for table in fits if _has_its_names(found, table)]),
        ("its name or metadata", [table for table in fits if any(word in found.text for word in table.words)]),
        ("its codes", by_codes),
    ):
        others = [title for title, codes in cover_codes.OTHERS.items() if how == "its codes" and there <= codes]
        if len(chosen) == 1 and not others:
            return chosen[0], how
        if chosen:
            keys = " or ".join(repr(table.key) for table in chosen)
            titles = ", and of ".join([*(table.title for table in chosen), *others])
            csv = ", or a CSV file of code and class" if others else ""
            raise TerrainError(
                f"{what}: its codes ({some(there)}) are those of {titles}; set terrain.cover_codes = {keys}{csv}"
            )
    return None


def _has_its_colours(found: Evidence, table: cover_codes.CoverTable) -> bool:
    """True if the codes that are there have the colours of the published legend."""
    alike = [
        max(abs(a - b) for a, b in zip(found.palette[code], ground.colour, strict=True)) <= cover_codes.SAME_COLOUR
        for code, ground in table.grounds.items()
        if code in found.counts and code in found.palette and ground.colour is not None
    ]
    return _most(alike, min(cover_codes.LEAST_DISTINCT, len(found.counts)))


def _has_its_names(found: Evidence, table: cover_codes.CoverTable) -> bool:
    alike = [
        found.names[code].lower() == ground.name.lower()
        for code, ground in table.grounds.items()
        if code in found.counts and found.names.get(code)
    ]
    return _most(alike, 1)


def _most(alike: Collection[bool], least: int) -> bool:
    return len(alike) >= least and sum(alike) >= _LEAST_ALIKE * len(alike)


def why_unknown(dataset: Any, what: str) -> str:
    """The sentence that asks, where `meaning_of` finds nothing."""
    titles = ", ".join(table.title for table in cover_codes.TABLES.values())
    if dataset.count >= 3:
        return (
            f"{what} is an image, and not in the colours of {titles}; a photo belongs into terrain.photo, codes"
            " into one band"
        )
    codes = np.unique(sampled_codes(dataset, what)).tolist()
    return (
        f"{what}: its codes ({some(codes)}) are those of no built-in table ({titles}); name a CSV file of code and"
        " class in terrain.cover_codes"
    )


def is_drawn(path: Path, config: TerrainConfig) -> bool:
    """True if an image that is named as a photo is a map of land cover, in a legend's colours or with its codes."""
    with opened(path, "photo") as dataset:
        if dataset.count >= 3:
            return cover_codes.legend_of(sampled_colours(dataset), f"photo {path}") is not None
        has_palette = dataset.colorinterp[0] == ColorInterp.palette
        return has_palette and meaning_of(dataset, f"photo {path}", config) is not None
