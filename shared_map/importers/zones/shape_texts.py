"""Texts that hold shapes: their formats by their first bytes, and a check of all their numbers.

GDAL reads the shapes. It replaces or leaves out coordinates that it cannot read, without an error. Each text is
therefore checked before: a GeoJSON against the types below, an XML in its coordinates and references.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple
from xml.etree import ElementTree

import msgspec
from msgspec import Meta, Struct

from shared_map.importers.georeference import system_named
from shared_map.importers.raster_files import beginning, number_of, other_format
from swarm.config.input_files import FileKind
from swarm.errors import TerrainError


class Kind(NamedTuple):
    """A format: GDAL's driver, and how its text is checked; None of a binary format."""

    driver: str
    text: Literal["json", "xml", "fence"] | None = None


_MAGIC = {
    b"\0\0\x27\x0a": Kind("ESRI Shapefile"),
    b"fgb\x03fgb": Kind("FlatGeobuf"),
    b"{": Kind("GeoJSON", "json"),
    b"\x1e": Kind("GeoJSON", "json"),
    b"QGC WPL": Kind("GeoJSON", "fence"),
}
"""First bytes -> format. GDAL knows 80 formats, some of which name other files."""
_ROOTS = {b"kml": "LIBKML", b"gpx": "GPX", b"osm": "OSM"}
_ROOT = re.compile(rb"\s*(?:<\?.*?\?>\s*|<!--.*?-->\s*|<!DOCTYPE[^>\[]*>\s*)*<(?:\w+:)?(\w+)[\s/>]", re.DOTALL)
_SQLITE, _APPLICATION = b"SQLite format 3\0", slice(68, 70)
"""Beginning of a database, and where it says to which application it belongs: GP10, GP11 or GPKG."""


def kind_of(head: bytes) -> Kind | None:
    """The format of a file by its first bytes; None if it is not read."""
    if head.startswith(_SQLITE) and head[_APPLICATION] == b"GP":
        return Kind("GPKG")
    head = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    found = next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), None)
    root = _ROOT.match(head) if found is None else None
    return Kind(_ROOTS[root[1]], "xml") if root is not None and root[1] in _ROOTS else found


IN_ARCHIVES = (".shp", ".gpkg", ".geojson", ".json", ".kml", ".gpx", ".osm", ".fgb")


def is_vector(path: Path) -> bool:
    """Returns True if a file begins, or a .zip is, as one that holds features. False if it cannot be opened."""
    with contextlib.suppress(OSError, TerrainError):
        return kind_of(beginning(path, IN_ARCHIVES, FileKind.VECTORS, "")[0]) is not None
    return False


# --- GeoJSON ------------------------------------------------------------------------------------------------

Position = Annotated[list[float], Meta(min_length=2)]
_Ring = Annotated[list[Position], Meta(min_length=3)]
_Line = Annotated[list[Position], Meta(min_length=2)]
_Area = Annotated[list[_Ring], Meta(min_length=1)]


class _System(Struct, frozen=True):
    """Name of a system as GDAL reads it; it takes others for degrees."""

    type: Literal["name", "EPSG", "OGC"]
    properties: dict[str, str | int]

    def check(self, what: str) -> None:
        key, before = {"name": ("name", ""), "EPSG": ("code", "EPSG:"), "OGC": ("urn", "")}[self.type]
        system_named(f"{before}{self.properties.get(key, '')}", what)


class _Shape(Struct, tag_field="type", frozen=True, kw_only=True, omit_defaults=True):
    crs: _System | None = None


class Point(_Shape, frozen=True):
    coordinates: Position


class MultiPoint(_Shape, frozen=True):
    coordinates: Annotated[list[Position], Meta(min_length=1)]


class LineString(_Shape, frozen=True):
    coordinates: _Line


class MultiLineString(_Shape, frozen=True):
    coordinates: Annotated[list[_Line], Meta(min_length=1)]


class Polygon(_Shape, frozen=True):
    coordinates: _Area


class MultiPolygon(_Shape, frozen=True):
    coordinates: Annotated[list[_Area], Meta(min_length=1)]


class GeometryCollection(_Shape, frozen=True):
    geometries: Annotated[list[Geometry], Meta(min_length=1)]


Geometry = Point | MultiPoint | LineString | MultiLineString | Polygon | MultiPolygon | GeometryCollection


class Feature(_Shape, frozen=True):
    geometry: Geometry
    properties: msgspec.Raw = msgspec.Raw(b"null")
    id: msgspec.Raw = msgspec.Raw(b"null")


class _Document(Struct, frozen=True):
    """The outermost object, of which only features are looked at further."""

    type: str = ""
    features: list[msgspec.Raw] | None = None
    crs: _System | None = None
    name: str = ""
    fileType: str = ""  # noqa: N815


_document = msgspec.json.Decoder(_Document)
_feature = msgspec.json.Decoder(Feature | Geometry)
_lines = msgspec.json.Decoder(msgspec.Raw)
_LOOKED_AT = 4096
_RECORD = b"\x1e"
"""The sign before each feature of a GeoJSON text sequence."""


INCLUSION = "inclusion"
"""Column of a fence: yes if all but the area is closed."""


def checked_json(data: bytes, kind: Kind, what: str, name: str) -> bytes:
    """The features of a GeoJSON, a sequence of them, or a fence, as a GeoJSON for GDAL: every coordinate has been
    checked, and what has not been looked at, as a key that comes twice, is not in it.

    name  of the layer, if the file does not name it

    Raises TerrainError with one sentence, which names the first feature that cannot be read.
    """
    number, text = 0, data.removeprefix(b"\xef\xbb\xbf").replace(_RECORD, b"")
    try:
        if kind.text == "fence":
            return _collection(fence_of_waypoints(text.decode("ascii")), name)
        try:
            document = _document.decode(text)
        except msgspec.DecodeError as error:
            if "trailing characters" not in str(error):
                raise
            document = _Document(features=_lines.decode_lines(text))
        if document.fileType:
            return _collection(fence_of_plan(text), name)
        if document.type == "FeatureCollection" and not document.features:
            raise TerrainError(f"{what} holds no feature")
        if document.crs is not None:
            document.crs.check(f"{what}: its crs")
        features = []
        for number, each in enumerate(document.features or [msgspec.Raw(text)], 1):  # noqa: B007
            found = _feature.decode(each)
            feature = found if isinstance(found, Feature) else Feature(geometry=found)
            if not all(crs in (None, document.crs) for crs in (feature.crs, feature.geometry.crs)):
                raise ValueError("its crs is not that of the file")
            features.append(msgspec.Raw(msgspec.json.encode(feature)))
        return _collection(features, document.name or name, document.crs)
    except (msgspec.DecodeError, RecursionError, ValueError, OverflowError) as error:
        if other := other_format(data[:_LOOKED_AT]):
            raise TerrainError(f"{what} {other}") from error
        at = f"feature number {number} cannot be used: " if number else ""
        raise TerrainError(f"{what} is damaged: {at}{error}; repair or remove it") from error


# --- XML ----------------------------------------------------------------------------------------------------


_ONE_OF = {
    "Placemark": ("Point", "LineString", "LinearRing", "Polygon", "MultiGeometry", "Track", "MultiTrack", "Model"),
    "Polygon": ("outerBoundaryIs",),
    **dict.fromkeys(("outerBoundaryIs", "innerBoundaryIs"), ("LinearRing",)),
    **dict.fromkeys(("Point", "LineString", "LinearRing"), ("coordinates",)),
}
"""Elements of KML, and what each holds once."""


def checked_xml(data: bytes, what: str) -> None:
    """Checks every coordinate of a KML, a GPX or an OSM XML, and that no shape needs another file.

    Raises TerrainError with one sentence.
    """
    if b"<OGR" in data or b"<VRT" in data:
        raise TerrainError(f"{what} names other files, which are not read")
    ends: dict[str | None, tuple[str | None, str | None]] = {}
    rings: dict[str | None, list[str | None]] = {}
    known: set[tuple[str, str | None]] = set()
    needed: dict[tuple[str, str | None], str] = {}
    try:
        for _, element in ElementTree.iterparse(io.BytesIO(data)):
            name = element.tag.rpartition("}")[2]
            places: list[list[str]] = []
            if name == "coordinates":
                text = re.sub(r"\s*,\s*", ",", "".join(element.itertext()).strip())
                places = [place.split(",") for place in text.split()] or [[]]
            elif name == "coord":
                places = [(element.text or "").split()]
            elif name in ("wpt", "rtept", "trkpt", "node"):
                places = [[element.get("lon", ""), element.get("lat", "")]]
            for place in places:
                with contextlib.suppress(ValueError):
                    if len(place) in (2, 3) and math.isfinite(sum(map(number_of, place))):
                        continue
                raise TerrainError(f"{what} is damaged: {name} holds {','.join(place)[:60]!r}, expected numbers")
            held = [inner.tag.rpartition("}")[2] for inner in element]
            parts = _ONE_OF.get(name, ())
            if parts and (count := sum(map(held.count, parts))) != 1:  # of several, GDAL reads the last
                raise TerrainError(f"{what} is damaged: a {name} holds {count} of {', '.join(parts)}, expected one")
            if name == "rotation" and number_of(element.text or "0"):  # GDAL reads the overlay as if it were not
                raise TerrainError(f"{what} has a turned overlay, which is not read; draw its area")
            if name == "NetworkLink":
                raise TerrainError(f"{what} has a NetworkLink, which is not followed; save its areas in one file")
            if name == "way":
                nodes = [inner.get("ref") for inner in element if inner.tag == "nd"]
                if len(nodes) == 1:
                    raise TerrainError(f"{what} is damaged: way {element.get('id')} has one node; repair it")
                if nodes:
                    ends[element.get("id")] = nodes[0], nodes[-1]
            if name == "relation" and _is_area(element):
                ways = [inner.get("ref") for inner in element if inner.get("type") == "way"]
                rings[element.get("id")] = ways
            if name in ("node", "way"):
                known.add((name, element.get("id")))
            for inner in element if name in ("way", "relation") else ():
                kind = {"nd": "node", "member": inner.get("type")}.get(inner.tag)
                if kind in ("node", "way") and (name == "way" or _is_area(element)):
                    needed[kind, inner.get("ref")] = f"{name} {element.get('id')}"
            if name not in ("nd", "member", "tag"):
                element.clear()
    except ElementTree.ParseError as error:
        raise TerrainError(f"{what} is damaged: {error}") from error
    for area, ways in rings.items():
        met = Counter(end for way in ways for end in ends.get(way, ()))
        if any(count % 2 for count in met.values()):  # GDAL leaves it out
            raise TerrainError(f"{what}: relation {area} cannot be used: its ways form no closed ring; repair it")
    for absent in needed.keys() - known:
        user = needed[absent]
        raise TerrainError(f"{what} is not complete: {user} needs {absent[0]} {absent[1]}")


def _is_area(relation: ElementTree.Element) -> bool:
    return any(tag.get("k") == "type" and tag.get("v") in ("multipolygon", "boundary") for tag in relation)


# --- fences of ground stations ------------------------------------------------------------------------------


class _PlanPolygon(Struct, frozen=True):
    polygon: _Ring
    inclusion: bool


class _Centre(Struct, frozen=True):
    center: Position
    radius: Annotated[float, Meta(gt=0)]


class _PlanCircle(Struct, frozen=True):
    circle: _Centre
    inclusion: bool


class _Fence(Struct, frozen=True):
    polygons: list[_PlanPolygon]
    circles: list[_PlanCircle]


class _Plan(Struct, frozen=True):
    geoFence: _Fence  # noqa: N815


def fence_of_plan(data: bytes) -> list[dict[str, Any]]:
    """The fence of a QGroundControl .plan as features of a GeoJSON."""
    fence = msgspec.json.decode(data, type=_Plan).geoFence
    areas = [_area(each.polygon, each.inclusion) for each in fence.polygons]
    return areas + [_disc(each.circle.center, each.circle.radius, each.inclusion) for each in fence.circles]


def fence_of_waypoints(text: str) -> list[dict[str, Any]]:
    """The fence of a Mission Planner .waypoints as features of a GeoJSON; of a mission, the line of its places.

    Raises ValueError if a row is damaged.
    """
    rows = [[number_of(word) for word in line.split()] for line in text.splitlines()[1:] if line.strip()]
    if not all(len(row) == 12 and math.isfinite(sum(row)) and row[3] % 1 == 0 for row in rows):
        raise ValueError("a row does not have 12 numbers, the fourth a whole one")
    found: list[dict[str, Any]] = []
    path: list[list[float]] = []
    while rows:
        command, extent, place = int(rows[0][3]), rows[0][4], rows[0][8:10]
        if command in (_POLYGON_IN, _POLYGON_OUT):
            count = int(extent)
            ring = rows[: max(count, 0)]
            if not 3 <= count == extent <= len(rows) or [row[3:5] for row in ring] != [rows[0][3:5]] * count:
                raise ValueError(f"a fence polygon of {extent:g} corners has not as many")
            found.append(_area([row[8:10] for row in ring], command == _POLYGON_IN))
            del rows[: count - 1]
        elif command in (_CIRCLE_IN, _CIRCLE_OUT):
            if not extent > 0:
                raise ValueError(f"a fence circle has the radius {extent:g}")
            found.append(_disc(place, extent, command == _CIRCLE_IN))
        elif command <= _LAST_NAV and any(place) and rows[0][0] > 0:  # row 0 is where it starts from
            path.append(place[::-1])
        del rows[0]
    if len(path) > 1:
        found.append({"type": "Feature", "properties": {}, "geometry": LineString(coordinates=path)})
    return found


_LAST_NAV = 95
_POLYGON_IN, _POLYGON_OUT, _CIRCLE_IN, _CIRCLE_OUT = 5001, 5002, 5003, 5004
"""MAVLink's commands of fences; those of routes are below."""


def _area(ring: list[list[float]], inside: bool) -> dict[str, Any]:
    corners = [[lon, lat] for lat, lon, *_ in ring]
    return _fence(Polygon(coordinates=[[*corners, corners[0]]]), inside)


def _disc(centre: list[float], radius_m: float, inside: bool) -> dict[str, Any]:
    return _fence(Point(coordinates=[centre[1], centre[0]]), inside, radius=max(round(radius_m, 3), 0.001))


def _fence(shape: Geometry, inside: bool, **extent: float) -> dict[str, Any]:
    return {"type": "Feature", "properties": {INCLUSION: "yes" if inside else "no", **extent}, "geometry": shape}


def _collection(features: Sequence[object], name: str, crs: _System | None = None) -> bytes:
    return msgspec.json.encode({"type": "FeatureCollection", "name": name, "crs": crs, "features": features})
