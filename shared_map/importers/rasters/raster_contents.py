"""What a raster that is named as a terrain holds: heights, heights stored as colours, or codes of land cover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from shared_map.importers.cover.cover_meaning import meaning_of, sampled_codes, sampled_colours
from shared_map.importers.cover.cover_recognition import evidence_of, legend_of, recognise, some
from shared_map.importers.cover.cover_tables import TABLES
from shared_map.importers.rasters.encoded_heights import TITLES, Encoding, encodings_of
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError

_MOST_CODES = 256
_LEAST_CODES = 3
_LOOK_CELLS = 128


@dataclass(frozen=True)
class Contents:
    """What a raster holds.

    is_cover  codes of land cover, or a drawing of them
    encoding  how heights are stored as colours; None where numbers are heights
    how       how that is known, for people; empty where it goes without saying
    """

    is_cover: bool = False
    encoding: Encoding | None = None
    how: str = ""


def contents_of(dataset: Any, what: str, config: TerrainConfig) -> Contents:
    """What a raster holds, by what the scenario says, else by its content.

    Raises TerrainError that names the setting which answers, if it may be one or the other.
    """
    said = config.elevation_encoding
    if said == "metres":
        return Contents()
    if said is not None:
        return Contents(encoding=said, how=f"as terrain.elevation_encoding = {said!r} says")
    if config.cover is None and (config.cover_codes is not None or config.cover_classes):
        return Contents(is_cover=True)
    if dataset.count >= 3:
        return _of_colours(dataset, what)
    return _of_numbers(dataset, what, config)


def _of_colours(dataset: Any, what: str) -> Contents:
    fitting = encodings_of(dataset)
    if len(fitting) == 1:
        return Contents(encoding=fitting[0], how="as only so its colours are heights of a landscape")
    settings = " or ".join(f"terrain.elevation_encoding = {encoding!r}" for encoding in TITLES)
    if fitting:
        raise TerrainError(f"{what} may be heights of Terrain-RGB or of Terrarium; set {settings}")
    if legend_of(sampled_colours(dataset), what) is not None:
        return Contents(is_cover=True)
    raise TerrainError(
        f"{what} has {dataset.count} bands: a photo? Name it in terrain.photo; of heights stored as colours"
        f" say {settings}"
    )


def _of_numbers(dataset: Any, what: str, config: TerrainConfig) -> Contents:
    from rasterio.enums import ColorInterp

    has_palette = dataset.colorinterp[0] == ColorInterp.palette
    if np.dtype(dataset.dtypes[0]).kind not in "iu":
        return Contents()
    if not has_palette and not _may_be_codes(dataset):
        return Contents()
    sample = sampled_codes(dataset, what)
    codes = np.unique(sample)
    if not 0 < codes.size <= _MOST_CODES:
        return Contents()
    answers = (
        "terrain.cover_codes = {} if it is land cover, terrain.elevation_encoding = 'metres' if it has heights"
    )
    if has_palette:
        if meaning_of(dataset, what, config) is not None:
            return Contents(is_cover=True)
        raise TerrainError(
            f"{what} has a palette, and its codes ({some(codes.tolist())}) are those of no built-in table; set "
            + answers.format("a CSV file of code and class")
        )
    fits = [table for table in TABLES.values() if table.gappy and np.isin(codes, _all_codes(table.key)).all()]
    if not fits:
        return Contents()
    found = evidence_of(dataset, sample)
    if found.names or any(word in found.text for table in fits for word in table.words):
        known = recognise(found, what)
        return Contents(is_cover=known is not None)
    if all(np.isin(codes, list(table.grounds)).sum() < _LEAST_CODES for table in fits):
        return Contents()
    titles = " and of ".join(table.title for table in fits)
    raise TerrainError(
        f"{what} holds nothing but {some(codes.tolist())}, codes of {titles}; set "
        + answers.format(" or ".join(repr(table.key) for table in fits))
    )


def _may_be_codes(dataset: Any) -> bool:
    """A first look at the middle of a file: most height models are ruled out by it."""
    from rasterio.windows import Window

    rows, cols = min(dataset.height, _LOOK_CELLS), min(dataset.width, _LOOK_CELLS)
    window = Window((dataset.width - cols) // 2, (dataset.height - rows) // 2, cols, rows)
    values = dataset.read(1, window=window)[dataset.read_masks(1, window=window) > 0]
    return any(table.gappy and np.isin(values, _all_codes(table.key)).all() for table in TABLES.values())


def _all_codes(key: str) -> list[int]:
    return [*TABLES[key].grounds, *TABLES[key].nothing]
