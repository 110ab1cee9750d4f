"""Features of a file of shapes, by GDAL: bounded before anything is made of them, and none is lost.

GDAL replaces or leaves out coordinates of texts that it cannot read, without an error. Each text is therefore
checked before: a GeoJSON against the types below, an XML in its coordinates and references. Fences of ground
stations become a GeoJSON.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple
from xml.etree import ElementTree

import msgspec
import numpy as np
import pyogrio
import shapely
from msgspec import Meta, Struct
from numpy.typing import NDArray
from pyogrio.raw import read

from shared_map.importers.gdal_rasters import DRAWINGS, beginning, faults_of, is_raster, number_of, other_format
from shared_map.importers.georeference import system_named
from swarm.config.explain import nearest
from swarm.config.input_files import FileKind, check_bytes, read_bytes, size
from swarm.errors import TerrainError

_CHUNK = 100_000
"""Features which are read at once."""
_TOGETHER = DRAWINGS["together"]
_OPTIONS = {
    "OSM_USE_CUSTOM_INDEXING": "NO",  # which takes new, negative ids for damage
    "OSM_MAX_TMPFILE_SIZE": "1",  # MB, which each opening clears: 0.06 s; the 100 of GDAL take 0.35 s
    "CPL_TMPDIR": tempfile.gettempdir(),  # otherwise the folder of the user
}
_IDS = ("id", "@id", "osm_id", "osm_way_id", "full_id")
_POLYGONS = 3
"""shapely's number of a polygon: those of collections are higher."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Metadata of a layer.

    source   GDAL's name of the file, or its content as GeoJSON
    what     name in sentences
    index    its number in the file
    name     its name in the file
    crs      as the file has it; empty if it has none
    columns  names of its attributes
    count    features which the file says that it holds; -1 if it does not
    """

    source: str | bytes
    what: str
    index: int
    name: str
    crs: str
    columns: tuple[str, ...]
    count: int


@dataclass(frozen=True, eq=False)
class Features:
    """Some features of a layer, in its own coordinates. Each has a shape, all of whose coordinates are finite.

    numbers  int64 (n,), in the file
    columns  name -> attributes of each
    shapes   shapely points, lines and polygons without heights, curves made of lines
    of       int64, the feature which each shape is a part of
    closed   those with a ring whose last corner was not its first
    """

    numbers: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]
    shapes: NDArray[Any]
    of: NDArray[np.int64]
    closed: NDArray[np.int64]

    def tags(self, feature: int) -> dict[str, str]:
        """Attributes as texts, without those that are not set."""
        values = {name: column[feature] for name, column in self.columns.items()}
        texts = {name: "" if value is None else str(value) for name, value in values.items()}
        return {name: text for name, text in texts.items() if text not in ("", "nan", "NaT")}

    def id(self, feature: int) -> str:
        """The name of a feature to people, such as way/4711, or its number in the file."""
        tags = self.tags(feature)
        return next((tags[name] for name in _IDS if name in tags), str(self.numbers[feature]))[:60]


def open_layers(path: Path, layer: str | None, what: str) -> list[Layer]:
    """The layer that is named, or the one of a file, or those which are one drawing.

    Raises TerrainError with one sentence, which `what` begins, if the file is missing, too large, damaged, of
    another kind, or holds several layers and none is named.
    """
    source, kind = _source(path, what)
    pyogrio.set_gdal_config_options(_OPTIONS)
    least = _check_index(path, source, what) if kind.driver == "ESRI Shapefile" else 0
    with faults_of(f"{what} is damaged"):
        listed = pyogrio.list_layers(source)
        known = [str(name) for name, shape in listed if shape is not None]
        if not known:
            raise TerrainError(f"{what} has no layer of shapes")
        choices = ", ".join(known[:12]) + (" ..." if len(known) > 12 else "")
        if layer is not None and layer not in known:
            raise TerrainError(f"{what} has no layer {layer!r}, only {choices}{nearest(layer, known)}")
        names = [layer] if layer is not None else known
        if layer is None and kind.driver in _TOGETHER:
            names = [name for name in known if name in _TOGETHER[kind.driver] or not _TOGETHER[kind.driver]]
        elif len(names) > 1:
            raise TerrainError(f"{what} has {len(known)} layers; set layer to one of {choices}")
        found = []
        for name in names:
            if kind.driver == "GPKG":  # a view is a program, which may not end
                quoted = name.replace("'", "''")
                held = read(source, sql=f"SELECT type FROM sqlite_master WHERE name = '{quoted}'")[3][0]
                if held.tolist() not in ([], ["table"]):
                    found_is = f"is a {held[0]}, expected a table; ogr2ogr makes a copy of it"
                    raise TerrainError(f"{what}: layer {name!r} {found_is}")
            index = listed[:, 0].tolist().index(name)
            # Those of an OSM are known after all of it has been read.
            info = pyogrio.read_info(source, layer=index, force_feature_count=kind.driver != "OSM")
            count = -1 if kind.driver == "OSM" else max(int(info["features"]), least)  # the index may say less
            columns = tuple(str(field) for field in info["fields"])
            found.append(Layer(source, what, index, name, str(info["crs"] or ""), columns, count))
        return found


def read_features(layer: Layer, columns: Sequence[str]) -> Iterator[Features]:
    """All features of a layer, some at a time.

    Raises TerrainError, which names the feature, if one has no shape, or a part of it none, or a coordinate is no
    number: GDAL leaves out of a shape what it cannot read. Raises it if the file is damaged.
    """
    wanted = [name for name in dict.fromkeys((*columns, *_IDS)) if name in layer.columns]
    for first in range(0, 1 << 31, _CHUNK):
        with faults_of(f"{layer.what} is damaged"), np.errstate(all="ignore"):
            part = {"layer": layer.index, "columns": wanted, "skip_features": first, "max_features": _CHUNK}
            meta, numbers, stored, fields = read(layer.source, force_2d=True, return_fids=True, **part)
            geometries = shapely.from_wkb(stored, on_invalid="ignore")
            unclosed = np.flatnonzero(shapely.is_missing(geometries))
            geometries[unclosed] = shapely.from_wkb(stored[unclosed], on_invalid="fix")
        columns_read = dict(zip(map(str, meta["fields"]), fields, strict=True))
        shapes, of = parts_of(geometries)
        bad: dict[int, str] = {
            int(n): "it has no shape, or one that is not read, such as a LinearRing or TIN"
            for n in np.flatnonzero(shapely.is_missing(geometries))
        }
        bad |= {int(n): "it, or a part of it, has no corners" for n in of[shapely.is_empty(shapes)]}
        corners, at = shapely.get_coordinates(shapes, return_index=True)
        bad |= {int(n): "its coordinates are no numbers" for n in of[at[~np.isfinite(corners).all(axis=1)]]}
        features = Features(numbers, columns_read, shapes, of, unclosed)
        for n, why in sorted(bad.items()):
            raise unusable(layer.what, features.id(n), why)
        yield features
        if len(numbers) < _CHUNK:
            if (count := first + len(numbers)) != layer.count >= 0:
                raise TerrainError(f"{layer.what} is damaged: of its {layer.count} features {count} are read")
            return


def unusable(what: str, id: str, why: str) -> TerrainError:
    return TerrainError(f"{what}: feature {id} cannot be used: {why}; repair or remove it")


def parts_of(geometries: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Points, lines and polygons that geometries consist of, empty ones too, and of which each is a part."""
    of = np.arange(len(geometries))
    parts = np.asarray(geometries, object)
    while (several := (shapely.get_type_id(parts) > _POLYGONS) & ~shapely.is_empty(parts)).any():
        inner, index = shapely.get_parts(parts[several], return_index=True)
        of = np.concatenate([of[~several], of[several][index]])
        parts = np.concatenate([parts[~several], inner])
    order = np.argsort(of, kind="stable")
    present = order[~shapely.is_missing(parts[order])]
    return parts[present], of[present]


# --- which file ---------------------------------------------------------------------------------------------


class Kind(NamedTuple):
    """A format: GDAL's driver, and how its text is checked, as `formats.toml` says; empty of a binary format."""

    driver: str
    text: str


# Atomic: what is skipped before the root is read in one way only, or a few hundred bytes would take for ever.
_BEFORE_ROOT = r"(?:(?><\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>\[]*>)\s*)*+"


def kind_of(head: bytes) -> Kind | None:
    """The format of a file by its first bytes; None if it is not read."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().decode("latin-1")
    rows = ((begins.replace("BEFORE_ROOT", _BEFORE_ROOT), row) for begins, row in DRAWINGS["begins"].items())
    return next((Kind(*row) for begins, row in rows if re.match(begins, text, re.DOTALL)), None)


def _source(path: Path, what: str) -> tuple[str | bytes, Kind]:
    """Returns GDAL's name for a file, whose text is checked, or its content as GeoJSON. Raises TerrainError on a
    file of another kind."""
    check_bytes(path, FileKind.VECTORS, what)
    try:
        head, member, length = beginning(path, DRAWINGS["zipped"], FileKind.VECTORS, what)
    except OSError as error:
        raise FileKind.VECTORS.unreadable(path, error) from error
    kind = kind_of(head)
    if kind is None:
        if path.suffix.lower() in (".dbf", ".shx", ".prj"):
            raise TerrainError(f"{what} is a part of a Shapefile; name the .shp beside it")
        if is_raster(path):
            raise TerrainError(f"{what} is read as a raster, which goes with kind pace or factor of a scenario")
        neither = f"is neither {DRAWINGS['names']}, nor a .zip of one"
        raise TerrainError(f"{what} {other_format(head, neither)}")
    absolute = path.resolve()
    source = str(absolute) if member is None else f"/vsizip/{{{absolute}}}/{member}"
    if not kind.text:
        return f"GPKG:{source}" if kind.driver == "GPKG" and member is None else source, kind
    if length > FileKind.VECTOR_TEXT.most_bytes:
        most = f"at most {size(FileKind.VECTOR_TEXT.most_bytes)} of text are read"
        raise FileKind.VECTOR_TEXT.refusal(path, f"{member or 'it'} has {size(length)}; {most}")
    data = _read(_part(path, member), FileKind.VECTOR_TEXT)
    if kind.text == "xml":
        checked_xml(data, what)
        return source, kind
    return checked_json(data, kind, what, path.stem.encode("utf-8", "replace").decode()), kind


def _check_index(path: Path, source: str | bytes, what: str) -> int:
    """The number of shapes of a Shapefile, whose index must be its own: GDAL reads whatever lies where it says."""
    named = _part(path, str(source).partition("}/")[2])
    beside = [each for ending in ("shx", "SHX") if (each := named.parent / f"{named.stem}.{ending}").exists()]
    if not beside:
        raise TerrainError(f"{what} lacks {named.stem}.shx, its index: copy it, too, or ask for a GeoPackage")
    shapes, index = (np.frombuffer(_read(part, FileKind.VECTORS), np.uint8) for part in (named, beside[0]))
    at, length = 2 * index[100:][: len(index[100:]) // 8 * 8].view(">i4").reshape(-1, 2).T.astype(np.int64)
    end, ends = 2 * int(shapes[24:28].view(">i4")[0]), at + 8 + length
    inside = (at >= 100).all() and (length >= 4).all() and end <= ends.max(initial=100) <= len(shapes)
    heads = shapes[at[:, None] + np.arange(4, 8)] if inside else np.zeros((0, 4), np.uint8)
    if not np.array_equal(2 * heads.view(">i4")[:, 0], length):
        raise TerrainError(f"{what} is damaged: its .shx is that of another file; make both again")
    return len(at)


def _part(path: Path, member: str | None) -> Any:
    """A file, or one in a .zip."""
    return zipfile.Path(path, member) if member else path


def _read(part: Any, kind: FileKind) -> bytes:
    return read_bytes(part, kind) if isinstance(part, Path) else part.read_bytes()


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


_feature = msgspec.json.Decoder(Feature | Geometry)
_LOOKED_AT = 4096
"""Bytes in which the beginning of another format is looked for."""


INCLUSION = "inclusion"
"""Column of a fence: yes if all but the area is closed."""


def checked_json(data: bytes, kind: Kind, what: str, name: str) -> bytes:
    """The features of a GeoJSON, a sequence of them, or a fence, as a GeoJSON for GDAL: every coordinate has been
    checked, and what has not been looked at, as a key that comes twice, is not in it.

    name  of the layer, if the file does not name it

    Raises TerrainError with one sentence, which names the first feature that cannot be read.
    """
    # Of a GeoJSON text sequence each feature begins with the sign 1E.
    number, text = 0, data.removeprefix(b"\xef\xbb\xbf").replace(b"\x1e", b"")
    try:
        if kind.text == "fence":
            return _collection(fence_of_waypoints(text.decode("ascii")), name)
        try:
            document = msgspec.json.decode(text, type=_Document)
        except msgspec.DecodeError as error:
            if "trailing characters" not in str(error):
                raise
            document = _Document(features=msgspec.json.Decoder(msgspec.Raw).decode_lines(text))
        if document.fileType:
            fence = msgspec.json.decode(text, type=_Plan).geoFence
            areas = [_area(each.polygon, each.inclusion) for each in fence.polygons]
            discs = [_disc(each.circle.center, each.circle.radius, each.inclusion) for each in fence.circles]
            return _collection([*areas, *discs], name)
        if document.type == "FeatureCollection" and not document.features:
            raise TerrainError(f"{what} holds no feature or fence")
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


_ONE_OF, _AREA_TAGS = DRAWINGS["kml_one_of"], DRAWINGS["osm_areas"]


def checked_xml(data: bytes, what: str) -> None:
    """Checks every coordinate of a KML, a GPX or an OSM XML, and that no shape needs another file.

    Raises TerrainError with one sentence.
    """
    if b"<OGR" in data or b"<VRT" in data:
        raise TerrainError(f"{what} names other files, which are not read")
    ends: dict[str | None, list[str | None]] = {}
    rings: dict[str | None, list[str | None]] = {}
    open_areas: set[str | None] = set()
    known: set[tuple[str, str | None]] = set()
    needed: dict[tuple[str, str | None], str] = {}
    try:
        for _, element in ElementTree.iterparse(io.BytesIO(data)):
            name = element.tag.rpartition("}")[2]
            if name in ("nd", "member", "tag"):  # of which the element around them is asked
                continue
            places: list[list[str]] = []
            if name == "coordinates":
                # A match begins at the first blank of a run only: the time grows with the text, not its square.
                text = re.sub(r"(?<!\s)\s*,\s*", ",", "".join(element.itertext()).strip())
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
            one_of = _ONE_OF.get(name, ())
            if one_of and (count := sum(map(held.count, one_of))) != 1:  # of several, GDAL reads the last
                raise TerrainError(f"{what} is damaged: a {name} has {count} of {', '.join(one_of)}, expected one")
            if name == "rotation" and number_of(element.text or "0"):  # GDAL reads the overlay as if it were not
                raise TerrainError(f"{what} has a turned overlay, which is not read; draw its area")
            if name == "NetworkLink":
                raise TerrainError(f"{what} has a NetworkLink, which is not followed; save its areas in one file")
            id, tags = element.get("id"), _AREA_TAGS.get(name, ())
            if element.get("action") == "delete" or element.get("visible") == "false":
                raise TerrainError(
                    f"{what}: {name} {id} is deleted, but still in the file; download the area again"
                )
            is_area = any([inner.get("k"), inner.get("v")] in tags for inner in element)
            if name in ("node", "way"):
                known.add((name, id))
            if name == "way" or is_area:
                parts = [(inner.get("type", "node"), inner.get("ref")) for inner in element if inner.tag != "tag"]
                needed |= {part: f"{name} {id}" for part in parts if part[0] in ("node", "way")}
                refs = [ref for kind, ref in parts if kind == ("node" if name == "way" else "way")]
            if name == "way":
                if len(refs) == 1:
                    raise TerrainError(f"{what} is damaged: way {id} has one node; repair it")
                ends[id] = refs[:1] + refs[-1:]
                if is_area and refs[:1] != refs[-1:]:
                    open_areas.add(id)
            elif is_area:
                rings[id] = refs
            element.clear()
    except ElementTree.ParseError as error:
        raise TerrainError(f"{what} is damaged: {error}") from error
    for area in open_areas.difference(*rings.values()):  # GDAL makes lines of them
        raise TerrainError(f"{what}: way {area} is an area, but its ring is not closed; repair it")
    for area, ways in rings.items():
        met = Counter(end for way in ways for end in ends.get(way, ()))
        if any(count % 2 for count in met.values()):  # GDAL leaves it out
            raise TerrainError(f"{what}: relation {area} cannot be used: its ways form no closed ring; repair it")
    for absent in needed.keys() - known:
        raise TerrainError(f"{what} is not complete: {needed[absent]} needs {absent[0]} {absent[1]}")


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
"""MAVLink's commands up to this one (MAV_CMD_NAV_LAST) are places on a route."""
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
