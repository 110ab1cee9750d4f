"""Land-cover maps: what the codes of a raster mean, by built-in tables or those of the user's own, and the classes
that they put on the terrain's grid.

A code becomes a class where one of ours fits, else a pace relative to open ground, or lethal. Codes are never
interpolated: a cell takes the nearest code, or the most frequent one where cells grow.
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.gdal_rasters import opened, sampled
from shared_map.importers.georeference import place_on
from shared_map.importers.terrain_sources import Source
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.row_bands import Progress, no_progress
from swarm.config.explain import nearest
from swarm.config.ground import TerrainConfig
from swarm.config.input_files import FileKind, read_text
from swarm.config.setting_types import CoverGround
from swarm.errors import TerrainError
from swarm.grid import GridSpec

HIGHEST_CODE = 65_533
"""Largest code of 16 bits but for the two numbers of larger codes and of none (`_LARGER`, `_NOTHING`)."""
_SHOWN = 8
"""Codes that a sentence lists at most. Chosen, not measured."""


@dataclass(frozen=True)
class Ground:
    """Meaning of a code.

    kind    the class; UNKNOWN where none of ours fits
    factor  pace relative to open ground; inf is lethal
    name    as the publisher calls it
    """

    kind: TerrainClass
    factor: float = 1.0
    name: str = ""

    @property
    def text(self) -> str:
        if self.kind != TerrainClass.UNKNOWN:
            return self.kind.name.lower()
        return "lethal" if math.isinf(self.factor) else f"pace x {self.factor:g}"


@dataclass(frozen=True)
class CoverTable:
    """Codes of one product.

    key      what `terrain.cover_codes` calls it
    title    what people call it
    grounds  what each code stands for
    nothing  codes that stand for no data
    words    what its files call it in their metadata or names, in lower case
    gappy    whether whole numbers between its codes are none, so that heights are hardly all among them
    """

    key: str
    title: str
    grounds: Mapping[int, Ground]
    nothing: Collection[int] = (0,)
    words: Sequence[str] = ()
    gappy: bool = True

    def replaced(self, own: Mapping[int, Ground]) -> CoverTable:
        """The table with other meanings of some codes."""
        named = {code: replace(new, name=self.grounds.get(code, new).name) for code, new in own.items()}
        return replace(self, grounds={**self.grounds, **named}, nothing={*self.nothing} - own.keys())


def ground_of(value: CoverGround, name: str = "") -> Ground:
    """A class by its name, "lethal", or a pace relative to open ground."""
    if value == "lethal":
        return Ground(TerrainClass.UNKNOWN, math.inf, name)
    if isinstance(value, str):
        return Ground(TerrainClass[value.upper()], 1.0, name)
    return Ground(TerrainClass.UNKNOWN, float(value), name)


def _built_in() -> tuple[dict[str, CoverTable], dict[str, frozenset[int]]]:
    tables = tomllib.loads((Path(__file__).parent / "land_cover.toml").read_text(encoding="utf-8"))
    others = {title: frozenset(codes) for title, codes in tables.pop("others").items()}
    grounds: dict[str, dict[int, Ground]] = {
        key: {int(code): ground_of(value, name) for code, (value, name) in table.pop("grounds", {}).items()}
        for key, table in tables.items()
    }
    for key, table in tables.items():
        if "counted" in table:
            grounds[key] = dict(enumerate(grounds[table.pop("counted")].values(), 1))
    return {key: CoverTable(key=key, grounds=grounds[key], **table) for key, table in tables.items()}, others


TABLES, OTHERS = _built_in()
"""Built-in tables by what the setting calls them; and codes of maps that built-in ones are not to be taken for."""


def read_cover_table(path: Path) -> CoverTable:
    """A table of the user's own: lines of code and class, pace factor or "lethal", and a name if there is one.

    Parameters
    ----------
    path : Path
        CSV with commas, semicolons or tabs. A first line whose first cell has no digit is a header.

    Raises
    ------
    TerrainError
        If the file cannot be read, or a line is not as above.
    """
    grounds: dict[int, Ground] = {}
    lines = read_text(path, FileKind.COVER_TABLE, "utf-8-sig").splitlines()
    for number, line in enumerate(lines, 1):
        mark = next((char for char in line if char in ",;\t"), ",")
        cells = [cell.strip().strip('"') for cell in line.split(mark, 2)] + ["", ""]
        if not "".join(cells) or cells[0].startswith("#"):
            continue
        what = f"cover codes {path}, line {number}"
        if number == 1 and not any(char.isdigit() for char in cells[0]):
            continue
        code = int(cells[0][:12]) if cells[0].isdecimal() else -1
        if not 0 <= code <= HIGHEST_CODE:
            raise TerrainError(f"{what}: {cells[0][:40]!r} is no code; expected a whole number to {HIGHEST_CODE}")
        if code in grounds:
            raise TerrainError(f"{what}: code {code} comes twice")
        try:  # a comma that parts no cells is that of a number: 7;1,7 is a pace of 1.7
            value: CoverGround = msgspec.convert(cells[1].lower().replace(",", "."), CoverGround, strict=False)
        except msgspec.ValidationError as error:
            kinds = ", ".join(kind.name.lower() for kind in TerrainClass)
            expected = f"expected {kinds}, lethal, or a pace such as 1.5"
            raise TerrainError(f"{what}: {cells[1][:40]!r} is no ground; {expected}") from error
        grounds[code] = ground_of(value, cells[2][:80])
    if not grounds:
        raise TerrainError(f"cover codes {path} has no line of code and class")
    return CoverTable(str(path), f"the codes of {path.name}", grounds, nothing=())


def some(codes: Iterable[int]) -> str:
    """A few codes, for people."""
    listed = sorted(codes)
    return ", ".join(map(str, listed[:_SHOWN])) + (" ..." if len(listed) > _SHOWN else "")


_LEAST_KNOWN = 0.95
"""Share of a file's cells that must have a code of a table."""
_MOST_SAMPLED = 1 << 20
"""Every cell of 1024 x 1024: of a larger file still a hundred of a code that a ten-thousandth of it has."""
_LARGER, _NOTHING = HIGHEST_CODE + 1, HIGHEST_CODE + 2
"""Entries of the look-up beyond all codes: a number that is none, and no data."""
_LISTED_CODES = 6
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
        notes.append(f"{share}, which counts; if too coarse for a lake, paint a forbidden zone (cost.zones)")
    factor = np.where(known, cover.factor, np.float32(1))
    if source.factor is not None:
        factor *= source.factor
    classes = np.where(known, cover.classes, source.classes)
    return replace(source, classes=classes, factor=factor, notes=tuple(notes))


def read_cover(path: Path, grid: GridSpec, config: TerrainConfig, progress: Progress = no_progress) -> Cover:
    """A land-cover map on the terrain's grid.

    Parameters
    ----------
    path : Path
        One band of whole numbers.
    grid : GridSpec
        Of the terrain.
    config : TerrainConfig
        `cover_codes`, `cover_classes` and `crs` count.
    progress : callable
        Called with the current step and the share of it that is done.

    Raises
    ------
    TerrainError
        If the file cannot be read, holds no codes or lies outside the terrain. Also if no table has its codes, or
        several tables have them: the sentence then names the setting which chooses one.
    """
    what = f"land cover {path}"
    with opened(path, "land cover") as dataset:
        found = meaning_of(dataset, what, config)
        if found is None:
            listed = some(np.unique(sampled_codes(dataset, what)).tolist())
            titles = ", ".join(each.title for each in TABLES.values())
            raise TerrainError(
                f"{what}: its codes ({listed}) are those of no built-in table ({titles}); name a CSV file of code"
                " and class in terrain.cover_codes"
            )
        table, known_by = found
        placed = place_on(dataset, grid, config.crs, what)
        notes, how = [], "mode" if placed.grows else "nearest"
        if not placed.is_cells:
            taken, size = {"mode": "most frequent"}.get(how, how), f"{dataset.height} x {dataset.width} pixels"
            notes.append(f"land cover: {size}, each cell takes the {taken} code")
        if placed.share < 0.999:
            notes.append(f"the land cover's frame covers {placed.share:.1%} of the terrain")
        # Class, factor and state of each entry: 0 known, 1 a code that the table lacks, 2 no data.
        kinds, states = np.zeros(_NOTHING + 1, np.uint8), np.ones(_NOTHING + 1, np.uint8)
        factors = np.ones(_NOTHING + 1, np.float32)
        for code, ground in table.grounds.items():
            if code <= HIGHEST_CODE:
                kinds[code], factors[code], states[code] = ground.kind, ground.factor, 0
        states[[code for code in table.nothing if code <= HIGHEST_CODE] + [_NOTHING]] = 2
        classes, factor = np.empty(grid.shape, np.uint8), np.empty(grid.shape, np.float32)
        known = np.empty(grid.shape, np.bool_)
        counts = np.zeros(_NOTHING + 1, np.int64)
        for rows, codes in placed.on_grid(how, 1, "reading land cover", progress):
            # A code itself, `_LARGER` of a larger number, else `_NOTHING`.
            empty = ~(codes >= 0) | (codes == np.inf)
            at = np.where(empty, _NOTHING, np.minimum(codes, _LARGER)).astype(np.intp)
            classes[rows], factor[rows], known[rows] = kinds[at], factors[at], states[at] == 0
            counts += np.bincount(at.reshape(-1), minlength=len(counts))
        return Cover(classes, factor, known, (*notes, *_notes_on(what, table, known_by, counts, states)))


def _notes_on(
    what: str, table: CoverTable, known_by: str, cells: NDArray[np.int64], states: Bytes
) -> Iterable[str]:
    """Returns notes for people: the table, the codes that it has and those that it lacks, cells without any.

    Raises TerrainError if the table has none of the codes: then it is that of another map.
    """
    total = int(cells.sum())
    there = np.flatnonzero(cells)
    strange = [code for code in there.tolist() if states[code] == 1]
    if not cells[states == 0].any():
        found = f"none of its codes on the terrain ({some(strange) or 'no data'}) is in the table, {table.title}"
        raise TerrainError(f"{what}: {found}; terrain.cover_codes names another")
    most = sorted((code for code in there.tolist() if states[code] == 0), key=lambda code: -cells[code])
    names = {code: f"{code} {table.grounds[code].name}".strip() for code in most[:_LISTED_CODES]}
    listed = [f"{name} {cells[at] / total:.1%} ({table.grounds[at].text})" for at, name in names.items()]
    more = f" and {len(most) - _LISTED_CODES} more" if len(most) > _LISTED_CODES else ""
    yield f"land cover: {table.title}, {known_by}: {', '.join(listed) or 'none of its codes'}{more}"
    if strange:
        share = cells[strange].sum() / total
        codes = [code for code in strange if code <= HIGHEST_CODE]
        listed_codes = some(codes) if codes else f"above {HIGHEST_CODE}"
        yield (
            f"land cover: codes {listed_codes} on {share:.1%} of the terrain are not in the table and count as"
            " unknown ground; terrain.cover_classes says what they are"
        )
    empty = cells[states == 2].sum() / total
    if empty:
        yield f"land cover: no data on {empty:.1%} of the terrain, where photo and heights say what it is"


# --- what its values mean ---------------------------------------------------------------------------------------


def meaning_of(dataset: Any, what: str, config: TerrainConfig) -> tuple[CoverTable, str] | None:
    """Returns what the values of a land-cover file stand for, and how that is known, for people; None if the file
    gives no hint of its code table.

    Raises TerrainError if the values of the file are not codes (whole numbers), or if several code tables fit.
    """
    own = {int(code): ground_of(value) for code, value in config.cover_classes.items()}
    sample = sampled_codes(dataset, what)
    if (name := config.cover_codes) is not None:
        if name not in TABLES and not os.path.isfile(name):  # also of a name that is too long
            near = nearest(name[:60], [*TABLES])
            raise TerrainError(f"terrain.cover_codes {name!r} is neither {', '.join(TABLES)} nor a CSV file{near}")
        table = TABLES[name] if name in TABLES else read_cover_table(Path(name))
        return table.replaced(own), f"as terrain.cover_codes = {name!r} says"
    only_own = CoverTable("own", "codes of one's own", own), "as terrain.cover_classes says"
    if own and set(np.unique(sample).tolist()) <= own.keys() | {0}:
        return only_own
    known = recognise(dataset, sample, what)
    if known is not None:
        return known[0].replaced(own), f"known by {known[1]}"
    return only_own if own else None


def text_of(dataset: Any) -> str:
    """The name, tags and description of a file of one band, in lower case."""
    tags = [f"{key} {value}" for key, value in [*dataset.tags().items(), *dataset.tags(1).items()]]
    words = [Path(str(dataset.name)).name, *tags, *dataset.descriptions[:1]]
    return " ".join(str(word)[:2000] for word in words if word).lower()


def sampled_codes(dataset: Any, what: str) -> NDArray[Any]:
    """Values of some cells, (cells,), as stored, no-data left out. Raises TerrainError if they are not whole."""
    if dataset.count >= 3:
        raise TerrainError(
            f"{what} has {dataset.count} bands, expected one of codes; an image of a map holds no codes, the raster"
            " of the product is needed; a photo goes into terrain.photo"
        )
    values = sampled(dataset, 1, _MOST_SAMPLED).compressed()
    values = values[np.isfinite(values)]
    if (values % 1 != 0).any():
        raise TerrainError(f"{what} holds real numbers; codes are whole")
    return np.asarray(values[values >= 0])


def recognise(dataset: Any, sample: NDArray[Any], what: str) -> tuple[CoverTable, str] | None:
    """The built-in table of a file of codes, and how it was recognised. None if no table fits nearly all cells.

    sample  codes of some of the file's cells, (cells,), without no-data

    Raises TerrainError if several tables fit. The message asks the user to choose one.
    """
    text, there = text_of(dataset), set(np.unique(sample).tolist())
    every = {key: {*table.grounds, *table.nothing} for key, table in TABLES.items()}
    known = {key: np.isin(sample, [*codes]).mean() for key, codes in every.items()}
    fits = [TABLES[key] for key in TABLES if there & TABLES[key].grounds.keys() and known[key] >= _LEAST_KNOWN]
    # Whole numbers from 1 on, in colours, are anybody's codes.
    has_palette = dataset.colorinterp[0] == ColorInterp.palette
    by_codes = [table for table in fits if there <= every[table.key] and (table.gappy or not has_palette)]
    for how, chosen in (
        ("its name or metadata", [table for table in fits if any(word in text for word in table.words)]),
        ("its codes", by_codes),
    ):
        others = [title for title, codes in OTHERS.items() if how == "its codes" and there <= codes]
        if len(chosen) == 1 and not others:
            return chosen[0], how
        if chosen:
            keys = " or ".join(repr(table.key) for table in chosen)
            titles = ", and of ".join([*(table.title for table in chosen), *others])
            csv = ", or a CSV file of code and class" if others else ""
            found = f"its codes ({some(there)}) are those of {titles}"
            raise TerrainError(f"{what}: {found}; set terrain.cover_codes = {keys}{csv}")
    return None
