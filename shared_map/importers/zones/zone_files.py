"""Zones that a file draws: the cells that they cover, of shapes or of a raster of paces or factors."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shared_map.array_files import Bools, Floats
from shared_map.importers.gdal_rasters import is_raster, opened
from shared_map.importers.georeference import crs_name, place_on
from swarm.config.ground import ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec, Window

_NAMED = 5
"""Features that a note names at most. Chosen, not measured."""
LEAST, MOST = 1e-6, 1e6
"""Factors and paces that a file may say."""


@dataclass
class FileFacts:
    """Result of reading a file's features, for people.

    features  in the layer; used on the terrain; outside of it
    skipped   why some were left out -> how many
    named     such features, by reason, the first ones
    bridges   how many ways are bridges
    """

    file: str
    layer: str
    crs: str
    features: int = 0
    used: int = 0
    outside: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    named: dict[str, list[str]] = field(default_factory=dict)
    repaired: list[str] = field(default_factory=list)
    bridges: int = 0

    def skip(self, why: str, id: str | None = None) -> None:
        self.skipped[why] += 1
        if id is not None and len(names := self.named.setdefault(why, [])) < _NAMED:
            names.append(id)


class Burnt(NamedTuple):
    """Cells of a zone's file. Each part has a window of its own.

    values   float32; the factor or pace of each cell, of roads relative to the road pace; NaN where there is none
    lethal   where nothing drives; of water, unless there is a bridge
    bridges  of roads: the cells of bridges
    """

    facts: FileFacts
    values: tuple[Window, Floats]
    lethal: tuple[Window, Bools]
    bridges: tuple[Window, Bools]


def burn_zone(zone: ZoneConfig, grid: GridSpec, where: str) -> Burnt:
    """The cells of a zone that a file draws. Raises TerrainError with one sentence, which `where` begins."""
    path = Path(zone.file or "")
    what = f"{where} {path}"
    if zone.kind in ("pace", "factor") and is_raster(path):
        return _friction(zone, path, grid, where)
    from shared_map.importers.zones.burn_shapes import burn
    from shared_map.importers.zones.zone_features import closed_shapes, draw_zone

    drawn = draw_zone(zone, grid, what)
    closed, closes = burn(closed_shapes(drawn, grid), grid, what, everywhere=True)
    over, deck = burn(drawn.bridges, grid, what)
    burnt = burn(drawn.values, grid, what, least_wins=zone.kind == "road")
    return Burnt(drawn.facts, burnt, (closed, ~np.isnan(closes)), (over, ~np.isnan(deck)))


def _friction(zone: ZoneConfig, path: Path, grid: GridSpec, where: str) -> Burnt:
    """A raster of paces or factors. Infinite is lethal; where there is no value the ground is left as it is."""
    what = f"{where} {path}"
    given = [key for key in ("layer", "attribute", "width_m", "classes", "value") if getattr(zone, key)]
    if given:
        raise TerrainError(f"{what} is a raster, which has no {given[0]}")
    with opened(path, where) as dataset:
        placed = place_on(dataset, grid, zone.crs, what, "crs")
        if dataset.count != 1:
            raise TerrainError(f"{what} has {dataset.count} bands of {dataset.dtypes[0]}, expected one")
        # The nearest cell counts, or the mean where cells of the grid are half as large again.
        stored = placed.on_grid("average" if placed.grows else "nearest")
        values = np.concatenate([rows for _, rows in stored])
        values = values * np.float32(dataset.scales[0]) + np.float32(dataset.offsets[0])
    lethal = values == np.inf
    values[lethal] = np.nan
    known = values[~np.isnan(values)]
    wrong = known[(known < LEAST) | (known > MOST)]
    if wrong.size:
        expected = f"a {zone.kind} of {LEAST:g} to {MOST:g}, or inf if nothing drives"
        raise TerrainError(f"{what} holds {wrong[0]:g}, expected {expected}")
    count = int(known.size + lethal.sum())
    if not count:
        raise TerrainError(f"{what} has no value on the terrain")
    crs = "local" if zone.crs == "local" or placed.crs is None else crs_name(placed.crs)
    facts = FileFacts(path.name, "", crs, features=count, used=count)
    nothing = (Window(0, 0, 0, 0), np.zeros((0, 0), np.bool_))
    return Burnt(facts, (grid.window, values), (grid.window, lethal), nothing)
