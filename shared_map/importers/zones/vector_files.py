"""Features of a GeoJSON, a GeoPackage or a Shapefile, as they are stored: bounded, before anything is made of them.

pyogrio and shapely are imported where they are used: agents never need them.
"""

from __future__ import annotations

import contextlib
import sqlite3
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.importers.raster_files import BAD_ARCHIVE, LONGEST_REASON
from swarm.config.explain import nearest
from swarm.config.input_files import FileKind, check_bytes, size
from swarm.errors import SwarmError, TerrainError

MOST_FEATURES = 500_000
"""Number of those that touch the terrain."""
MOST_VERTICES = 20_000_000
_MAGIC = {b"SQLite format 3\0": "GPKG", b"\0\0\x27\x0a": "ESRI Shapefile"}
"""First bytes -> GDAL's driver; a GeoJSON begins with a brace. GDAL knows 80 formats, some of which
name other files."""
_IN_ARCHIVES = (".shp", ".gpkg", ".geojson", ".json")
_IDS = ("id", "@id", "osm_id", "osm_way_id", "full_id")


@dataclass(frozen=True, eq=False)
class Layer:
    """Metadata of a layer.

    source    how GDAL names the file
    what      how sentences name it
    crs       as the file has it; empty if it has none
    columns   names of its attributes
    features  how many
    bounds    (west, south, east, north) in units of `crs`; None if it is empty
    """

    source: str
    what: str
    name: str
    crs: str
    columns: tuple[str, ...]
    features: int
    bounds: tuple[float, float, float, float] | None


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a layer, in its own coordinates.

    ids         what people call each, such as way/4711, or its number in the file
    geometries  shapely geometries without heights, curves made of lines; None where there is none
    tags        attributes of each as texts, without those that are not set
    """

    ids: list[str]
    geometries: NDArray[Any]
    tags: list[dict[str, str]]


def is_vector(path: Path) -> bool:
    """Returns True if a file begins, or a .zip is, as one that holds features. False if it cannot be opened."""
    with contextlib.suppress(OSError, TerrainError, *BAD_ARCHIVE):
        return _found(path, "") is not None
    return False


def open_layer(path: Path, layer: str | None, what: str) -> Layer:
    """The one layer of a file, or the one that is named.

    Raises TerrainError with one sentence, which `what` begins, if the file is missing, too large, damaged, of
    another kind, or holds several layers and none is named.
    """
    import pyogrio

    source = _source(path, what)
    with _refused(what):
        known = [str(name) for name, kind in pyogrio.list_layers(source) if kind is not None]
        if not known:
            raise TerrainError(f"{what} has no layer of shapes")
        if layer is None and len(known) > 1:
            shown = ", ".join(known[:12]) + (" ..." if len(known) > 12 else "")
            raise TerrainError(f"{what} has {len(known)} layers; set layer to one of {shown}")
        if layer is not None and layer not in known:
            held = ", ".join(known[:12])
            raise TerrainError(f"{what} has no layer {layer!r}, only {held}{nearest(layer, known)}")
        name = layer or known[0]
        if source.startswith("GPKG:"):
            _check_table(path, name, what)
        info = pyogrio.read_info(source, layer=name, force_feature_count=True, force_total_bounds=True)
    bounds = info["total_bounds"]
    return Layer(
        source=source,
        what=what,
        name=name,
        crs=str(info["crs"] or ""),
        columns=tuple(str(field) for field in info["fields"]),
        features=int(info["features"]),
        bounds=_box(bounds) if info["features"] else None,
    )


def _box(bounds: Any) -> tuple[float, float, float, float] | None:
    """Finite bounds; None if a layer has none, as its features have no shapes."""
    if bounds is None or not np.isfinite(bounds).all():
        return None
    west, south, east, north = (float(side) for side in bounds)
    return west, south, east, north


def read_features(layer: Layer, bounds: tuple[float, float, float, float], columns: Sequence[str]) -> Features:
    """The features of a layer that touch a rectangle in its own coordinates.

    Raises TerrainError if they are too many, or the file is damaged.
    """
    import shapely
    from pyogrio.raw import read

    wanted = [name for name in dict.fromkeys((*columns, *_IDS)) if name in layer.columns]
    with _refused(layer.what):
        meta, numbers, stored, fields = read(
            layer.source,
            layer=layer.name,
            columns=wanted,
            bbox=bounds,
            force_2d=True,
            return_fids=True,
            max_features=MOST_FEATURES + 1,
        )
    if len(numbers) > MOST_FEATURES:
        raise TerrainError(
            f"{layer.what} has more than {MOST_FEATURES} features on the terrain; crop it, or dissolve it"
        )
    vertices = sum(len(each) for each in stored if each is not None) // 16
    if vertices > MOST_VERTICES:
        raise TerrainError(
            f"{layer.what} has {vertices} corners on the terrain, at most {MOST_VERTICES}; simplify it"
        )
    with np.errstate(all="ignore"):
        geometries = shapely.from_wkb(stored, on_invalid="ignore")
    tags: list[dict[str, str]] = [{} for _ in numbers]
    for name, values in zip(meta["fields"], fields, strict=True):
        for row, value in zip(tags, values.tolist(), strict=True):
            if value is not None and value == value and value != "":
                row[str(name)] = str(value)
    id_column = next((name for name in _IDS if name in wanted), "")
    ids = [row.get(id_column, str(number))[:60] for row, number in zip(tags, numbers, strict=True)]
    return Features(ids, geometries, tags)


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
        raise TerrainError(f"{what} is damaged: {lines[0][:LONGEST_REASON]}") from error


# --- which file ---------------------------------------------------------------------------------------------


def _source(path: Path, what: str) -> str:
    """Returns GDAL's name for a file. Raises TerrainError on a file of another kind."""
    check_bytes(path, FileKind.VECTORS)
    try:
        found = _found(path, what)
    except BAD_ARCHIVE as error:
        raise TerrainError(f"{what} is damaged or no .zip: {error}") from error
    except OSError as error:
        raise FileKind.VECTORS.unreadable(path, error) from error
    if found is None:
        if path.suffix.lower() in (".dbf", ".shx", ".prj"):
            raise TerrainError(f"{what} is a part of a Shapefile; name the .shp beside it")
        raise TerrainError(
            f"{what} is neither GeoJSON, GeoPackage nor Shapefile, nor a .zip of one: ogr2ogr makes one"
        )
    return found


def _found(path: Path, what: str) -> str | None:
    absolute = path.resolve()
    with path.open("rb") as file:
        head = file.read(4096)
    driver = _driver(head)
    if driver == "GeoJSON":
        check_bytes(path, FileKind.VECTOR_TEXT)
    if driver is not None:
        return str(absolute) if driver == "ESRI Shapefile" else f"{driver}:{absolute}"
    if not head.startswith(b"PK"):
        return None
    with zipfile.ZipFile(path) as archive:
        members = [each for each in archive.infolist() if not each.is_dir()]
        named = [each for each in members if Path(each.filename).suffix.lower() in _IN_ARCHIVES]
        if len(named) != 1:
            if not what:
                return None
            raise TerrainError(
                f"{what} holds {len(named)} files of shapes ({', '.join(_IN_ARCHIVES)}), expected one: unpack it"
            )
        stem = str(Path(named[0].filename).with_suffix(""))
        unpacked = sum(each.file_size for each in members if str(Path(each.filename).with_suffix("")) == stem)
        text = Path(named[0].filename).suffix.lower() in (".geojson", ".json")
        most = (FileKind.VECTOR_TEXT if text else FileKind.VECTORS).most_bytes
        if unpacked > most:
            raise TerrainError(f"{what}: {named[0].filename} has {size(unpacked)}, at most {size(most)} are read")
    return f"/vsizip/{{{absolute}}}/{named[0].filename}"


def _driver(head: bytes) -> str | None:
    for magic, driver in _MAGIC.items():
        if head.startswith(magic):
            return driver
    return "GeoJSON" if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{") else None


def _check_table(path: Path, layer: str, what: str) -> None:
    """A layer of a GeoPackage must be a table: a view is a program, which may not end."""
    try:
        with contextlib.closing(sqlite3.connect(path.resolve().as_uri() + "?mode=ro", uri=True)) as database:
            found = database.execute("SELECT type FROM sqlite_master WHERE name = ?", (layer,)).fetchone()
    except sqlite3.Error as error:
        raise TerrainError(f"{what} is damaged: {error}") from error
    if found is not None and found[0] != "table":
        raise TerrainError(f"{what}: layer {layer!r} is a {found[0]}, expected a table; ogr2ogr makes a copy of it")
