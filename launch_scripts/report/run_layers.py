"""The layers of a run for a GIS: tracks, captures, routes and marks; and the files of `swarm export`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.run_folder import REPORT_FILE, lacks, read_report
from launch_scripts.report.exporter import (
    COSTS,
    FORMATS,
    TIMED,
    Feature,
    Layer,
    Value,
    areas_of,
    moment,
    transform_of,
    turns_of,
    write_layers,
)
from launch_scripts.report.run_arrays import TRACKS_FILE, RunTracks, Track, read_tracks
from shared_map.terrain.map_frame import MapFrame, middles_of
from swarm.errors import ConfigError, StoreError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind

EXPORTED = "export"
"""Folder in a run's folder that exports go to."""
Groups = Mapping[str, str]
"""Vehicle -> its group."""


def vehicle_tracks(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """Where vehicles went; and where each stood that never moved, as a line has a length."""
    lines = Layer("vehicle_tracks", "LineString", {"vehicle": "text", "group": "text", **TIMED})
    return _moved(lines, [(each, {"vehicle": each.id, "group": groups.get(each.id)}) for each in tracks.vehicles])


def target_tracks(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """Where targets went, likewise: a target which jumps begins a new piece."""
    lines = Layer("target_tracks", "LineString", {"target": "text", "piece": "int", **TIMED})
    return _moved(lines, [(each, {"target": each.id, "piece": each.piece}) for each in tracks.targets])


def _moved(lines: Layer, tracks: Sequence[tuple[Track, dict[str, Value]]]) -> list[Layer]:
    """Tracks as lines; of the samples in which something stands still, the first and the last are kept."""
    points = Layer(f"{lines.name.removesuffix('_tracks')}s_standing", "Point", lines.fields)
    for track, whose in tracks:
        if not len(track.time_ns):
            continue
        steps_m = np.hypot(*np.diff(track.xy_m, axis=0).T)
        still = np.zeros(len(track.time_ns), bool)
        still[1:-1] = (steps_m[:-1] == 0) & (steps_m[1:] == 0)
        values: dict[str, Value] = {
            **whose,
            "begins": moment(track.time_ns[0]),
            "ends": moment(track.time_ns[-1]),
            "samples": len(track.time_ns),
            "length_m": round(float(steps_m.sum()), 2),
        }
        if values["length_m"] == 0:
            points.features.append(Feature([track.xy_m[:1]], values))
        else:
            lines.features.append(Feature([track.xy_m[~still]], values, track.time_ns[~still]))
    return [lines, points] if points.features else [lines]


def _captures(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """Where targets were captured."""
    features = [
        Feature([each.xy_m], {"target": each.id, "at": moment(each.time_ns[0])}) for each in tracks.captures
    ]
    return [Layer("captures", "Point", {"target": "text", "at": "time"}, features)]


def _routes(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """The routes that vehicles began: over the middles of cells, straight on where they go straight on. One that
    stays in its cell is none."""
    grid = tracks.grid
    layer = Layer(
        "routes", "LineString",
        {"vehicle": "text", "target": "text", "at": "time", "cost_s": "real", "certified_gap": "real",
         "length_m": "real"}, about=COSTS,
    )  # fmt: skip
    for route in tracks.routes:
        x_m, y_m = middles_of(grid, turns_of(route.cells, grid))
        length_m = float(np.hypot(np.diff(x_m), np.diff(y_m)).sum())
        if length_m > 0:
            values: dict[str, Value] = {
                "vehicle": route.vehicle,
                "target": route.target,
                "at": moment(np.int64(route.time_ns)),
                "cost_s": route.cost_s,
                "certified_gap": route.gap if math.isfinite(route.gap) else None,
                "length_m": round(length_m, 2),
            }
            layer.features.append(Feature([np.stack([x_m, y_m], axis=1)], values))
    return [layer]


def _marks(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """What was marked at the end, as `mark_layer`."""
    grid, marks = tracks.grid, tracks.marks
    shape = (grid.rows, grid.cols)
    kinds, paces, stamps_ns = np.full(shape, 255, np.uint8), np.zeros(shape, np.float32), np.zeros(shape, np.int64)
    for array, values in ((kinds, marks.kinds), (paces, marks.paces), (stamps_ns, marks.stamps_ns)):
        array.reshape(-1)[marks.cells] = values
    return [mark_layer(grid, kinds, paces, stamps_ns)]


def mark_layer(
    grid: GridSpec, kinds: NDArray[np.uint8], paces: NDArray[np.float32], stamps_ns: NDArray[np.int64]
) -> Layer:
    """Marked cells that touch and say the same, as polygons: lethal ones, and paces of the same two digits.

    kinds      uint8 (rows, cols): a MarkKind where something is marked, any other number elsewhere
    paces      float32 (rows, cols), s/m, where the kind is PACE
    stamps_ns  int64 (rows, cols), UNIX time of the mark
    """
    from rasterio.features import rasterize
    from scipy import ndimage

    layer = Layer(
        "marks", "Polygon",
        {"kind": "text", "pace_s_per_m": "real", "cells": "int", "area_m2": "real", "oldest": "time",
         "newest": "time"}, about="A mark is lethal, or the pace in seconds per metre that was measured.",
    )  # fmt: skip
    lethal, paced = kinds == MarkKind.LETHAL, kinds == MarkKind.PACE
    codes = lethal.astype(np.int32)
    known = np.maximum(paces[paced].astype(np.float64), 1e-30)
    power = 10.0 ** np.floor(np.log10(known) - 1)
    codes[paced] = 2 + np.unique(np.round(known / power) * power, return_inverse=True)[1]
    areas = list(areas_of(codes, codes > 0, grid))
    if not areas:
        return layer
    shapes = [({"type": "Polygon", "coordinates": rings}, n) for n, (_, rings) in enumerate(areas, 1)]
    numbers = rasterize(shapes, kinds.shape, transform=transform_of(grid), dtype=np.int32)
    each = np.arange(1, len(areas) + 1)
    cells = np.bincount(numbers.reshape(-1), minlength=len(areas) + 1)[1:].tolist()
    oldest, newest, mean = (
        of(values, numbers, each)
        for of, values in ((ndimage.minimum, stamps_ns), (ndimage.maximum, stamps_ns), (ndimage.mean, paces))
    )
    for n, (code, rings) in enumerate(areas):
        values: dict[str, Value] = {
            "kind": "lethal" if code == 1 else "pace",
            "pace_s_per_m": None if code == 1 else float(f"{mean[n]:.4g}"),
            "cells": cells[n],
            "area_m2": round(cells[n] * grid.resolution_m**2, 3),
            "oldest": moment(oldest[n]),
            "newest": moment(newest[n]),
        }
        layer.features.append(Feature(rings, values))
    return layer


WHAT: Mapping[str, Callable[[RunTracks, Groups], list[Layer]]] = {
    "tracks": vehicle_tracks,
    "targets": target_tracks,
    "captures": _captures,
    "routes": _routes,
    "marks": _marks,
}
"""What can be exported -> its layers."""


ENDINGS = tuple(ending.removeprefix(".") for ending in FORMATS)
"""The words of `swarm export --format`."""

# --- files of `swarm export` --------------------------------------------------------------------------------------


def export_run(folder: Path, what: Sequence[str], format: str, out: Path | None, force: bool) -> list[str]:
    """Writes layers of a run; returns a line for each file. Raises ConfigError or StoreError in one sentence.

    what    keys of `WHAT`; all if empty, of GPX all but areas
    format  an ending of `FORMATS` without its dot
    out     folder to write to; one in the run's folder by default
    force   replace files that are there
    """
    tracks = tracks_of_run(folder)
    groups = groups_of(read_report(folder)) if (folder / REPORT_FILE).exists() else {}
    names = what or [name for name in WHAT if (format, name) != ("gpx", "marks")]
    layers = [layer for name in WHAT if name in names for layer in WHAT[name](tracks, groups)]
    frame, run = MapFrame(tracks.grid), folder.resolve().name
    if FORMATS[f".{format}"].many:
        files = {f"{run}.{format}": layers}
    else:
        files = {f"{run}-{layer.name}.{format}": [layer] for layer in layers}
    where = free_places(folder, list(files), out, force)
    for path, some in zip(where, files.values(), strict=True):
        write_layers(path, some, frame)
    return [
        f"{path}: {', '.join(f'{len(layer.features):,} {layer.name}' for layer in some)}"
        for path, some in zip(where, files.values(), strict=True)
    ]


def tracks_of_run(folder: Path) -> RunTracks:
    """The tracks of a run. Raises ConfigError or StoreError in one sentence."""
    path = folder / TRACKS_FILE
    if not path.exists():
        raise lacks(folder, TRACKS_FILE)
    return read_tracks(path)


def free_places(folder: Path, names: Sequence[str], out: Path | None, force: bool) -> list[Path]:
    """The paths of files of these names. Raises ConfigError before anything is written if one is there already."""
    to = folder / EXPORTED if out is None else out
    if to.exists() and not to.is_dir():
        raise ConfigError(f"--out {to} is a file; expected a folder")
    paths = [to / name for name in names]
    there = [path for path in paths if path.exists()]
    if there and not force:
        raise ConfigError(f"{there[0]} is there already; --force replaces it, --out FOLDER writes elsewhere")
    try:
        to.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"cannot make the folder {to}: {error.strerror or error}") from error
    return paths


def groups_of(report: Mapping[str, Any]) -> dict[str, str]:
    """Vehicle -> its group, by a report, which may be damaged."""
    rows = report.get("by_vehicle")
    if not isinstance(rows, dict):
        return {}
    return {id: str(row["group"]) for id, row in rows.items() if isinstance(row, dict) and "group" in row}
