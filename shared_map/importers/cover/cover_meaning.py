"""What the values of a land-cover file stand for: as the scenario says, as the file shows, or by its colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools
from shared_map.importers.cover.cover_recognition import (
    MOST_COLOURS,
    Evidence,
    evidence_of,
    legend_codes,
    legend_of,
    recognise,
    some,
)
from shared_map.importers.cover.cover_tables import TABLES, CoverTable, own_grounds, table_named
from shared_map.importers.rasters.rasters import opened, thinned
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError

_MOST_SAMPLED = 1 << 20
_LOOK_CELLS = 256


@dataclass(frozen=True, eq=False)
class Meaning:
    """How the values of a file become grounds.

    table  what the codes stand for
    how    how that is known, for people
    codes  code of each colour (`legend_codes`) or of each entry of a palette; None where values are codes
    """

    table: CoverTable
    how: str
    codes: NDArray[np.uint16] | None = None


def meaning_of(dataset: Any, what: str, config: TerrainConfig) -> Meaning | None:
    """How the values of a file become grounds; None if nothing tells.

    Raises TerrainError if it holds no codes, or if several tables fit.
    """
    own = own_grounds(config.cover_classes)
    given = None if config.cover_codes is None else table_named(config.cover_codes)
    if dataset.count >= 3:
        if given is None:
            given, how = legend_of(sampled_colours(dataset), what), "drawn in the colours of its legend"
        else:
            how = f"drawn in its colours, as terrain.cover_codes = {config.cover_codes!r} says"
        if given is None:
            return None
        if not any(ground.colour for ground in given.grounds.values()):
            raise TerrainError(f"{what} has colours, and terrain.cover_codes names a table without; expected codes")
        return Meaning(given.replaced(own), how, legend_codes(given))
    sample = sampled_codes(dataset, what)
    if given is not None:
        return Meaning(given.replaced(own), f"as terrain.cover_codes = {config.cover_codes!r} says")
    if own and set(np.unique(sample).tolist()) <= own.keys() | {0}:
        return Meaning(CoverTable("own", "codes of one's own", own), "as terrain.cover_classes says")
    found = evidence_of(dataset, sample)
    known = recognise(found, what)
    if known is not None:
        return Meaning(known.table.replaced(own), f"known by {known.how}")
    if found.palette:
        colours = _palette_colours(found)
        entries = sample[sample < len(colours)].astype(np.intp)
        table = legend_of(colours[entries], what)
        if table is not None:
            codes = legend_codes(table)[colours]
            return Meaning(table.replaced(own), "its palette has the colours of its legend", codes)
    if own:
        return Meaning(CoverTable("own", "codes of one's own", own), "as terrain.cover_classes says")
    return None


def sampled_codes(dataset: Any, what: str) -> NDArray[Any]:
    """Values of some cells, (cells,), as stored, no-data left out. Raises TerrainError if they are not whole."""
    kind = np.dtype(dataset.dtypes[0]).kind
    every = math.ceil(max((dataset.height * dataset.width / _MOST_SAMPLED) ** 0.5, 1.0))
    values = thinned(dataset.read, dataset, 1, every)
    values = values[thinned(dataset.read_masks, dataset, 1, every) > 0]
    if kind == "f":
        values = values[np.isfinite(values)]
    if kind not in "iuf" or (kind == "f" and (values % 1 != 0).any()):
        raise TerrainError(f"{what} holds {'real' if kind == 'f' else dataset.dtypes[0]} numbers; codes are whole")
    return values[values >= 0]


def _palette_colours(found: Evidence) -> NDArray[np.int32]:
    colours = np.zeros(max(found.palette) + 1, np.int32)
    for code, (red, green, blue) in found.palette.items():
        colours[code] = red << 16 | green << 8 | blue
    return colours


def sampled_colours(dataset: Any) -> NDArray[np.int32]:
    """Of some cells of an image, (cells,), red << 16 | green << 8 | blue; what it does not show left out.

    None of an image that has too many colours for a drawing in its middle: a photo is not read twice.
    """
    from rasterio.windows import Window

    none = np.zeros(0, np.int32)
    if any(dtype != "uint8" for dtype in dataset.dtypes[:3]):
        return none
    rows, cols = min(dataset.height, _LOOK_CELLS), min(dataset.width, _LOOK_CELLS)
    middle = Window((dataset.width - cols) // 2, (dataset.height - rows) // 2, cols, rows)
    if np.unique(joined(dataset.read((1, 2, 3), window=middle))).size > MOST_COLOURS:
        return none
    every = math.ceil(max((dataset.height * dataset.width / _MOST_SAMPLED) ** 0.5, 1.0))
    rgb = thinned(dataset.read, dataset, (1, 2, 3), every)
    shown: Bools = thinned(lambda _, **window: dataset.dataset_mask(**window), dataset, None, every) > 0
    return joined(rgb)[shown]


def joined(rgb: NDArray[Any]) -> NDArray[np.int32]:
    """One number of each colour, red << 16 | green << 8 | blue, of (3, rows, cols)."""
    red, green, blue = (band.astype(np.int32) for band in rgb)
    joined: NDArray[np.int32] = red << 16 | green << 8 | blue
    return joined


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
    """Whether an image that is named as a photo is a map of land cover, in a legend's colours or with its codes."""
    from rasterio.enums import ColorInterp

    with opened(path, "photo") as dataset:
        if dataset.count >= 3:
            return legend_of(sampled_colours(dataset), f"photo {path}") is not None
        has_palette = dataset.colorinterp[0] == ColorInterp.palette
        return has_palette and meaning_of(dataset, f"photo {path}", config) is not None
