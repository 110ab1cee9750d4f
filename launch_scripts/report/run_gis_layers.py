"""The layers of a run for a GIS: tracks, captures, routes and marks; and the files of `swarm runs export`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.run_folders import REPORT_FILE, lacks, read_report
from launch_scripts.report import AREAS, FORMATS, SEVERAL
from launch_scripts.report import gis_formats as gis
from launch_scripts.report.gis_formats import Feature, Layer
from launch_scripts.report.report_and_tracks import TRACKS_FILE, RunTracks, Track, read_tracks
from shared_map.terrain.map_frame import MapFrame, middles_of
from swarm.errors import ConfigError
from swarm.files import make_folder
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind

EXPORTED = "export"
"""Folder in a run's folder that exports go to."""
Groups = Mapping[str, str]
"""Vehicle -> its group."""


def vehicle_tracks(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """Returns the tracks of vehicles; and the position of each that never moved, as a line has a length."""
    lines = Layer("vehicle_tracks", "LineString", {"vehicle": "text", "group": "text", **gis.TIMED})
    return _moved(lines, [(each, {"vehicle": each.id, "group": groups.get(each.id)}) for each in tracks.vehicles])


def target_tracks(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """Returns the tracks of targets: a target which jumps begins a new piece."""
    lines = Layer("target_tracks", "LineString", {"target": "text", "piece": "int", **gis.TIMED})
    return _moved(lines, [(each, {"target": each.id, "piece": each.piece}) for each in tracks.targets])


def _moved(lines: Layer, tracks: Sequence[tuple[Track, dict[str, gis.Value]]]) -> list[Layer]:
    """Tracks as lines, or points where they have no length."""
    points = Layer(f"{lines.name.removesuffix('_tracks')}s_standing", "Point", lines.fields)
    for track, whose in tracks:
        if not len(track.time_ns):
            continue
        length_m = _length_m(track.xy_m)
        begins, ends = (gis.moment(track.time_ns[n]) for n in (0, -1))
        timed: tuple[gis.Value, ...] = (begins, ends, len(track.time_ns), length_m)
        values = {**whose, **dict(zip(gis.TIMED, timed, strict=True))}
        if length_m == 0:
            points.features.append(Feature([track.xy_m[:1]], values))
        else:
            lines.features.append(Feature([track.xy_m], values, track.time_ns))
    return [lines, points] if points.features else [lines]


def _length_m(xy_m: gis.Points) -> float:
    return round(float(np.hypot(*np.diff(xy_m, axis=0).T).sum()), 2)


def _captures(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """Returns the captures of targets."""
    features = [
        Feature([each.xy_m], {"target": each.id, "at": gis.moment(each.time_ns[0])}) for each in tracks.captures
    ]
    return [Layer("captures", "Point", {"target": "text", "at": "time"}, features)]


def _routes(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """The routes that vehicles began: over the middles of cells, straight on where they go straight on. One that
    stays in its cell is none."""
    layer = Layer(
        "routes", "LineString",
        {"vehicle": "text", "target": "text", "at": "time", "cost_s": "real", "certified_gap": "real",
         "length_m": "real"}, about=gis.COSTS,
    )  # fmt: skip
    for route in tracks.routes:
        xy_m = middles_of(tracks.grid, gis.turns_of(route.cells, tracks.grid)).T
        if (length_m := _length_m(xy_m)) > 0:
            at, gap = gis.moment(np.int64(route.time_ns)), route.gap if math.isfinite(route.gap) else None
            row = (route.vehicle, route.target, at, route.cost_s, gap, length_m)
            layer.features.append(Feature([xy_m], dict(zip(layer.fields, row, strict=True))))
    return [layer]


def _marks(tracks: RunTracks, groups: Groups) -> list[Layer]:
    """Returns the marks at the end, as `mark_layer`."""
    grid, marks = tracks.grid, tracks.marks
    kinds, paces = np.full((grid.rows, grid.cols), 255, np.uint8), np.zeros((grid.rows, grid.cols), np.float32)
    kinds.reshape(-1)[marks.cells], paces.reshape(-1)[marks.cells] = marks.kinds, marks.paces
    return [mark_layer(grid, kinds, paces)]


def mark_layer(grid: GridSpec, kinds: NDArray[np.uint8], paces: NDArray[np.float32]) -> Layer:
    """Marked cells that touch and say the same, as polygons: lethal ones, and paces of the same two digits.

    kinds  uint8 (rows, cols): a MarkKind where something is marked, any other number elsewhere
    paces  float32 (rows, cols), s/m, where the kind is PACE
    """
    import shapely

    layer = Layer(
        "marks", "Polygon", {"kind": "text", "pace_s_per_m": "real", "cells": "int", "area_m2": "real"},
        about="A mark is lethal, or the pace in seconds per metre that was measured.",
    )  # fmt: skip
    lethal, paced = kinds == MarkKind.LETHAL, kinds == MarkKind.PACE
    codes = lethal.astype(np.int32)
    known = np.maximum(paces[paced].astype(np.float64), 1e-30)
    power = 10.0 ** np.floor(np.log10(known) - 1)
    rounded, of_cell = np.unique(np.round(known / power) * power, return_inverse=True)
    codes[paced] = 2 + of_cell
    for code, rings in gis.areas_of(codes, codes > 0, grid):
        area_m2 = shapely.Polygon(rings[0], rings[1:]).area
        kind, pace = ("lethal", None) if code == 1 else ("pace", float(f"{rounded[code - 2]:.4g}"))
        row = (kind, pace, round(area_m2 / grid.resolution_m**2), round(area_m2, 3))
        layer.features.append(Feature(rings, dict(zip(layer.fields, row, strict=True))))
    return layer


WHAT: Mapping[str, Callable[[RunTracks, Groups], list[Layer]]] = {
    "tracks": vehicle_tracks,
    "targets": target_tracks,
    "captures": _captures,
    "routes": _routes,
    "marks": _marks,
}
"""Name of an export -> its layers."""


ENDINGS = (*(ending.removeprefix(".") for ending in FORMATS), "mcap")
"""The words of `swarm runs export --format`."""

# --- files of `swarm runs export` ---------------------------------------------------------------------------------


def export_run(folder: Path, what: Sequence[str], format: str, out: Path | None, force: bool) -> list[str]:
    """Writes layers of a run; returns a line for each file. Raises ConfigError or StoreError in one sentence.

    what    keys of `WHAT`; all if empty, of GPX all but areas
    format  an ending of `FORMATS` without its dot
    out     folder to write to, or the file; a folder in the run's folder by default
    force   replace files that are there
    """
    tracks = tracks_of_run(folder)
    groups = groups_of(read_report(folder)) if (folder / REPORT_FILE).exists() else {}
    names = what or [name for name in WHAT if name != "marks" or f".{format}" in AREAS]
    layers = [layer for name in WHAT if name in names for layer in WHAT[name](tracks, groups)]
    run = folder.resolve().name
    if f".{format}" in SEVERAL:
        files = {f"{run}.{format}": layers}
    else:
        files = {f"{run}-{layer.name}.{format}": [layer] for layer in layers}
    written = dict(zip(free_places(folder, list(files), out, force), files.values(), strict=True))
    for path, some in written.items():
        gis.write_layers(path, some, MapFrame(tracks.grid))
    return [
        f"{path}: {', '.join(f'{len(layer.features):,} {layer.name}' for layer in some)}"
        for path, some in written.items()
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
    if to.suffix.lower() == Path(names[0]).suffix and not to.is_dir():
        if len(names) > 1:
            raise ConfigError(f"--out {to}: found one file for {len(names)} layers; expected a folder, or --what")
        to, names = to.parent, [to.name]
    if to.exists() and not to.is_dir():
        raise ConfigError(f"--out {to} is a file; expected a folder")
    paths = [to / name for name in names]
    make_folder(to)
    for path in paths:
        gis.check_target(path, "--out" if out else "export", force=force)
    return paths


def groups_of(report: Mapping[str, Any]) -> dict[str, str]:
    """Vehicle -> its group, by a report, which may be damaged."""
    rows = report.get("by_vehicle")
    named = rows.items() if isinstance(rows, dict) else ()
    return {id: str(row["group"]) for id, row in named if isinstance(row, dict) and "group" in row}
