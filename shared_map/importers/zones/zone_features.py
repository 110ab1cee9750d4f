"""Shapes of a zone's file: which of its features count, what they are worth, and the areas of them for orders."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shared_map.importers.zones import way_classes
from shared_map.importers.zones.burn_shapes import POLYGON, Drawn, Placing, Shapes
from shared_map.importers.zones.shape_texts import INCLUSION
from shared_map.importers.zones.vector_files import Features, Layer, open_layers, read_features, unusable
from shared_map.importers.zones.way_classes import COLUMNS, PACKED, TAGS, Kind, Way, states_extent
from shared_map.importers.zones.zone_files import LEAST, MOST, FileFacts
from swarm.config.ground import ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec

_WIDEST_M = 1000.0
"""Lines that run so far outside the terrain are of no use to it."""
Corner = tuple[float, float]
MOST_OUTLINES = 50
_LEAST_HALF = 0.71
"""Half the least width of a line or a point in cells: the middle of each cell that it crosses is within it, and an
order closes a cell by its middle."""
_TOLERANCES_CELLS = (0.01, 0.05, 0.1, 0.25)
"""Tolerances for dropped corners, tried in order until few enough are left."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """Shapes of a zone's file on a grid, in cells.

    values   with a factor or pace
    lethal   closed, each with its width
    kept     all else is closed; empty if nothing is kept in
    bridges  of roads
    """

    facts: FileFacts
    values: list[Drawn] = field(default_factory=list)
    lethal: list[Drawn] = field(default_factory=list)
    kept: list[Drawn] = field(default_factory=list)
    bridges: list[Drawn] = field(default_factory=list)
    keeps: bool = False


def draw_zone(zone: ZoneConfig, grid: GridSpec, what: str) -> Drawing:
    """The shapes of a vector file, for every use of it: each feature is drawn, lies outside of the terrain, or does
    not count by its class; otherwise TerrainError names it."""
    path = Path(zone.file or "")
    layers = open_layers(path, zone.layer, what)
    facts = FileFacts(path.name, ", ".join(layer.name for layer in layers), "")
    drawing, used, keeps = Drawing(facts), 0, False
    faults = []
    for layer in layers:
        worth = _Worth(zone, layer, facts)
        placing = Placing(grid, layer, zone.crs, _margin_m(zone, layer))
        facts.crs = placing.crs
        for features in read_features(layer, worth.columns):
            placed = placing.place(features)
            inclusion = features.columns.get(INCLUSION, np.zeros(0, object))
            keeps |= worth.closes and bool((inclusion == "yes").any())
            facts.features += len(features.numbers)
            facts.outside += placed.outside
            facts.mended += placed.mended
            names = set()
            for shape, id, way, bridge, inside in worth.of(features, placed):
                names.add(id)
                drawn = Drawn(shape, way.factor or 1.0, way.width_m / grid.resolution_m)
                closing = drawing.kept if inside else drawing.lethal
                (closing if way.factor is None else drawing.values).append(drawn)
                if bridge:
                    drawing.bridges.append(drawn)
            used += len(names)
        try:
            placing.check_touched()
        except TerrainError as error:
            faults.append(error)
    facts.used = used
    if len(faults) == len(layers):
        raise faults[0]
    worth.check_used()
    return replace(drawing, keeps=keeps)


def closed_shapes(drawing: Drawing, grid: GridSpec) -> list[Drawn]:
    """The shapes of all closed ground: those that close it, and all that lies outside of those that keep in."""
    if not (drawing.kept or drawing.keeps):
        return drawing.lethal
    kept = shapely.union_all([shapely.buffer(each.shape, each.width_cells / 2) for each in drawing.kept])
    around = shapely.difference(shapely.box(-1, -1, grid.cols + 1, grid.rows + 1), kept)
    return [*drawing.lethal, *(Drawn(part, 1.0, 0.0) for part in shapely.get_parts(around) if part.area > 0)]


def _margin_m(zone: ZoneConfig, layer: Layer) -> float:
    """The distance from the terrain up to which a feature may reach it."""
    stated = [column for column in layer.columns if states_extent(column)]
    widths = [way.width_m or 0.0 for way in zone.classes.values()] + [zone.width_m or 0.0, _WIDEST_M]
    for features in read_features(layer, stated) if stated else ():
        for n in range(len(features.numbers)):
            with contextlib.suppress(ValueError):
                widths.append(way_classes.width_of(features.tags(n)) or 0.0)
    return max(widths) / 2


class _Worth:
    """Cost of each feature of a zone.

    Raises TerrainError if the zone does not say how to tell.
    """

    def __init__(self, zone: ZoneConfig, layer: Layer, facts: FileFacts) -> None:
        self._zone, self._layer, self._facts = zone, layer, facts
        self.closes = zone.kind in ("forbidden", "keep_in")
        self._kind: Kind | None = zone.kind if zone.kind in ("road", "water") else None
        name, assumed = zone.attribute, () if self._kind is None else COLUMNS[self._kind]
        has_classes = name is not None or not {*assumed, *PACKED}.isdisjoint(layer.columns)
        self._by_class = bool(zone.classes) or (self._kind is not None and has_classes)
        key = "factor" if zone.kind == "factor" else "pace_s_per_m"
        self.columns = [*TAGS, *PACKED, *assumed, *filter(states_extent, layer.columns), *([name] if name else ())]
        for is_wrong, why in (
            (name is not None and {name, *PACKED}.isdisjoint(layer.columns), f"has no column {name!r}"),
            (zone.classes and zone.kind == "pace", "has classes with factors, which kind pace does not take"),
            (zone.classes and name is None and self._kind is None, "has classes; set attribute to their column"),
            (
                self._kind is not None and not has_classes and zone.width_m is None,
                f"has no column {' or '.join(assumed)}; set attribute to the column with the classes, or width_m",
            ),
            (
                zone.kind in ("pace", "factor") and not zone.classes and name is None and zone.value is None,
                f"has no {zone.kind}; set {key}, or attribute to the column that holds it",
            ),
        ):
            if is_wrong:
                raise TerrainError(f"{layer.what} {why}; it has the columns {self._listed()}")

    def _listed(self) -> str:
        columns = self._layer.columns
        return (", ".join(columns[:20]) + (" ..." if len(columns) > 20 else "")) or "none"

    def of(self, features: Features, placed: Shapes) -> Iterator[tuple[Any, str, Way, bool, bool]]:
        """Shapes of those features that count: (shape, id, width and factor, whether it is a bridge, whether all
        else is closed)."""
        ways: dict[tuple[int, bool], tuple[Way | None, bool, bool]] = {}
        for shape, n in zip(placed.shapes, placed.of.tolist(), strict=True):
            id = features.id(n)
            key = n, shape.geom_type == "Polygon"
            if key not in ways:
                tags = way_classes.unpacked(features.tags(n))
                if key[1]:  # an area has its own extent
                    tags = {name: value for name, value in tags.items() if not states_extent(name)}
                way = self._way(tags, id)
                bridge = way is not None and self._kind == "road" and way_classes.is_bridge(tags)
                self._facts.bridges += bridge
                inclusion = tags.get(INCLUSION, "yes" if self._zone.kind == "keep_in" else "no").lower()
                ways[key] = way, bridge, self.closes and inclusion in ("yes", "true", "1")
            way, bridge, inside = ways[key]
            if way is not None:
                if inside and not way.width_m and shape.geom_type != "Polygon":
                    raise TerrainError(f"{self._layer.what}: feature {id} keeps in, but is no area; remove it")
                yield shape, id, way, bridge, inside

    def _way(self, tags: dict[str, str], id: str) -> Way | None:
        """Width and factor of a feature; None if it is left out, which the facts then tell."""
        zone, kind = self._zone, self._kind
        name = way_classes.class_of(kind, tags, zone.attribute) if self._by_class else ""
        if name is None:
            self._facts.skip("without a class")
            return None
        if name:
            way = way_classes.way_of(kind, name, zone.classes)
            if way is None:
                self._facts.skip(f"of class {name[:40]}", id)
        elif zone.kind in ("pace", "factor") and zone.attribute is not None:
            way = self._stated(tags, id)
        else:
            way = Way(0.0, zone.value or 1.0)
        if way is None:
            return None
        if kind is not None and way_classes.is_tunnel(tags):
            self._facts.skip("below the ground", id)
            return None
        closes = self.closes or (kind == "water" and not name)
        try:
            own_m = way_classes.width_of(tags)
        except ValueError as error:
            if closes or kind == "water":
                raise unusable(self._layer.what, id, str(error)) from None
            own_m = None
        return Way(own_m or zone.width_m or way.width_m, None if closes else way.factor)

    def _stated(self, tags: dict[str, str], id: str) -> Way | None:
        """The value that a feature's own attribute states."""
        name = self._zone.attribute or ""
        stated = tags.get(name, "nothing")
        with contextlib.suppress(ValueError):
            if LEAST <= float(stated) <= MOST:
                return Way(0.0, float(stated))
        self._facts.skip(f"whose {name} is no {self._zone.kind} of {LEAST:g} to {MOST:g}", f"{id} ({stated[:40]})")
        return None

    def check_used(self) -> None:
        """Raises TerrainError if features are on the terrain, and none counts for what they are."""
        reasons = ", ".join(f"{count} {why}" for why, count in self._facts.skipped.most_common(4))
        if not self._facts.used:
            raise TerrainError(
                f"{self._layer.what}: none of its features on the terrain counts ({reasons}); set attribute and"
                f" classes; it has the columns {self._listed()}"
            )


# --- areas for orders -----------------------------------------------------------------------------------------


def outlines_of(zone: ZoneConfig, grid: GridSpec, most_corners: int) -> list[list[list[Corner]]]:
    """The areas that a zone's file closes, each as rings of corners (row, col): its border, then its holes.

    Areas that overlap are one.

    Parameters
    ----------
    most_corners : int
        Of one area.

    Raises
    ------
    TerrainError
        A scenario's zone would be refused with the same file, or an area has more than `most_corners` corners, or
        there are too many areas.
    """
    what = f"zone {zone.file}"
    return _outlines(draw_zone(zone, grid, what), grid, what, most_corners)


def all_but(corners: Sequence[Corner], grid: GridSpec, most_corners: int) -> list[list[list[Corner]]]:
    """The areas of a terrain outside of a polygon of corners (row, col), as `outlines_of` has them."""
    kept = shapely.Polygon([(col, row) for row, col in corners])
    if not kept.is_valid:
        raise TerrainError("the polygon which keeps in crosses itself")
    drawing = Drawing(FileFacts("", "", ""), kept=[Drawn(kept, 1.0, 0.0)])
    return _outlines(drawing, grid, "the polygon which keeps in", most_corners)


def _outlines(drawing: Drawing, grid: GridSpec, what: str, most_corners: int) -> list[list[list[Corner]]]:
    drawn = closed_shapes(drawing, grid)
    shapes = np.array([each.shape for each in drawn], object)
    halves = np.maximum([each.width_cells / 2 for each in drawn], _LEAST_HALF)
    areas = np.where(shapely.get_type_id(shapes) == POLYGON, shapes, shapely.buffer(shapes, halves))
    parts = shapely.get_parts(shapely.union_all(areas))
    if not len(parts):
        raise TerrainError(f"{what} holds no area on the terrain")
    if len(parts) > MOST_OUTLINES:
        raise TerrainError(f"{what} holds {len(parts)} areas; at most {MOST_OUTLINES} are ordered at once")
    return [_rings(part, what, most_corners) for part in parts]


def _rings(area: Any, what: str, most: int) -> list[list[Corner]]:
    count = 0
    for tolerance in _TOLERANCES_CELLS:
        rings = shapely.get_rings(shapely.simplify(area, tolerance))
        corners = [[(float(row), float(col)) for col, row in shapely.get_coordinates(ring)[:-1]] for ring in rings]
        count = sum(map(len, corners))
        if count <= most:
            return corners
    raise TerrainError(f"{what} holds an area of {count} corners, at most {most} are ordered; simplify it")
