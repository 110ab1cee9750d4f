"""The arrays that a run leaves, so that it can be drawn and exported after it: `tracks.npz` and `ground.npz`.

Both are archives of NumPy. What is read was perhaps cut off, or made by somebody else: it is checked whole, or
refused in one sentence, before anything is made of it.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.history import Tracks
from launch_scripts.observe.latest_state import MarkedCells
from launch_scripts.observe.recorder import Recorder
from shared_map.terrain.pyramid import Level
from shared_map.terrain.terrain import Terrain
from swarm.clock import NS_PER_S
from swarm.config.input_files import FileKind, read_bytes
from swarm.errors import StoreError
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.wire.messages.map_data import STAMP_LIMIT_NS, MarkKind

TRACKS_FILE, GROUND_PACE_FILE = "tracks.npz", "ground.npz"
_LEAST_M, _FARTHEST_M = 1e-4, 1e12
"""Cells of no terrain are so small, and no message places anything so far away."""
_MOST_BYTES = 1 << 30
"""Of all arrays of an archive, unpacked."""
_DAMAGES = (
    *(OSError, ValueError, KeyError, TypeError, EOFError, RecursionError, NotImplementedError, SyntaxError),
    *(MemoryError, OverflowError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
"""What NumPy and zipfile raise on bytes that are no archive of arrays."""
_MARKS: Mapping[str, type[np.generic]] = {
    "cells": np.int64, "kinds": np.uint8, "paces": np.float32, "stamps_ns": np.int64,
}  # fmt: skip
"""Columns of marks."""


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

    gap    cost over its proven lower bound; inf without one
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
    """What moved in a run.

    captures  tracks of one point each
    marks     at the end; none in a file of an older build, as `routes`, which are in order of time
    began_ns  from when the time of the run counts; None in a file of an older build
    """

    grid: GridSpec
    vehicles: list[Track]
    targets: list[Track]
    captures: list[Track]
    marks: MarkedCells
    routes: list[GivenRoute]
    began_ns: int | None = None


@dataclass(frozen=True, eq=False)
class GroundPace:
    """The ground as the map knew it at the beginning, in blocks of `side` x `side` cells, the last ones cut off.

    pace_s_per_m  float16 (rows, cols)  mean of what can be driven in a block; inf where nothing can
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
    """The content of `tracks.npz`: columns of tracks, captures, marks and routes."""
    observed, captures, begun = recorder.observed, list(recorder.captures), recorder.routes.kept
    began_ns, marked, routes = observed.began_ns or 0, observed.marked(), [each.route for each in begun]
    return _packed(
        {
            "grid": np.array(json.dumps(asdict(recorder.grid))),
            "began_ns": np.int64(began_ns),
            **_columns("vehicles", recorder.vehicle_tracks),
            **_columns("targets", recorder.target_tracks),
            "captures_id": _texts(each.target for each in captures),
            "captures_time_ns": _whole_numbers(began_ns + int(each.time_s * NS_PER_S) for each in captures),
            "captures_place_m": np.array([(each.east_m, each.south_m) for each in captures], np.float32).reshape(
                -1, 2
            ),
            **{f"marks_{name}": getattr(marked, name) for name in _MARKS},
            # A row per route; and the directions of all, and the legs of those that are pulled, route by route.
            "routes_vehicle": _texts(route.vehicle for route in routes),
            "routes_target": _texts(route.target for route in routes),
            "routes_time_ns": _whole_numbers(each.time_ns for each in begun),
            "routes_start": _whole_numbers(route.start for route in routes),
            "routes_cost_s": np.array([route.cost_s for route in routes], np.float64),
            "routes_bound_s": np.array([route.lower_bound_s for route in routes], np.float64),
            "routes_steps": _whole_numbers(len(route.directions) for route in routes),
            "routes_directions": np.frombuffer(b"".join(route.directions for route in routes), np.uint8),
            "routes_legs": np.frombuffer(b"".join(route.legs for route in routes), "<u4"),
            "routes_many_legs": _whole_numbers(len(route.legs) // 4 for route in routes),
        }
    )


def _texts(values: Iterator[str]) -> NDArray[np.str_]:
    return np.array(list(values), np.str_)


def _whole_numbers(values: Iterator[int]) -> NDArray[np.int64]:
    return np.array(list(values), np.int64)


def _columns(name: str, tracks: Tracks) -> dict[str, NDArray[Any]]:
    """A row per track: its id, its piece, how many samples; and all samples, track by track."""
    lines = dict(sorted(tracks.lines().items()))
    return {
        f"{name}_id": _texts(id for id, _ in lines),
        f"{name}_piece": _whole_numbers(piece for _, piece in lines),
        f"{name}_samples": _whole_numbers(len(times) for times, _ in lines.values()),
        f"{name}_time_ns": np.concatenate([np.zeros(0, np.int64), *(times for times, _ in lines.values())]),
        f"{name}_place_m": np.concatenate([np.zeros((0, 2), np.float32), *(line for _, line in lines.values())]),
    }


# --- in -----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _arrays_in(content: bytes, path: Path) -> Iterator[Any]:
    """The arrays of an archive, by name. Raises StoreError if it is damaged, also if the reader raises ValueError
    on what they hold; `path` is how the sentence calls the file."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            unpacked = sum(each.file_size for each in archive.infolist())
        if unpacked > _MOST_BYTES:
            raise ValueError(f"{unpacked} bytes when unpacked, at most {_MOST_BYTES}")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            yield arrays
    except _DAMAGES as error:
        raise StoreError(f"{path} is damaged: {error}") from error


def read_ground(folder: Path, grid: GridSpec) -> GroundPace | None:
    """The ground that a run left; None if it left none, as older builds. Raises StoreError if it is damaged."""
    path = folder / GROUND_PACE_FILE
    if not path.exists():
        return None
    with _arrays_in(read_bytes(path, FileKind.RUN), path) as arrays:
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
    return tracks_in(read_bytes(path, FileKind.TRACKS), path)


def tracks_in(content: bytes, path: Path) -> RunTracks:
    """What `packed_tracks` packed. Raises StoreError if it is damaged; `path` is how the sentence calls it."""
    with _arrays_in(content, path) as arrays:
        grid = _grid(json.loads(str(arrays["grid"])))
        ids, times_ns, places = _rows(arrays, "captures", {"id": "text", "time_ns": "time", "place_m": "place"})
        places = _on_map(places, grid)
        captures = [Track(str(id), 0, times_ns[n : n + 1], places[n : n + 1]) for n, id in enumerate(ids)]
        return RunTracks(
            grid,
            _tracks(arrays, "vehicles", grid),
            _tracks(arrays, "targets", grid),
            captures,
            _marks(arrays, grid),
            _routes(arrays, grid),
            int(arrays["began_ns"]) if "began_ns" in arrays else None,
        )


def _rows(arrays: Any, name: str, kinds: Mapping[str, str]) -> list[NDArray[Any]]:
    """Columns of a table, each of its kind (text, real, place, whole, count, time) and all as long. A time is one
    that a message may have, and a count is not below 0."""
    columns = []
    for column, kind in kinds.items():
        array = arrays[f"{name}_{column}"]
        if kind in ("whole", "count", "time"):
            if array.ndim != 1 or array.dtype.kind not in "iu":
                raise ValueError(f"{name}_{column} is no column of whole numbers")
            array = np.asarray(array, np.int64)
            if kind != "whole" and array.min(initial=0) < 0:
                raise ValueError(f"{name}_{column} has a number below 0")
            if kind == "time" and array.max(initial=0) >= STAMP_LIMIT_NS:
                raise ValueError(f"{name}_{column} has a time after 2116")
        elif kind == "place" and not (np.abs(array) <= _FARTHEST_M).all():  # nor is any of them NaN
            raise ValueError(f"{name}_{column} has a place farther than {_FARTHEST_M:g} m away, or nowhere")
        columns.append(array)
    if len({len(array) for array in columns}) > 1:
        raise ValueError(f"the columns of {name} differ in length")
    return columns


def _grid(fields: dict[str, Any]) -> GridSpec:
    grid = GridSpec(**fields)
    lengths = (grid.resolution_m, grid.west_m, grid.north_m)
    if not (isinstance(grid.rows, int) and isinstance(grid.cols, int) and isinstance(grid.crs, str)):
        raise ValueError("its grid has no number of cells or no coordinate system")
    known = all(isinstance(each, int | float) and abs(each) <= _FARTHEST_M for each in lengths)
    if not known or lengths[0] < _LEAST_M:
        raise ValueError(
            f"its grid lies farther than {_FARTHEST_M:g} m away, or nowhere, or has cells without a side"
        )
    return grid


def _on_map(place_m: NDArray[Any], grid: GridSpec) -> NDArray[np.float64]:
    east_m, south_m = place_m.astype(np.float64).reshape(-1, 2).T
    return np.stack([grid.west_m + east_m, grid.north_m - south_m], axis=1)


def _tracks(arrays: Any, name: str, grid: GridSpec) -> list[Track]:
    ids, pieces, samples = _rows(arrays, name, {"id": "text", "piece": "whole", "samples": "count"})
    times_ns, places = _rows(arrays, name, {"time_ns": "time", "place_m": "place"})
    if samples.sum() != len(times_ns):
        raise ValueError(f"{name} are not as many as their samples say")
    ends = np.cumsum(samples)[:-1]
    each = zip(ids, pieces, np.split(times_ns, ends), np.split(_on_map(places, grid), ends), strict=False)
    return [Track(str(id), int(piece), at_ns, xy_m) for id, piece, at_ns, xy_m in each]


def _marks(arrays: Any, grid: GridSpec) -> MarkedCells:
    if "marks_cells" not in arrays:
        return MarkedCells(*(np.zeros(0, kind) for kind in _MARKS.values()))
    kinds = {"cells": "count", "kinds": "whole", "paces": "real", "stamps_ns": "time"}
    columns = _rows(arrays, "marks", kinds)
    marks = MarkedCells(*(array.astype(kind) for array, kind in zip(columns, _MARKS.values(), strict=True)))
    if marks.cells.max(initial=0) >= grid.cells:
        raise ValueError("marks lie outside of the grid")
    if not np.isfinite(marks.paces[marks.kinds == MarkKind.PACE]).all():
        raise ValueError("a pace of marks is no number")
    return marks


def _routes(arrays: Any, grid: GridSpec) -> list[GivenRoute]:
    if "routes_vehicle" not in arrays:
        return []
    kinds = {
        "vehicle": "text", "target": "text", "time_ns": "time", "start": "whole", "cost_s": "real",
        "bound_s": "real", "steps": "count",
    }  # fmt: skip
    columns = _rows(arrays, "routes", kinds)
    steps, directions = columns[-1], arrays["routes_directions"].astype(np.uint8)
    if len(directions) != steps.sum():
        raise ValueError("the directions of routes are not theirs")
    many, legs = np.zeros(len(steps), np.int64), np.zeros(0, np.int64)
    if "routes_legs" in arrays:  # else of an older build
        (many,), (legs,) = (_rows(arrays, "routes", {name: "count"}) for name in ("many_legs", "legs"))
        if len(many) != len(steps) or many.sum() != len(legs) or legs.min(initial=1) < 1:
            raise ValueError("the legs of routes are not theirs")
    rows = zip(*(column.tolist() for column in columns[:-1]), strict=True)
    ways, of_legs = np.split(directions, np.cumsum(steps)[:-1]), np.split(legs, np.cumsum(many)[:-1])
    routes = []
    for (vehicle, target, time_ns, start, cost_s, bound_s), way, own in zip(rows, ways, of_legs, strict=False):
        cells = _walked(grid, start, way)
        turns = np.concatenate(([0], np.cumsum(own, dtype=np.int64)))
        if cells is not None and turns[-1] == len(way):  # a pulled route: straight from turn to turn
            cells = cells[turns]
        if cells is not None and math.isfinite(cost_s):
            gap = cost_s / bound_s if bound_s > 0 else float("inf")
            routes.append(GivenRoute(vehicle, target, time_ns, cost_s, gap, cells))
    return routes


def _walked(grid: GridSpec, start: int, directions: NDArray[np.uint8]) -> NDArray[np.int64] | None:
    """The cells of a route; None of one that no agent of ours tells: it leaves the grid, or has no such step."""
    if not 0 <= start < grid.cells or max(directions, default=0) > 7:
        return None
    row, col = grid.row_col(start)
    rows = np.cumsum(np.concatenate([[row], np.array(STEP_ROW, np.int64)[directions]]))
    cols = np.cumsum(np.concatenate([[col], np.array(STEP_COL, np.int64)[directions]]))
    inside = rows.min() >= 0 and rows.max() < grid.rows and cols.min() >= 0 and cols.max() < grid.cols
    return np.asarray(rows * grid.cols + cols, np.int64) if inside else None
