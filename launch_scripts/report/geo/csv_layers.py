"""Layers of a run as CSV: a row per point of a track, per capture; per route and marked area, as WKT."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from launch_scripts.observe.run_folder import replacing
from launch_scripts.report.geo.geo_layers import Feature, Layer, iso_time
from launch_scripts.report.geo.geo_shapes import Ring, in_degrees
from shared_map.terrain.places import MapFrame


def write_csv(path: Path, layer: Layer, frame: MapFrame) -> None:
    """Metres of the map as x_m and y_m, and where the terrain has a place, lat and lon. Raises OSError."""
    placed = frame.grid.crs != "local"
    where = ["wkt"] if _as_shapes(layer) else ["x_m", "y_m", *(["lat", "lon"] if placed else [])]
    timed = [] if _as_shapes(layer) or "at" in layer.fields else ["at"]
    own = [name for name in layer.fields if not timed or name not in ("begins", "ends", "samples", "length_m")]
    with replacing(path) as half, half.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*own, *timed, *where])
        for feature in layer.features:
            values = [iso_time(feature.values[name]) for name in own]
            if _as_shapes(layer):
                writer.writerow([*values, _wkt(layer, feature, frame)])
                continue
            times = feature.time_ns if feature.time_ns is not None else [None]
            for time_ns, point in zip(times, _points(feature.parts[0], frame, placed), strict=True):
                at = [] if not timed else [feature.values["begins"] if time_ns is None else _moment(time_ns)]
                writer.writerow([*values, *map(iso_time, at), *point])


def _as_shapes(layer: Layer) -> bool:
    """Whether a row is a whole shape: what has no time of each of its points."""
    return layer.shape == "Polygon" or (layer.shape == "LineString" and "at" in layer.fields)


def _moment(time_ns: np.int64) -> np.datetime64:
    return np.datetime64(int(time_ns) // 1_000_000, "ms")


def _points(points: Ring, frame: MapFrame, placed: bool) -> Iterator[list[Any]]:
    degrees = in_degrees(points, frame).round(8).tolist() if placed else [[]] * len(points)
    for (x_m, y_m), lon_lat in zip(points.round(3).tolist(), degrees, strict=True):
        yield [x_m, y_m, *lon_lat[::-1]]


def _wkt(layer: Layer, feature: Feature, frame: MapFrame) -> str:
    """Longitude before latitude, as WKT has it; metres of the map where the terrain has no place."""
    parts = [part if frame.grid.crs == "local" else in_degrees(part, frame) for part in feature.parts]
    digits = 3 if frame.grid.crs == "local" else 8
    texts = [", ".join(f"{x} {y}" for x, y in part.round(digits).tolist()) for part in parts]
    if layer.shape == "LineString":
        return f"LINESTRING ({texts[0]})"
    return f"POLYGON ({', '.join(f'({text})' for text in texts)})"
