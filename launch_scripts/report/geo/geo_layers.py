"""Tracks, captures and marks of a run as layers of points, lines and polygons, and the files that hold them."""

from __future__ import annotations

import datetime
import json
import math
import struct
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.run_folder import replacing
from launch_scripts.report.geo.geo_shapes import Ring, areas_of, line, point, polygon, turns_of
from launch_scripts.report.geo.track_file import RunTracks, Track
from shared_map.terrain.places import MapFrame, middles_of
from swarm.errors import ConfigError, StoreError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind

Value = str | int | float | np.datetime64 | None
FieldKind = Literal["text", "int", "real", "time"]
Shape = Literal["Point", "LineString", "Polygon"]
_TIMED: Mapping[str, FieldKind] = {"begins": "time", "ends": "time", "samples": "int", "length_m": "real"}
"""What a track has beside who it is of."""


@dataclass(frozen=True, eq=False)
class Feature:
    """What lies somewhere.

    parts    rings of a polygon, or the points of a line or the point, metres of the map
    time_ns  int64 (n,), UNIX time of each point of a line
    """

    parts: list[Ring]
    values: dict[str, Value]
    time_ns: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class Layer:
    """Features of one shape with the same fields."""

    name: str
    shape: Shape
    fields: Mapping[str, FieldKind]
    features: list[Feature] = field(default_factory=list)


def track_layers(tracks: RunTracks, groups: Mapping[str, str]) -> list[Layer]:
    """Where vehicles and targets went, and where each stood that never moved: a line has a length.

    groups  vehicle -> its group
    """
    vehicles = Layer("vehicle_tracks", "LineString", {"vehicle": "text", "group": "text", **_TIMED})
    targets = Layer("target_tracks", "LineString", {"target": "text", "piece": "int", **_TIMED})
    standing = [
        Layer(f"{lines.name.removesuffix('_tracks')}s_standing", "Point", lines.fields)
        for lines in (vehicles, targets)
    ]
    named: tuple[list[tuple[Track, dict[str, Value]]], ...] = (
        [(each, {"vehicle": each.id, "group": groups.get(each.id)}) for each in tracks.vehicles],
        [(each, {"target": each.id, "piece": each.piece}) for each in tracks.targets],
    )
    for lines, points, each_named in zip((vehicles, targets), standing, named, strict=True):
        for track, values in each_named:
            if not len(track.time_ns):
                continue
            moved = _moved(track, values)
            if moved.values["length_m"] == 0:
                points.features.append(Feature([track.xy_m[:1]], moved.values))
            else:
                lines.features.append(moved)
    return [vehicles, targets, *(points for points in standing if points.features)]


def capture_layer(tracks: RunTracks) -> Layer:
    """Where targets were captured."""
    captures = Layer("captures", "Point", {"target": "text", "at": "time"})
    captures.features.extend(
        Feature([each.xy_m], {"target": each.id, "at": _time(each.time_ns[0])}) for each in tracks.captures
    )
    return captures


def route_layer(tracks: RunTracks) -> Layer:
    """The routes that vehicles began: over the middles of cells, straight on where they go straight on. One that
    stays in its cell is none."""
    grid = tracks.grid
    layer = Layer(
        "routes", "LineString",
        {"vehicle": "text", "target": "text", "at": "time", "cost_s": "real", "certified_gap": "real",
         "length_m": "real"},
    )  # fmt: skip
    for route in tracks.routes:
        x_m, y_m = middles_of(grid, turns_of(route.cells, grid))
        length_m = float(np.hypot(np.diff(x_m), np.diff(y_m)).sum())
        if length_m > 0:
            values: dict[str, Value] = {
                "vehicle": route.vehicle,
                "target": route.target,
                "at": _time(np.int64(route.time_ns)),
                "cost_s": route.cost_s,
                "certified_gap": route.gap if math.isfinite(route.gap) else None,
                "length_m": round(length_m, 2),
            }
            layer.features.append(Feature([np.stack([x_m, y_m], axis=1)], values))
    return layer


def marks_of_tracks(tracks: RunTracks) -> Layer:
    """What was marked at the end, as `mark_layer`."""
    grid, marks = tracks.grid, tracks.marks
    shape = (grid.rows, grid.cols)
    kinds, paces, stamps_ns = np.full(shape, 255, np.uint8), np.zeros(shape, np.float32), np.zeros(shape, np.int64)
    for array, values in ((kinds, marks.kinds), (paces, marks.paces), (stamps_ns, marks.stamps_ns)):
        array.reshape(-1)[marks.cells] = values
    return mark_layer(grid, kinds, paces, stamps_ns)


def _moved(track: Track, values: dict[str, Value]) -> Feature:
    """A track as a line; of the samples in which something stands still, the first and the last."""
    steps_m = np.hypot(*np.diff(track.xy_m, axis=0).T)
    still = np.zeros(len(track.time_ns), bool)
    still[1:-1] = (steps_m[:-1] == 0) & (steps_m[1:] == 0)
    values = {
        **values,
        "begins": _time(track.time_ns[0]),
        "ends": _time(track.time_ns[-1]),
        "samples": len(track.time_ns),
        "length_m": round(float(steps_m.sum()), 2),
    }
    return Feature([track.xy_m[~still]], values, track.time_ns[~still])


def mark_layer(
    grid: GridSpec, kinds: NDArray[np.uint8], paces: NDArray[np.float32], stamps_ns: NDArray[np.int64]
) -> Layer:
    """Marked cells that touch and say the same, as polygons: lethal ones, and paces of the same two digits.

    kinds      uint8 (rows, cols): a MarkKind where something is marked, any other number elsewhere
    paces      float32 (rows, cols), s/m, where the kind is PACE
    stamps_ns  int64 (rows, cols), UNIX time of the mark
    """
    from skimage.measure import label

    layer = Layer(
        "marks", "Polygon",
        {"kind": "text", "pace_s_per_m": "real", "cells": "int", "area_m2": "real", "oldest": "time",
         "newest": "time"},
    )  # fmt: skip
    codes = np.zeros(kinds.shape, np.int64)
    codes[kinds == MarkKind.LETHAL] = 1
    paced = kinds == MarkKind.PACE
    codes[paced] = 2 + np.unique(_two_digits(paces[paced]), return_inverse=True)[1]
    labelled = label(codes, background=0, connectivity=1)  # type: ignore[no-untyped-call]
    numbers: NDArray[np.int32] = np.asarray(labelled, np.int32)
    flat, inside = numbers.reshape(-1), np.flatnonzero(numbers)
    many = int(numbers.max(initial=0)) + 1
    cells = np.bincount(flat, minlength=many)
    oldest = np.full(many, np.iinfo(np.int64).max)
    newest = np.full(many, np.iinfo(np.int64).min)
    np.minimum.at(oldest, flat[inside], stamps_ns.reshape(-1)[inside])
    np.maximum.at(newest, flat[inside], stamps_ns.reshape(-1)[inside])
    pace_sums = np.bincount(flat, weights=np.where(paced, paces, 0).reshape(-1), minlength=many)
    lethal = np.zeros(many, bool)
    lethal[flat[inside]] = codes.reshape(-1)[inside] == 1
    for number, rings in areas_of(numbers, numbers > 0, MapFrame(grid)):
        values: dict[str, Value] = {
            "kind": "lethal" if lethal[number] else "pace",
            "pace_s_per_m": None if lethal[number] else float(f"{pace_sums[number] / cells[number]:.4g}"),
            "cells": int(cells[number]),
            "area_m2": round(float(cells[number]) * grid.resolution_m**2, 3),
            "oldest": _time(oldest[number]),
            "newest": _time(newest[number]),
        }
        layer.features.append(Feature(rings, values))
    return layer


def _two_digits(values: NDArray[np.float32]) -> NDArray[np.float64]:
    known = np.maximum(values.astype(np.float64), 1e-30)
    power = 10.0 ** np.floor(np.log10(known) - 1)
    return np.asarray(np.round(known / power) * power)


def _time(time_ns: np.int64) -> np.datetime64:
    return np.datetime64(int(time_ns) // 1_000_000, "ms")


# --- files ----------------------------------------------------------------------------------------------------


def check_layer_file(path: Path) -> None:
    """Raise ConfigError before the work, if the ending says no format or the folder is not there."""
    if path.suffix.lower() not in WRITERS:
        raise ConfigError(f"--out {path}: write {' or '.join(WRITERS)}")
    if path.is_dir() or not path.parent.is_dir():
        raise ConfigError(f"--out {path}: cannot write there, it is a folder or lies in none")


def write_layers(path: Path, layers: Iterable[Layer], frame: MapFrame) -> None:
    """Write layers in the format of the file's ending. Raises ConfigError or StoreError in one sentence."""
    check_layer_file(path)
    try:
        WRITERS[path.suffix.lower()](path, list(layers), frame)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    except ValueError as error:  # JSON has no NaN
        raise StoreError(
            f"cannot write {path}: a place has no longitude and latitude in {frame.grid.crs[:60]}; "
            "write a .gpkg, which is in metres of the map"
        ) from error


def _geojson(path: Path, layers: list[Layer], frame: MapFrame) -> None:
    """RFC 7946: one collection in WGS 84; each feature names its layer. Without a place in metres of the map."""
    with replacing(path) as half, half.open("w", encoding="utf-8") as file:
        file.write('{"type": "FeatureCollection", "features": [')
        for number, feature in enumerate(_json_features(layers, frame)):
            file.write((",\n" if number else "\n") + json.dumps(feature, allow_nan=False))
        file.write("\n]}\n")


def _json_features(layers: list[Layer], frame: MapFrame) -> Iterator[dict[str, Any]]:
    for layer in layers:
        for feature in layer.features:
            match layer.shape:
                case "Polygon":
                    geometry = polygon(feature.parts, frame)
                case "LineString":
                    geometry = line(feature.parts[0], frame)
                case "Point":
                    geometry = point(feature.parts[0], frame)
            values = {name: iso_time(value) for name, value in feature.values.items()}
            properties: dict[str, Any] = {"layer": layer.name, **values}
            if feature.time_ns is not None:
                properties["times"] = [iso_time(_time(each)) for each in feature.time_ns]
            yield {"type": "Feature", "properties": properties, "geometry": geometry}


def iso_time(value: Value) -> Any:
    if isinstance(value, np.datetime64):
        moment = datetime.datetime.fromtimestamp(int(value.astype(np.int64)) / 1000, datetime.UTC)
        return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return value


def _gpkg(path: Path, layers: list[Layer], frame: MapFrame) -> None:
    """A GeoPackage in the map's own metres. Beside each layer of lines is one of their points, with times."""
    try:
        from pyogrio import raw
        from pyogrio.errors import DataLayerError, DataSourceError
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"--out {path}: a GeoPackage needs pyogrio: pip install 'terrain-swarm[vectors]'"
        ) from error

    layers_of_lines = [layer for layer in layers if any(each.time_ns is not None for each in layer.features)]
    partial = path.with_name(f"{path.stem}.part.gpkg")
    partial.unlink(missing_ok=True)
    try:
        for number, layer in enumerate([*layers, *map(_points_of, layers_of_lines)]):
            times = {
                name: np.full(len(layer.features), 100) for name, kind in layer.fields.items() if kind == "time"
            }
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "'crs' was not provided")  # metres from anywhere have none
                raw.write(
                    partial,
                    np.array([_wkb(layer.shape, each) for each in layer.features], object),
                    [_column(layer, name, kind) for name, kind in layer.fields.items()],
                    list(layer.fields),
                    layer=layer.name,
                    driver="GPKG",
                    geometry_type=layer.shape,
                    crs=None if frame.grid.crs == "local" else frame.system.to_wkt(),
                    append=number > 0,
                    gdal_tz_offsets=times,  # 100 is UTC
                )
        partial.replace(path)
    except (DataSourceError, DataLayerError) as error:
        raise StoreError(f"cannot write {path}: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def _points_of(layer: Layer) -> Layer:
    """The points of a layer of lines, each with its time: what a GIS plays back."""
    own = [name for name in layer.fields if name not in _TIMED]
    fields: dict[str, FieldKind] = {**{name: layer.fields[name] for name in own}, "at": "time"}
    points = Layer(layer.name.replace("_tracks", "_places"), "Point", fields)
    for feature in layer.features:
        assert feature.time_ns is not None
        values = {name: feature.values[name] for name in own}
        points.features.extend(
            Feature([xy_m[None]], {**values, "at": _time(time_ns)})
            for xy_m, time_ns in zip(feature.parts[0], feature.time_ns, strict=True)
        )
    return points


def _column(layer: Layer, name: str, kind: FieldKind) -> NDArray[Any]:
    values = [feature.values[name] for feature in layer.features]
    match kind:
        case "text":
            return np.array(values, object)
        case "int":
            return np.array(values, np.int64)
        case "real":
            return np.array([np.nan if value is None else value for value in values], np.float64)
        case "time":
            return np.array(values, "datetime64[ms]")


def _wkb(shape: Shape, feature: Feature) -> bytes:
    """Well-known binary, little endian."""
    match shape:
        case "Point":
            return struct.pack("<BI2d", 1, 1, *feature.parts[0][0].tolist())
        case "LineString":
            (points,) = feature.parts
            return struct.pack("<BII", 1, 2, len(points)) + points.astype("<f8").tobytes()
        case "Polygon":
            rings = (struct.pack("<I", len(ring)) + ring.astype("<f8").tobytes() for ring in feature.parts)
            return struct.pack("<BII", 1, 3, len(feature.parts)) + b"".join(rings)


WRITERS: Mapping[str, Callable[[Path, list[Layer], MapFrame], None]] = {".geojson": _geojson, ".gpkg": _gpkg}
"""Ending -> what writes it."""
