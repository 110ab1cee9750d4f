"""Zones that a file draws: which of its features count, what they are worth, and the cells that they cover."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from shared_map.arrays import Bools, Floats
from shared_map.importers.zones.burn import Drawing, burn, burn_mask
from shared_map.importers.zones.on_grid import Placing
from shared_map.importers.zones.vector_files import (
    Features,
    Layer,
    columns_of,
    is_vector,
    number,
    open_layer,
    read_features,
)
from shared_map.importers.zones.way_classes import (
    COLUMNS,
    PACKED,
    TAGS,
    Kind,
    class_of,
    is_bridge,
    is_tunnel,
    unpacked,
    way_of,
    width_of,
)
from swarm.config.ground import ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec, Window

_WIDEST_M = 1000.0
"""Lines that run so far outside the terrain are of no use to it."""
_NAMED = 5
_LEAST, _MOST = 1e-6, 1e6
"""Factors and paces that a file may say."""


@dataclass
class FileFacts:
    """What became of a file's features, for people.

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
    mended: list[str] = field(default_factory=list)
    bridges: int = 0
    classes: Counter[str] = field(default_factory=Counter)

    def skip(self, why: str, id: str | None = None) -> None:
        self.skipped[why] += 1
        if id is not None and len(names := self.named.setdefault(why, [])) < _NAMED:
            names.append(id)


@dataclass(frozen=True, eq=False)
class Burnt:
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
    assert zone.file is not None
    path = Path(zone.file)
    what = f"{where} {path}"
    if not path.exists():
        raise TerrainError(f"{what} does not exist")
    if not is_vector(path) and _is_raster(path):
        return _friction(zone, path, grid, where)
    try:
        import pyogrio  # noqa: F401
        import shapely  # noqa: F401
    except ImportError as error:
        raise TerrainError(
            f"{what} cannot be read: pyogrio and shapely are missing; pip install 'terrain-swarm[vectors]'"
        ) from error
    layer = open_layer(path, zone.layer, what)
    facts = FileFacts(path.name, layer.name, layer.crs, layer.features)
    worth = _Worth(zone, layer, facts)
    drawings = _Drawings()
    if layer.bounds is None:
        facts.crs = zone.crs or layer.crs or "none"
        return drawings.burnt(grid, what, facts, zone)
    placing = Placing(grid, layer, zone.crs, zone.width_m or _WIDEST_M / 2)
    facts.crs = placing.crs
    read, used = 0, set()
    for shift, box in placing.boxes(layer.bounds):
        features = read_features(layer, box, worth.columns)
        read += len(features.ids)
        used |= _draw(features, placing, box, shift, worth, drawings, grid, zone, what)
    facts.used, facts.outside = len(used), max(layer.features - read, 0)
    worth.check_used()
    return drawings.burnt(grid, what, facts, zone)


class _Drawings:
    """What is drawn of a file, by what becomes of it."""

    def __init__(self) -> None:
        self.values, self.lethal, self.bridges = Drawing(False), Drawing(True), Drawing(False)

    def burnt(self, grid: GridSpec, what: str, facts: FileFacts, zone: ZoneConfig) -> Burnt:
        return Burnt(
            facts,
            burn(self.values, grid, what, least_wins=zone.kind == "road"),
            burn_mask(self.lethal, grid, what),
            burn_mask(self.bridges, grid, what),
        )


def _draw(
    features: Features,
    placing: Placing,
    box: tuple[float, float, float, float],
    shift: float,
    worth: _Worth,
    drawings: _Drawings,
    grid: GridSpec,
    zone: ZoneConfig,
    what: str,
) -> set[str]:
    """Draw features; returns the ids of those that are used."""
    facts = worth.facts
    placed = placing.place(features, box, shift)
    if placed.empty:
        facts.skipped["without a shape"] += placed.empty
    for id, why in placed.unusable.items():
        if zone.kind in ("forbidden", "water"):
            raise TerrainError(
                f"{what}: feature {id} of a {zone.kind} zone cannot be used: {why}; mend or remove it"
            )
        facts.skip(why, id)
    facts.mended += placed.mended
    wanted = worth.of(features, set(placed.of.tolist()))
    for shape, n in zip(placed.shapes, placed.of.tolist(), strict=True):
        item = wanted.get(n)
        if item is None:
            continue
        width_cells = item.width_m / grid.resolution_m
        if item.factor is None:
            drawings.lethal.add(shape, 1.0, width_cells)
        else:
            drawings.values.add(shape, item.factor, width_cells)
        if item.bridge:
            drawings.bridges.add(shape, 1.0, width_cells)
    facts.bridges += sum(item.bridge for item in wanted.values())
    return {features.ids[n] for n in wanted}


@dataclass(frozen=True, slots=True)
class _Item:
    """What a feature is worth; a factor of None is lethal."""

    width_m: float
    factor: float | None
    bridge: bool = False


class _Worth:
    """What each feature of a zone is worth.

    Raises TerrainError if the zone does not say how to tell.
    """

    def __init__(self, zone: ZoneConfig, layer: Layer, facts: FileFacts) -> None:
        self._zone, self._layer, self.facts = zone, layer, facts
        self._way: Kind | None = zone.kind if zone.kind in ("road", "water") else None
        self._by_class = bool(zone.classes) or (self._way is not None and not self._is_plain())
        self.columns = [*TAGS, *PACKED]
        if zone.attribute is not None:
            self._check_column(zone.attribute)
            self.columns.append(zone.attribute)
        elif self._way is not None:
            self.columns += COLUMNS[self._way]
        elif zone.kind in ("pace", "factor") and zone.value is None and not zone.classes:
            raise TerrainError(
                f"{layer.what}: set {'factor' if zone.kind == 'factor' else 'pace_s_per_m'}, or attribute to the"
                f" column that holds it; the columns are {self._listed()}"
            )
        if zone.classes and zone.kind == "pace":
            raise TerrainError(f"{layer.what}: classes have factors, which kind pace does not take")
        if zone.classes and self._way is None and zone.attribute is None:
            raise TerrainError(f"{layer.what}: classes need an attribute; the columns are {self._listed()}")

    def _is_plain(self) -> bool:
        """Whether each line is a road or a river of one width, as nothing tells of classes."""
        zone, assumed = self._zone, COLUMNS[self._way or "road"]
        if zone.attribute is not None or any(name in self._layer.columns for name in (*assumed, *PACKED)):
            return False
        if zone.width_m is None and self._layer.features:
            raise TerrainError(
                f"{self._layer.what} has no column {' or '.join(assumed)} (it has {self._listed()}); set attribute"
                " to the column with the classes, or width_m, which takes each feature for one of this width"
            )
        return True

    def _check_column(self, name: str) -> None:
        if name not in self._layer.columns and not any(packed in self._layer.columns for packed in PACKED):
            raise TerrainError(f"{self._layer.what} has no column {name!r}; it has {self._listed()}")

    def _listed(self) -> str:
        columns = self._layer.columns
        return (", ".join(columns[:20]) + (" ..." if len(columns) > 20 else "")) or "none"

    def of(self, features: Features, placed: set[int]) -> dict[int, _Item]:
        """What those features are worth that count."""
        found = {}
        rows = columns_of(features, self.columns)
        for n in sorted(placed):
            item = self._item(unpacked(rows[n]), features.ids[n])
            if item is not None:
                found[n] = item
        return found

    def _item(self, tags: dict[str, str], id: str) -> _Item | None:
        zone = self._zone
        width_m = width_of(tags) or zone.width_m
        if self._by_class:
            return self._of_class(tags, width_m, id)
        if self._way is not None and is_tunnel(tags):
            self.facts.skip("below the ground", id)
            return None
        bridge = self._way == "road" and is_bridge(tags)
        if zone.kind == "forbidden" or self._way == "water":
            return _Item(width_m or 0.0, None)
        if zone.kind in ("pace", "factor") and zone.attribute is not None:
            value = number(tags.get(zone.attribute))
            if value is None or not _LEAST <= value <= _MOST:
                shown = tags.get(zone.attribute, "nothing")[:40]
                self.facts.skip(
                    f"whose {zone.attribute} is no {zone.kind} of {_LEAST:g} to {_MOST:g}", f"{id} ({shown})"
                )
                return None
            return _Item(width_m or 0.0, value)
        return _Item(width_m or 0.0, zone.value or 1.0, bridge)

    def _of_class(self, tags: dict[str, str], width_m: float | None, id: str) -> _Item | None:
        zone, kind = self._zone, self._way
        if kind is not None:
            name = class_of(kind, tags, zone.attribute)
        else:
            name = tags.get(zone.attribute or "")
        if name is None:
            self.facts.skip("without a class")
            return None
        if kind is None:
            given = zone.classes.get(name)
            if given is None or given.factor == "ignored":
                self.facts.skip(f"of class {name[:40]}")
                return None
            self.facts.classes[name] += 1
            lethal = zone.kind == "forbidden" or given.factor == "lethal"
            factor = None if lethal else float(given.factor)
            return _Item(width_m or given.width_m or 0.0, factor)
        way = way_of(kind, name, zone.classes)
        if way is None:
            self.facts.skip(f"of class {name[:40]}", id)
            return None
        if is_tunnel(tags):
            self.facts.skip("below the ground", id)
            return None
        self.facts.classes[name] += 1
        return _Item(width_m or way.width_m, way.factor, kind == "road" and is_bridge(tags))

    def check_used(self) -> None:
        """Raises TerrainError if features are on the terrain, and none counts for what they are."""
        facts = self.facts
        if facts.used or not facts.skipped:
            return
        reasons = ", ".join(f"{count} {why}" for why, count in facts.skipped.most_common(4))
        if set(facts.skipped) <= {"without a shape"}:
            return
        raise TerrainError(
            f"{self._layer.what}: none of its features on the terrain counts ({reasons}); set attribute and"
            f" classes, the columns are {self._listed()}"
        )


# --- rasters of pace or factor ------------------------------------------------------------------------------


def _is_raster(path: Path) -> bool:
    from shared_map.importers.rasters.raster_kinds import is_raster

    return is_raster(path)


def _friction(zone: ZoneConfig, path: Path, grid: GridSpec, where: str) -> Burnt:
    """A raster of paces or factors. Infinite is lethal; where there is no value the ground is left as it is."""
    from shared_map.importers.zones.friction import values_on

    what = f"{where} {path}"
    if zone.kind not in ("pace", "factor"):
        raise TerrainError(f"{what} is a raster, which goes with kind pace or factor, found {zone.kind!r}")
    given = [key for key in ("layer", "attribute", "width_m", "classes", "value") if getattr(zone, key)]
    if given:
        raise TerrainError(f"{what} is a raster, which has no {given[0]}")
    values, crs = values_on(path, grid, zone.crs, where)
    lethal = values == np.inf
    values[lethal] = np.nan
    known = values[~np.isnan(values)]
    if known.size and not _LEAST <= known.min() <= known.max() <= _MOST:
        worst = known.min() if known.min() < _LEAST else known.max()
        raise TerrainError(
            f"{what} holds {worst:g}, expected a {zone.kind} of {_LEAST:g} to {_MOST:g}, or inf where nothing"
            " drives; declare what stands for no value as nodata"
        )
    facts = FileFacts(path.name, "", crs, features=int(known.size + lethal.sum()))
    facts.used = facts.features
    if known.size + int(lethal.sum()) == 0:
        raise TerrainError(f"{what} has no value on the terrain")
    window, empty = grid.window, Window(0, 0, 0, 0)
    nothing: Any = np.zeros((0, 0), np.bool_)
    return Burnt(facts, (window, values), (window, lethal), (empty, nothing))
