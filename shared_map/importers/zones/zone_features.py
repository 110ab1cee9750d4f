"""Features of a zone's file: which of them count, what they are worth by the classes of ways (OpenStreetMap's tags
of roads and water), and their areas for orders.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from shared_map.importers.zones.burn_shapes import POLYGON, Drawn, Placing
from shared_map.importers.zones.vector_files import INCLUSION, Features, Layer, open_layers, read_features, unusable
from shared_map.importers.zones.zone_files import LEAST, MOST, FileFacts
from swarm.config.ground import WayConfig, ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec

Kind = Literal["road", "water"]


@dataclass(frozen=True, slots=True)
class Way:
    """A class of roads or water.

    width_m  of its lines, in metres; areas have their own
    factor   of a road relative to the road pace, of water to the ground; None is lethal
    """

    width_m: float
    factor: float | None


_TABLES = tomllib.loads((Path(__file__).parent / "ways.toml").read_text(encoding="utf-8"))
_EXTENTS: Mapping[str, Sequence[float]] = _TABLES.pop("extents")
"""Columns for the extent of points and lines, in any letter case -> (width / value, largest width in metres)."""
_UNCLEAR: Mapping[str, Sequence[str]] = _TABLES.pop("unclear")
COLUMNS: Mapping[Kind, Sequence[str]] = _TABLES.pop("columns")
"""Columns of the class, by the kind of zone."""


BUILT_IN: Mapping[str, Mapping[str, Way]] = {
    kind: {name: Way(width_m, None if factor == "lethal" else factor) for name, (width_m, factor) in rows.items()}
    for kind, rows in _TABLES.items()
}
TAGS = ("bridge", "tunnel", "area", "inclusion")
PACKED = ("other_tags", "tags")
"""Columns that hold further tags: as GDAL writes them, or JSON."""

_VARIANT = re.compile(r"(_link|_grade[1-5])$")
_NO = ("no", "0", "f", "false")
_NOT_A_BRIDGE = (*_NO, "aqueduct")
_PAIR = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')
_LENGTH = re.compile(r"\s*(\d{1,9}(?:[.,]\d{1,9})?)\s*(m|metres|meters|km|ft|feet|')?\s*")
_UNITS_M = {"km": 1000.0, "ft": 0.3048, "feet": 0.3048, "'": 0.3048}


def unpacked(row: Mapping[str, str]) -> dict[str, str]:
    """Returns the tags of a feature: its columns, and those that are packed into one. A column of its own counts
    more."""
    tags: dict[str, str] = dict(_PAIR.findall(row.get("other_tags", "")))
    with contextlib.suppress(ValueError, RecursionError, AttributeError):  # it is no object of JSON
        known = json.loads(row.get("tags", "")).items()
        tags = {key: str(value) for key, value in known if isinstance(value, str | int | float)} | tags
    return tags | {key: value for key, value in row.items() if key not in PACKED}


def class_of(kind: Kind | None, tags: Mapping[str, str], attribute: str | None) -> str | None:
    """The class of a feature; None if it says none."""
    if attribute is not None or kind is None:
        return tags.get(attribute or "")
    for column in COLUMNS[kind]:
        found = tags.get(column)
        if found is not None and (column not in ("natural", "landuse") or found in BUILT_IN["water"]):
            return found
    return None


def way_of(kind: Kind | None, name: str, own: Mapping[str, WayConfig]) -> Way | None:
    """Returns the cost of a class, by the user's table, then by the built-in one of a kind; None if it is left
    out."""
    known = None if kind is None else BUILT_IN[kind].get(_VARIANT.sub("", name))
    given = own.get(name)
    if given is None:
        return known
    if given.factor == "ignored":
        return None
    width_m = given.width_m if given.width_m is not None else known.width_m if known is not None else 0.0
    return Way(width_m, None if given.factor == "lethal" else given.factor)


def states_extent(column: str, of_point: str = "") -> bool:
    """Returns True if a column states how far a point or a line reaches, in a unit that is read or not.

    of_point  what the column holds for a point, of which any number in it may be the reach
    """
    name, is_number = column.lower(), of_point.strip(" 0.,+-")[:1].isdigit()
    words = re.split(r"[\W\d_]+|(?<=[a-z])(?=[A-Z])", column) if is_number else ()
    may = any(word.lower() in _UNCLEAR["of_points"] for word in words)
    return may or name in _EXTENTS or any(word in name for word in _UNCLEAR["anywhere"])


def width_of(tags: Mapping[str, str], *, is_point: bool = False) -> float | None:
    """The width in metres that a feature has of its own; of "2-4 m" the larger.

    Raises ValueError, which names the column, if it states an extent that cannot be read.
    """
    stated = {key.lower(): value for key, value in tags.items() if states_extent(key, value * is_point)}
    for key in sorted(stated, key=lambda key: [*_EXTENTS, key].index(key)):
        lengths = [_LENGTH.fullmatch(part) for part in re.split("[;-]", stated[key])]
        found = [float(each[1].replace(",", ".")) * _UNITS_M.get(each[2], 1.0) for each in lengths if each]
        over, most_m = _EXTENTS.get(key, (math.nan, 0.0))
        if len(found) < len(lengths) or not max(found) * over <= most_m:
            raise ValueError(f"its {key} is {stated[key][:40]!r}, expected metres as radius, diameter or width")
        if max(found) > 0:
            return max(found) * over
    return None


_WIDEST_M = 1000.0
"""Lines that run so far outside the terrain are of no use to it."""
Corner = tuple[float, float]
MOST_OUTLINES = 50
"""Areas of one order, each of which is a zone of its own. Chosen, not measured."""
_LEAST_HALF = 0.71
"""Half the least width of a line or a point in cells: the middle of each cell that it crosses is within it, and an
order closes a cell by its middle."""
_TOLERANCES_CELLS = (0.01, 0.05, 0.1, 0.25)
"""Tolerances for dropped corners, tried in order until few enough are left."""


@dataclass(eq=False)
class Drawing:
    """Shapes of a zone's file on a grid, in cells.

    values   with a factor or pace
    lethal   closed, each with its width
    kept     all else is closed
    bridges  of roads
    keeps    whether the file keeps in, be it by nothing on the terrain
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
    drawing, faults = Drawing(facts), []
    for layer in layers:
        worth = _Worth(zone, grid, layer, drawing)
        placing = Placing(grid, layer, zone.crs, _margin_m(zone, layer), facts)
        for features in read_features(layer, worth.columns):
            worth.draw(features, *placing.place(features))
        try:
            placing.check_touched()
        except TerrainError as error:
            faults.append(error)
    if len(faults) == len(layers):
        raise faults[0]
    worth.check_used()
    return drawing


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
                widths.append(width_of(features.tags(n)) or 0.0)
    return max(widths) / 2


class _Worth:
    """Cost of each feature of a zone.

    Raises TerrainError if the zone does not say how to tell.
    """

    def __init__(self, zone: ZoneConfig, grid: GridSpec, layer: Layer, drawing: Drawing) -> None:
        self._zone, self._grid, self._layer, self._drawing = zone, grid, layer, drawing
        self._facts = drawing.facts
        self._closes = zone.kind in ("forbidden", "keep_in")
        self._kind: Kind | None = zone.kind if zone.kind in ("road", "water") else None
        name, assumed = zone.attribute, [] if self._kind is None else COLUMNS[self._kind]
        has_classes = name is not None or not {*assumed, *PACKED}.isdisjoint(layer.columns)
        self._by_class = bool(zone.classes) or (self._kind is not None and has_classes)
        key = "factor" if zone.kind == "factor" else "pace_s_per_m"
        extents = [column for column in layer.columns if states_extent(column, "1")]
        self.columns = [*TAGS, *PACKED, *assumed, *extents, *([name] if name else ())]
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

    def draw(self, features: Features, shapes: NDArray[Any], of: NDArray[np.int64]) -> None:
        """Adds the shapes of those features that count; `of` says which feature each is a part of."""
        drawing, used = self._drawing, set()
        if self._closes:
            drawing.keeps |= bool((features.columns.get(INCLUSION, np.zeros(0, object)) == "yes").any())
        ways: dict[tuple[int, str], tuple[Way | None, bool, bool]] = {}
        for shape, n in zip(shapes, of.tolist(), strict=True):
            is_area, key = shape.geom_type == "Polygon", (n, shape.geom_type)
            if key not in ways:
                tags = unpacked(features.tags(n))
                way = self._way(tags, features.id(n), shape.geom_type)
                over = tags.get("bridge", "no").lower() not in _NOT_A_BRIDGE
                bridge = way is not None and self._kind == "road" and over
                self._facts.bridges += bridge
                inclusion = tags.get(INCLUSION, "yes" if self._zone.kind == "keep_in" else "no").lower()
                ways[key] = way, bridge, self._closes and inclusion in ("yes", "true", "1")
            way, bridge, inside = ways[key]
            if way is None:
                continue
            if inside and not way.width_m and not is_area:
                id = features.id(n)
                raise TerrainError(f"{self._layer.what}: feature {id} keeps in, but is no area; remove it")
            used.add(n)
            drawn = Drawn(shape, way.factor or 1.0, way.width_m / self._grid.resolution_m)
            closing = drawing.kept if inside else drawing.lethal
            (closing if way.factor is None else drawing.values).append(drawn)
            if bridge:
                drawing.bridges.append(drawn)
        self._facts.used += len(used)

    def _way(self, tags: dict[str, str], id: str, geometry: str) -> Way | None:
        """Width and factor of a feature; None if it is left out, which the facts then tell."""
        zone, kind = self._zone, self._kind
        name = class_of(kind, tags, zone.attribute) if self._by_class else ""
        if name is None:
            self._facts.skip("without a class")
            return None
        if name:
            way = way_of(kind, name, zone.classes)
            if way is None:
                self._facts.skip(f"of class {name[:40]}", id)
        elif zone.kind in ("pace", "factor") and zone.attribute is not None:
            way = self._stated(tags, id)
        else:
            way = Way(0.0, zone.value or 1.0)
        if way is None:
            return None
        if kind is not None and tags.get("tunnel", "no").lower() not in _NO:  # a map of one level has no place
            self._facts.skip("below the ground", id)
            return None
        closes = self._closes or (kind == "water" and not name)
        try:
            # An area has its own extent.
            is_point = geometry == "Point" and zone.width_m is None
            own_m = None if geometry == "Polygon" else width_of(tags, is_point=is_point)
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
    what = f"zone {Path(zone.file or '')}"
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
