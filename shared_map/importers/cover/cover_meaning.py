"""Meaning of the values of a land-cover file: by the scenario, by names in the file, or by its colours.

A file shows its table by its palette, its category names, its metadata or its codes. Nothing is guessed: where
several tables fit, or none does, an error asks for the setting that says it.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError

from shared_map.importers.cover import cover_codes
from shared_map.importers.cover.cover_codes import TABLES, CoverTable, joined, legend_codes, legend_of, some
from shared_map.importers.raster_files import middle_of, opened, thinned
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError

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
`MOST_COLOURS`, so it is not read as a whole."""


@dataclass(frozen=True, eq=False)
class Meaning:
    """Conversion of a file's values into grounds.

    table  what the codes stand for
    how    how that is known, for people
    codes  code of each colour (`legend_codes`) or of each entry of a palette; None where values are codes
    """

    table: CoverTable
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
        table = given or legend_of(sampled_colours(dataset), what)
        if table is None:
            return None
        if not any(ground.colour for ground in table.grounds.values()):
            raise TerrainError(f"{what} has colours, and terrain.cover_codes names a table without; expected codes")
        return Meaning(table.replaced(own), how, legend_codes(table))
    sample = sampled_codes(dataset, what)
    if given is not None:
        return Meaning(given.replaced(own), said)
    only_own = Meaning(CoverTable("own", "codes of one's own", own), "as terrain.cover_classes says")
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
        table = legend_of(colours[sample[sample < len(colours)].astype(np.intp)], what)
        if table is not None:
            how = "its palette has the colours of its legend"
            return Meaning(table.replaced(own), how, legend_codes(table)[colours])
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
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(*faults):
        path = Path(folder) / "described.vrt"
        rasterio.shutil.copy(dataset, str(path), driver="VRT")
        if path.stat().st_size < _MOST_XML:
            categories = enumerate(ElementTree.fromstring(path.read_bytes()).iterfind(".//Category"))
            return {code: node.text.strip() for code, node in categories if node.text}
    return {}


def sampled_codes(dataset: Any, what: str) -> NDArray[Any]:
    """Values of some cells, (cells,), as stored, no-data left out. Raises TerrainError if they are not whole."""
    kind = np.dtype(dataset.dtypes[0]).kind
    every = _every(dataset)
    values = thinned(dataset.read, dataset, 1, every)
    values = values[thinned(dataset.read_masks, dataset, 1, every) > 0]
    if kind == "f":
        values = values[np.isfinite(values)]
    if kind not in "iuf" or (kind == "f" and (values % 1 != 0).any()):
        raise TerrainError(f"{what} holds {'real' if kind == 'f' else dataset.dtypes[0]} numbers; codes are whole")
    return values[values >= 0]


def sampled_colours(dataset: Any) -> NDArray[np.int32]:
    """Returns the colours of some cells of an image, (cells,), red << 16 | green << 8 | blue; masked cells left
    out.

    None of an image that has too many colours for a drawing in its middle: a photo is not read twice.
    """
    none = np.zeros(0, np.int32)
    if any(dtype != "uint8" for dtype in dataset.dtypes[:3]):
        return none
    middle = joined(dataset.read((1, 2, 3), window=middle_of(dataset, _LOOK_CELLS)))
    if np.unique(middle).size > cover_codes.MOST_COLOURS:
        return none
    every = _every(dataset)
    shown = thinned(lambda _, **window: dataset.dataset_mask(**window), dataset, None, every) > 0
    return joined(thinned(dataset.read, dataset, (1, 2, 3), every))[shown]


def _every(dataset: Any) -> int:
    return math.ceil(math.sqrt(max(dataset.height * dataset.width / _MOST_SAMPLED, 1.0)))


# --- which table --------------------------------------------------------------------------------------------


def recognise(found: Evidence, what: str) -> tuple[CoverTable, str] | None:
    """The built-in table of a file of codes, and how it is known; None if none is that of nearly all its cells.

    Raises TerrainError that asks, if several are.
    """
    there = found.counts.keys()
    fits = [
        table
        for table in TABLES.values()
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


def _has_its_colours(found: Evidence, table: CoverTable) -> bool:
    """True if the codes that are there have the colours of the published legend."""
    alike = [
        max(abs(a - b) for a, b in zip(found.palette[code], ground.colour, strict=True)) <= cover_codes.SAME_COLOUR
        for code, ground in table.grounds.items()
        if code in found.counts and code in found.palette and ground.colour is not None
    ]
    return _most(alike, min(cover_codes.LEAST_DISTINCT, len(found.counts)))


def _has_its_names(found: Evidence, table: CoverTable) -> bool:
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
    titles = ", ".join(table.title for table in TABLES.values())
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
            return legend_of(sampled_colours(dataset), f"photo {path}") is not None
        has_palette = dataset.colorinterp[0] == ColorInterp.palette
        return has_palette and meaning_of(dataset, f"photo {path}", config) is not None
