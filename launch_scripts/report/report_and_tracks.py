"""Data that a run leaves behind: `report.json`, tables as CSV, and arrays, `tracks.npz` and `ground.npz`.

The arrays are archives of NumPy, by which a run can be drawn and exported after it. A file may be cut off, or made
by another program: it is checked whole, or refused in one sentence, before it is used. `write_report` also has the
pictures and the page made.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.latest_messages import MarkedCells
from launch_scripts.observe.palette import image_bytes
from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_folders import OURS, REPORT_FILE, ended, version_of
from shared_map.learned_factors import factors_in, learned_kinds
from shared_map.terrain.terrain import Level, Terrain
from shared_map.terrain.terrain_report import bounds_deg
from swarm.clock import NS_PER_S
from swarm.config.input_files import FileKind, read_bytes
from swarm.errors import StoreError
from swarm.files import write_file
from swarm.grid import GridSpec, walk
from swarm.wire.messages.map_data import STAMP_LIMIT_NS, MarkKind

PICTURE_FILE = "report.png"


def make_report(recorder: Recorder, terrain: Terrain, **measured: Any) -> dict[str, Any]:
    """The numbers of a run, its terrain and its course.

    measured  what the caller knows better than the recorder, as `Recorder.report` takes it
    """
    return with_series(recorder.report(**measured), recorder, terrain)


def with_series(numbers: Mapping[str, Any], recorder: Recorder, terrain: Terrain) -> dict[str, Any]:
    """The numbers of a run, its terrain and its course."""
    return {
        **numbers,
        "version": version_of(OURS),
        "terrain": {
            "digest": terrain.digest,
            **asdict(terrain.grid),
            **bounds_deg(terrain.grid),
            "notes": list(terrain.notes),
        },
        "learned_kinds": [each._asdict() for each in learned_kinds(recorder.observed.learned_words())],
        "series": recorder.series(),
        "distributions": recorder.distributions(),
        "notes": recorder.note_rows(),
    }


def write_report(
    folder: Path,
    report: dict[str, Any],
    recorder: Recorder,
    terrain: Terrain,
    *,
    truth: NDArray[np.float32] | None = None,
) -> None:
    """Writes the files named above. Raises StoreError if the folder cannot be written.

    truth  true pace of every cell, to outline hidden obstacles; None if it is secret or unknown
    """
    report = {**report, **({"made": made} if (made := ended(folder)) else {})}
    from launch_scripts.report import run_page_and_map as pages  # matplotlib takes a moment

    factors = factors_in(recorder.observed.learned_words())
    ground = pages.ground_picture(terrain, recorder.scenario, truth)
    report = {**report, "ground_shows": ground.drawn}
    write_file(folder / REPORT_FILE, json.dumps(report, indent=1, allow_nan=False).encode() + b"\n")
    for section, (file, _) in TABLES.items():
        write_file(folder / file, csv_of(section, report))
    write_file(folder / TRACKS_FILE, packed_tracks(recorder))
    write_file(folder / pages.GROUND_FILE, image_bytes(ground.pixels, "WEBP"))
    write_file(folder / GROUND_PACE_FILE, packed_ground(terrain, ground.level))
    if (factors != 1).any():
        pixels = pages.learned_pixels(terrain, factors)
        write_file(folder / pages.LEARNED_FILE, image_bytes(pixels, "PNG"))
    pages.save_picture(folder / PICTURE_FILE, ground, read_tracks(folder / TRACKS_FILE), report)
    pages.write_page(folder)


TABLES = {"by_target": ("targets.csv", "target"), "by_group": ("groups.csv", "group"),
          "by_vehicle": ("vehicles.csv", "vehicle")}  # fmt: skip
"""Section of the report -> its file, and what its first column is called."""


def csv_of(section: str, report: Mapping[str, Any]) -> bytes:
    """One row per target, group or vehicle. Missing values are empty."""
    rows = [flat(id, row) for id, row in report[section].items()]
    columns = list(dict.fromkeys(["id", *(name for row in rows for name in row)]))
    file = io.StringIO()
    writer = csv.DictWriter(file, columns, lineterminator="\n")
    writer.writerow({**dict(zip(columns, columns, strict=True)), "id": TABLES[section][1]})
    writer.writerows(rows)
    return file.getvalue().encode()


def flat(id: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """A row without tables inside: `certified_gap_mean` and so on."""
    values: dict[str, Any] = {"id": id}
    for name, value in row.items():
        if name == "certified_gap":
            values |= {f"{name}_{part}": (value or {}).get(part) for part in ("mean", "p95", "max", "unproven")}
        else:
            values[name] = value
    return values


# --- tracks.npz and ground.npz ------------------------------------------------------------------------------------

TRACKS_FILE, GROUND_PACE_FILE = "tracks.npz", "ground.npz"
_LEAST_M, _FARTHEST_M = 1e-4, 1e12
"""Cells of no terrain are so small, and no message places anything so far away."""
_MOST_BYTES = 1 << 30
"""Limit for all arrays of an archive, unpacked."""
_KINDS: Mapping[str, Any] = {
    "text": np.str_,
    "whole": np.int64,
    "count": np.int64,
    "time": np.int64,
    "byte": np.uint8,
    "real": np.float64,
    "pace": np.float32,
    "place": np.float32,
}
"""Kind of a column -> its type. A count is not below 0, a time one that a message may have, a place two lengths."""
_OF_TRACKS = {"id": "text", "piece": "whole", "samples": "count"}
_OF_SAMPLES = {"time_ns": "time", "place_m": "place"}
_TABLES: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "vehicles": ("vehicles", _OF_TRACKS),
    "vehicles sampled": ("vehicles", _OF_SAMPLES),
    "targets": ("targets", _OF_TRACKS),
    "targets sampled": ("targets", _OF_SAMPLES),
    "captures": ("captures", {"id": "text", **_OF_SAMPLES}),
    "marks": ("marks", {"cells": "count", "kinds": "byte", "paces": "pace", "stamps_ns": "time"}),
    "routes": ("routes", {
        "vehicle": "text", "target": "text", "time_ns": "time", "start": "whole", "cost_s": "real",
        "bound_s": "real", "steps": "count", "many_legs": "count",
    }),
    "steps of routes": ("routes", {"directions": "byte"}),
    "legs of routes": ("routes", {"legs": "count"}),
}  # fmt: skip
_COLUMNS = {f"{of}_{name}": (table, kind) for table, (of, kinds) in _TABLES.items() for name, kind in kinds.items()}
"""Column of `tracks.npz` -> the table that it belongs to, and its kind. All columns of a table are as long.

A row of vehicles or targets is a piece of a track, and says how many samples it has: all stand track by track.
A row of routes says how many steps, and legs if it is pulled: these stand route by route.
"""


@dataclass(frozen=True, eq=False)
class Track:
    """The places of something over time.

    piece    of a target: it begins a new one when it jumps
    time_ns  int64 (n,)       UNIX time
    xy_m     float64 (n, 2)   metres of the map
    """

    id: str
    piece: int
    time_ns: NDArray[np.int64]
    xy_m: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GivenRoute:
    """A route that a vehicle began.

    gap    ratio of the route's cost to its proven lower bound; inf if there is no bound
    cells  int64 (n,), from where the vehicle stood to the target
    """

    vehicle: str
    target: str
    time_ns: int
    cost_s: float
    gap: float
    cells: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RunTracks:
    """Tracks of moving entities in a run.

    captures  tracks of one point each
    marks     at the end
    routes    in order of time
    began_ns  from when the time of the run counts
    """

    grid: GridSpec
    vehicles: list[Track]
    targets: list[Track]
    captures: list[Track]
    marks: MarkedCells
    routes: list[GivenRoute]
    began_ns: int


@dataclass(frozen=True, eq=False)
class GroundPace:
    """The ground as the map knew it at the beginning, in blocks of `side` x `side` cells, the last ones cut off.

    pace_s_per_m  float16 (rows, cols)  mean of passable cells in a block; inf if there are none
    best_s_per_m  pace of the quickest cell
    """

    side: int
    pace_s_per_m: NDArray[np.float16]
    best_s_per_m: float


# --- out ----------------------------------------------------------------------------------------------------------


def _packed(arrays: Mapping[str, Any]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def packed_ground(terrain: Terrain, seen: Level) -> bytes:
    """The content of `ground.npz`; of a large terrain, a level of it."""
    pace, best = seen.pace_s_per_m.astype(np.float16), np.float64(terrain.pace_s_per_m.min())
    return _packed({"side": np.int64(seen.side), "pace_s_per_m": pace, "best_s_per_m": best})


def packed_tracks(recorder: Recorder) -> bytes:
    """The content of `tracks.npz`."""
    observed, captures, begun = recorder.observed, recorder.captures, recorder.routes.kept
    began_ns, routes = observed.began_ns or 0, [each.route for each in begun]
    columns: dict[str, Any] = {}
    for of, sampled in (("vehicles", recorder.vehicle_tracks.kept), ("targets", recorder.target_tracks.kept)):
        keys = [key for each in sampled for key in each.keys]
        order = sorted(range(len(keys)), key=keys.__getitem__)  # stable: a piece stays in order of time
        times_ns = [each.time_ns for each in sampled for _ in each.keys]
        places_m = np.concatenate([np.zeros((0, 2)), *(each.places_m for each in sampled)])
        pieces = sorted(Counter(keys).items())
        columns |= {
            f"{of}_id": [id for (id, _), _ in pieces],
            f"{of}_piece": [piece for (_, piece), _ in pieces],
            f"{of}_samples": [samples for _, samples in pieces],
            f"{of}_time_ns": [times_ns[n] for n in order],
            f"{of}_place_m": places_m[np.array(order, np.intp)],
        }
    columns |= {
        "captures_id": [each.target for each in captures],
        "captures_time_ns": [began_ns + int(each.time_s * NS_PER_S) for each in captures],
        "captures_place_m": [(each.east_m, each.south_m) for each in captures],
        **{f"marks_{name}": column for name, column in observed.marked()._asdict().items()},
        **{
            f"routes_{name}": [getattr(route, name) for route in routes]
            for name in ("vehicle", "target", "start", "cost_s")
        },
        "routes_time_ns": [each.time_ns for each in begun],
        "routes_bound_s": [route.lower_bound_s for route in routes],
        "routes_steps": [len(route.directions) for route in routes],
        "routes_directions": np.frombuffer(b"".join(route.directions for route in routes), np.uint8),
        "routes_legs": np.frombuffer(b"".join(route.legs for route in routes), "<u4"),
        "routes_many_legs": [len(route.legs) // 4 for route in routes],
    }
    typed = {name: _shaped(columns[name], kind) for name, (_, kind) in _COLUMNS.items()}
    return _packed({"grid": np.array(json.dumps(asdict(recorder.grid))), "began_ns": np.int64(began_ns), **typed})


def _shaped(values: Any, kind: str) -> NDArray[Any]:
    return np.asarray(values, _KINDS[kind]).reshape((-1, 2) if kind == "place" else -1)


# --- in -----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _arrays_in(path: Path, kind: FileKind) -> Iterator[Any]:
    """The arrays of an archive, by name. Raises StoreError if it is damaged, also if the reader raises ValueError
    on what they hold."""
    content = read_bytes(path, kind)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            unpacked = sum(each.file_size for each in archive.infolist())
        if unpacked > _MOST_BYTES:
            raise ValueError(f"{unpacked} bytes when unpacked, at most {_MOST_BYTES}")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            yield arrays
    except Exception as error:  # NumPy and zipfile raise many kinds on bytes that are no archive of arrays
        raise StoreError(f"{path} is damaged: {error}") from error


def read_ground(folder: Path, grid: GridSpec) -> GroundPace | None:
    """The ground that a run left; None if it left none, as older builds. Raises StoreError if it is damaged."""
    path = folder / GROUND_PACE_FILE
    if not path.exists():
        return None
    with _arrays_in(path, FileKind.RUN) as arrays:
        side, best_s_per_m = int(arrays["side"]), float(arrays["best_s_per_m"])
        pace = arrays["pace_s_per_m"].astype(np.float16)
        if side < 1 or pace.shape != (-(-grid.rows // side), -(-grid.cols // side)):
            raise ValueError(
                f"{pace.shape} blocks of {side} cells are not those of {grid.rows} x {grid.cols} cells"
            )
        if not 0 < best_s_per_m < np.inf or not (pace > 0).all():
            raise ValueError("a pace is no time per metre")
    return GroundPace(side, pace, best_s_per_m)


def read_tracks(path: Path) -> RunTracks:
    """The tracks that a run left. Raises StoreError in one sentence if there are none, or damaged ones."""
    with _arrays_in(path, FileKind.TRACKS) as arrays:
        grid = _grid(str(arrays["grid"]))
        columns = {name: _checked(name, arrays[name], kind) for name, (_, kind) in _COLUMNS.items()}
        rows: dict[str, int] = {}
        for name, (table, _) in _COLUMNS.items():
            if rows.setdefault(table, len(columns[name])) != len(columns[name]):
                raise ValueError(f"the columns of {table} differ in length")
        captures = zip(*(columns[f"captures_{name}"] for name in ("id", "time_ns", "place_m")), strict=True)
        return RunTracks(
            grid,
            _tracks(columns, "vehicles", grid),
            _tracks(columns, "targets", grid),
            [Track(str(id), 0, time_ns[None], _on_map(place_m, grid)) for id, time_ns, place_m in captures],
            _marks(columns, grid),
            _routes(columns, grid),
            int(arrays["began_ns"]),
        )


def _checked(name: str, array: NDArray[Any], kind: str) -> NDArray[Any]:
    if np.issubdtype(_KINDS[kind], np.integer):
        if array.ndim != 1 or array.dtype.kind not in "iu":
            raise ValueError(f"{name} is no column of whole numbers")
        if kind != "whole" and array.min(initial=0) < 0:
            raise ValueError(f"{name} has a number below 0")
        if kind == "time" and array.max(initial=0) >= STAMP_LIMIT_NS:
            raise ValueError(f"{name} has a time after 2116")
    elif kind == "place" and not (np.abs(array) <= _FARTHEST_M).all():  # nor is any of them NaN
        raise ValueError(f"{name} has a place farther than {_FARTHEST_M:g} m away, or nowhere")
    return _shaped(array, kind)


def _split(name: str, columns: Mapping[str, NDArray[Any]], counts: str) -> list[NDArray[Any]]:
    """A column cut into parts that are as long as another one says."""
    lengths, column = columns[counts], columns[name]
    if lengths.sum() != len(column):
        raise ValueError(f"{name} has {len(column)} rows, not the {lengths.sum()} of {counts}")
    return np.split(column, np.cumsum(lengths)[:-1])


def _grid(text: str) -> GridSpec:
    grid = msgspec.json.decode(text, type=GridSpec)
    farthest_m = max(abs(grid.west_m), abs(grid.north_m), grid.resolution_m)
    if farthest_m > _FARTHEST_M or grid.resolution_m < _LEAST_M:
        raise ValueError(f"its grid lies farther than {_FARTHEST_M:g} m away, or has cells without a side")
    return grid


def _on_map(place_m: NDArray[Any], grid: GridSpec) -> NDArray[np.float64]:
    east_m, south_m = place_m.astype(np.float64).reshape(-1, 2).T
    return np.stack([grid.west_m + east_m, grid.north_m - south_m], axis=1)


def _tracks(columns: Mapping[str, NDArray[Any]], name: str, grid: GridSpec) -> list[Track]:
    ids, pieces = columns[f"{name}_id"].tolist(), columns[f"{name}_piece"].tolist()
    times, places = (_split(f"{name}_{each}", columns, f"{name}_samples") for each in ("time_ns", "place_m"))
    rows = zip(ids, pieces, times, places, strict=False)  # without a row there is one empty part
    return [Track(id, piece, time_ns, _on_map(place_m, grid)) for id, piece, time_ns, place_m in rows]


def _marks(columns: Mapping[str, NDArray[Any]], grid: GridSpec) -> MarkedCells:
    marks = MarkedCells(*(columns[f"marks_{name}"] for name in MarkedCells._fields))
    if marks.cells.max(initial=0) >= grid.cells:
        raise ValueError("marks lie outside of the grid")
    if not np.isfinite(marks.paces[marks.kinds == MarkKind.PACE]).all():
        raise ValueError("a pace of marks is no number")
    return marks


def _routes(columns: Mapping[str, NDArray[Any]], grid: GridSpec) -> list[GivenRoute]:
    """The routes of the file, but for those that no agent of ours tells: they leave the grid."""
    names = ("vehicle", "target", "time_ns", "start", "cost_s", "bound_s")
    rows = zip(*(columns[f"routes_{name}"].tolist() for name in names), strict=True)
    directions, legs = (
        _split("routes_directions", columns, "routes_steps"), _split("routes_legs", columns, "routes_many_legs")
    )  # fmt: skip
    routes = []
    for (vehicle, target, time_ns, start, cost_s, bound_s), way, own in zip(rows, directions, legs, strict=False):
        try:
            cells = np.array(walk(grid, start, way.tobytes()), np.int64)
        except ValueError:
            continue
        turns = np.cumsum([0, *own.tolist()])
        if turns[-1] == len(way):  # a pulled route: straight from turn to turn
            cells = cells[turns]
        if math.isfinite(cost_s):
            gap = cost_s / bound_s if bound_s > 0 else math.inf
            routes.append(GivenRoute(vehicle, target, time_ns, cost_s, gap, cells))
    return routes
