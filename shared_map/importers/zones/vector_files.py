"""Features of a file of shapes, by GDAL: bounded before anything is made of them, and none is lost.

pyogrio and shapely are imported where they are used: agents never need them.
"""

from __future__ import annotations

import contextlib
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import shapely
from numpy.typing import NDArray
from pyogrio.raw import read

from shared_map.importers.raster_files import LONGEST_REASON, beginning, other_format
from shared_map.importers.zones.shape_texts import IN_ARCHIVES, Kind, checked_json, checked_xml, kind_of
from swarm.config.explain import nearest
from swarm.config.input_files import FileKind, check_bytes, read_bytes, size
from swarm.errors import SwarmError, TerrainError

_CHUNK = 100_000
"""Features which are read at once."""
_TOGETHER = {"LIBKML": None, "GPX": {"waypoints", "routes", "tracks"}, "OSM": {"points", "lines", "multipolygons"}}
"""Formats whose layers are one drawing, and the layers which hold it; None: all."""
_IDS = ("id", "@id", "osm_id", "osm_way_id", "full_id")
_POLYGONS = 3


@dataclass(frozen=True, eq=False)
class Layer:
    """Metadata of a layer.

    source   GDAL's name of the file, or its content as GeoJSON
    what     name in sentences
    index    its number in the file
    crs      as the file has it; empty if it has none
    columns  names of its attributes
    count    features which the file says that it holds
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
    pyogrio.set_gdal_config_options({"OSM_USE_CUSTOM_INDEXING": "NO"})  # which takes new, negative ids for damage
    with _refused(what):
        listed = pyogrio.list_layers(source)
        known = [str(name) for name, shape in listed if shape is not None]
        if not known:
            raise TerrainError(f"{what} has no layer of shapes")
        shown = ", ".join(known[:12]) + (" ..." if len(known) > 12 else "")
        if layer is not None and layer not in known:
            raise TerrainError(f"{what} has no layer {layer!r}, only {shown}{nearest(layer, known)}")
        names = [layer] if layer is not None else known
        if layer is None and kind.driver in _TOGETHER:
            names = [name for name in known if name in (_TOGETHER[kind.driver] or known)]
        elif len(names) > 1:
            raise TerrainError(f"{what} has {len(known)} layers; set layer to one of {shown}")
        found = []
        for name in names:
            if kind.driver == "GPKG":  # a view is a program, which may not end
                quoted = name.replace("'", "''")
                held = read(source, sql=f"SELECT type FROM sqlite_master WHERE name = '{quoted}'")[3][0]
                if held.tolist() not in ([], ["table"]):
                    raise TerrainError(
                        f"{what}: layer {name!r} is a {held[0]}, expected a table; ogr2ogr makes a copy of it"
                    )
            index = listed[:, 0].tolist().index(name)
            info = pyogrio.read_info(source, layer=index, force_feature_count=True)
            count = int(info["features"])
            if kind.driver == "ESRI Shapefile":
                count = max(count, _check_index(path, source, what))  # GDAL believes the header of the index
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
        with _refused(layer.what), np.errstate(all="ignore"):
            meta, numbers, stored, fields = read(
                layer.source,
                layer=layer.index,
                columns=wanted,
                force_2d=True,
                return_fids=True,
                skip_features=first,
                max_features=_CHUNK,
            )
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
            if first + len(numbers) != layer.count:
                raise TerrainError(
                    f"{layer.what} is damaged: of its {layer.count} features {first + len(numbers)} are read"
                )
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


@contextlib.contextmanager
def _refused(what: str) -> Iterator[None]:
    """Makes what GDAL says a TerrainError of one sentence."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (SwarmError, MemoryError):
        raise
    except Exception as error:  # of damaged files pyogrio raises whatever its own code runs into
        lines = str(error).strip().splitlines() or [type(error).__name__]
        # After its first sentence, GDAL advises its programmers.
        raise TerrainError(f"{what} is damaged: {lines[0].partition('. ')[0][:LONGEST_REASON]}") from error


# --- which file ---------------------------------------------------------------------------------------------


def _source(path: Path, what: str) -> tuple[str | bytes, Kind]:
    """Returns GDAL's name for a file, whose text is checked, or its content as GeoJSON. Raises TerrainError on a
    file of another kind."""
    check_bytes(path, FileKind.VECTORS, what)
    try:
        head, member, length = beginning(path, IN_ARCHIVES, FileKind.VECTORS, what)
    except OSError as error:
        raise FileKind.VECTORS.unreadable(path, error) from error
    kind = kind_of(head)
    if kind is None:
        if path.suffix.lower() in (".dbf", ".shx", ".prj"):
            raise TerrainError(f"{what} is a part of a Shapefile; name the .shp beside it")
        neither = "GeoJSON, GeoPackage, Shapefile, FlatGeobuf, KML, GPX, OSM XML, .plan nor .waypoints"
        raise TerrainError(f"{what} {other_format(head, f'is neither {neither}, nor a .zip of one')}")
    absolute = path.resolve()
    source = str(absolute) if member is None else f"/vsizip/{{{absolute}}}/{member}"
    if kind.text is None:
        return f"GPKG:{source}" if kind.driver == "GPKG" and member is None else source, kind
    if member is not None and length > FileKind.VECTOR_TEXT.most_bytes:
        raise FileKind.VECTOR_TEXT.refusal(path, f"{member} has {size(length)}")
    data = _read(path, member)
    if kind.text == "xml":
        checked_xml(data, what)
        return source, kind
    return checked_json(data, kind, what, path.stem.encode("utf-8", "replace").decode()), kind


def _check_index(path: Path, source: str | bytes, what: str) -> int:
    """The number of shapes of a Shapefile, whose index must be its own: GDAL reads whatever lies where it says."""
    _, _, member = str(source).partition("}/")
    parts = []
    for ending in (".shp", ".shx"):
        part = b""
        for name in (ending, ending.upper()):
            with contextlib.suppress(KeyError, TerrainError):  # there is no such part
                inner = str(Path(member).with_suffix(name)) if member else None
                part = _read(path if member else path.with_suffix(name), inner, FileKind.VECTORS)
        parts.append(np.frombuffer(part, np.uint8))
    shapes, index = parts
    at, length = 2 * index[100:][: len(index[100:]) // 8 * 8].view(">i4").reshape(-1, 2).T.astype(np.int64)
    end, ends = 2 * int(shapes[24:28].view(">i4")[0]), at + 8 + length
    inside = (at >= 100).all() and (length >= 4).all() and end <= ends.max(initial=100) <= len(shapes)
    heads = shapes[at[:, None] + np.arange(4, 8)] if inside else np.zeros((0, 4), np.uint8)
    if not np.array_equal(2 * heads.view(">i4")[:, 0], length):
        raise TerrainError(f"{what} is damaged: its .shx is that of another file; make both anew")
    return len(at)


def _read(path: Path, member: str | None, kind: FileKind = FileKind.VECTOR_TEXT) -> bytes:
    if member is None:
        return read_bytes(path, kind)
    with zipfile.ZipFile(path) as archive:
        return archive.read(member)
