"""Tracks and captures of a run in a file of its folder, so that they can be exported after it."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.report.latest_state import MarkedCells
from launch_scripts.report.recorder import Recorder
from launch_scripts.report.tracks import Tracks
from swarm.clock import NS_PER_S
from swarm.config.input_files import FileKind, read_bytes
from swarm.errors import StoreError
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.wire.messages.vehicles import Followed

_MARKS: dict[str, Any] = {"cells": np.int64, "kinds": np.uint8, "paces": np.float32, "stamps_ns": np.int64}
"""Columns of marks."""
_STEP_ROWS, _STEP_COLS = np.array(STEP_ROW, np.int64), np.array(STEP_COL, np.int64)
TRACKS_FILE = "tracks.npz"
_DAMAGES = (
    *(OSError, ValueError, KeyError, TypeError, EOFError, RecursionError, NotImplementedError, SyntaxError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
"""What NumPy and zipfile raise on bytes that are no archive of arrays."""
_MOST_BYTES = 1 << 30
"""Of all arrays, unpacked."""


@dataclass(frozen=True, eq=False)
class Track:
    """Where something was, and when.

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
    """What moved in a run. Captures have one point each."""

    grid: GridSpec
    vehicles: list[Track]
    targets: list[Track]
    captures: list[Track]
    marks: MarkedCells
    """At the end; none in a file of an older build."""
    routes: list[GivenRoute]
    """In order of time; none in a file of an older build."""


def packed_tracks(recorder: Recorder) -> bytes:
    """The content of the file."""
    grid = recorder.grid
    began_ns = recorder.model.began_ns or 0
    arrays: dict[str, NDArray[Any]] = {"grid": np.array(json.dumps(asdict(grid)))}
    for name, tracks in (("vehicles", recorder.vehicle_tracks), ("targets", recorder.target_tracks)):
        arrays |= {f"{name}_{column}": array for column, array in _columns(tracks).items()}
    captures = list(recorder.captures)
    arrays["captures_id"] = np.array([each.target for each in captures], np.str_)
    arrays["captures_time_ns"] = np.array([began_ns + int(each.time_s * NS_PER_S) for each in captures], np.int64)
    places = [(each.east_m, each.south_m) for each in captures]
    arrays["captures_place_m"] = np.array(places, np.float32).reshape(-1, 2)
    marked = recorder.marked()
    arrays |= {f"marks_{name}": getattr(marked, name) for name in _MARKS}
    arrays |= _route_columns([(each.time_ns, each.route) for each in recorder.routes.kept])
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _route_columns(routes: list[tuple[int, Followed]]) -> dict[str, NDArray[Any]]:
    """One row per route; and the directions of all, route by route."""
    return {
        "routes_vehicle": np.array([route.vehicle for _, route in routes], np.str_),
        "routes_target": np.array([route.target for _, route in routes], np.str_),
        "routes_time_ns": np.array([time_ns for time_ns, _ in routes], np.int64),
        "routes_start": np.array([route.start for _, route in routes], np.int64),
        "routes_cost_s": np.array([route.cost_s for _, route in routes], np.float64),
        "routes_bound_s": np.array([route.lower_bound_s for _, route in routes], np.float64),
        "routes_steps": np.array([len(route.directions) for _, route in routes], np.int64),
        "routes_directions": np.frombuffer(b"".join(route.directions for _, route in routes), np.uint8),
    }


def _columns(tracks: Tracks) -> dict[str, NDArray[Any]]:
    """One row per track: its id, its piece, how many samples; and all samples, track by track."""
    lines, times = tracks.lines(), tracks.times_ns()
    keys = sorted(lines)
    return {
        "id": np.array([id for id, _ in keys], np.str_),
        "piece": np.array([piece for _, piece in keys], np.int64),
        "samples": np.array([len(lines[key]) for key in keys], np.int64),
        "time_ns": np.concatenate([times[key] for key in keys]) if keys else np.zeros(0, np.int64),
        "place_m": np.concatenate([lines[key] for key in keys]) if keys else np.zeros((0, 2), np.float32),
    }


def read_tracks(path: Path) -> RunTracks:
    """The tracks that a run left. Raises StoreError in one sentence if there are none, or damaged ones."""
    return tracks_in(read_bytes(path, FileKind.TRACKS), path)


def tracks_in(content: bytes, path: Path) -> RunTracks:
    """What `packed_tracks` packed. Raises StoreError if it is damaged; `path` is how the sentence calls it."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            unpacked = sum(each.file_size for each in archive.infolist())
        if unpacked > _MOST_BYTES:
            raise ValueError(f"{unpacked} bytes when unpacked, at most {_MOST_BYTES}")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            grid = GridSpec(**json.loads(str(arrays["grid"])))
            vehicles, targets = (_tracks(arrays, name, grid) for name in ("vehicles", "targets"))
            captures = [
                Track(str(id), 0, np.array([time_ns], np.int64), _on_map(place[None], grid))
                for id, time_ns, place in zip(
                    *(arrays[f"captures_{column}"] for column in ("id", "time_ns", "place_m")), strict=True
                )
            ]
            marks = _marks(arrays, grid)
            routes = _routes(arrays, grid)
    except _DAMAGES as error:
        raise StoreError(f"{path} is damaged: {error}") from error
    return RunTracks(grid, vehicles, targets, captures, marks, routes)


def _marks(arrays: Any, grid: GridSpec) -> MarkedCells:
    if "marks_cells" not in arrays:
        return MarkedCells(*(np.zeros(0, kind) for kind in _MARKS.values()))
    marks = MarkedCells(*(arrays[f"marks_{name}"].astype(kind) for name, kind in _MARKS.items()))
    if any(len(getattr(marks, name)) != len(marks.cells) for name in _MARKS):
        raise ValueError("the columns of marks differ in length")
    if len(marks.cells) and not 0 <= marks.cells.min() <= marks.cells.max() < grid.cells:
        raise ValueError("marks lie outside of the grid")
    return marks


def _routes(arrays: Any, grid: GridSpec) -> list[GivenRoute]:
    if "routes_vehicle" not in arrays:
        return []
    names = ("vehicle", "target", "time_ns", "start", "cost_s", "bound_s", "steps")
    columns = [arrays[f"routes_{name}"].tolist() for name in names]
    directions = arrays["routes_directions"].astype(np.uint8)
    routes, at = [], 0
    for vehicle, target, time_ns, start, cost_s, bound_s, steps in zip(*columns, strict=True):
        cells = _walked(grid, start, directions[at : at + steps])
        at += steps
        if cells is not None:
            gap = cost_s / bound_s if bound_s > 0 else float("inf")
            routes.append(GivenRoute(vehicle, target, time_ns, cost_s, gap, cells))
    return routes


def _walked(grid: GridSpec, start: int, directions: NDArray[np.uint8]) -> NDArray[np.int64] | None:
    """The cells of a route; None of one that no agent of ours tells: it leaves the grid, or has no such step."""
    if not 0 <= start < grid.cells or max(directions, default=0) > 7:
        return None
    row, col = grid.row_col(start)
    rows = np.cumsum(np.concatenate([[row], _STEP_ROWS[directions]]))
    cols = np.cumsum(np.concatenate([[col], _STEP_COLS[directions]]))
    inside = rows.min() >= 0 and rows.max() < grid.rows and cols.min() >= 0 and cols.max() < grid.cols
    return np.asarray(rows * grid.cols + cols, np.int64) if inside else None


def _tracks(arrays: Any, name: str, grid: GridSpec) -> list[Track]:
    ids, pieces, samples = (arrays[f"{name}_{column}"] for column in ("id", "piece", "samples"))
    times, places = arrays[f"{name}_time_ns"].astype(np.int64), _on_map(arrays[f"{name}_place_m"], grid)
    ends = np.cumsum(samples)
    if not len(ids) == len(pieces) == len(samples) or (len(ends) and ends[-1] != len(times)):
        raise ValueError(f"{name} are not as many as their samples say")
    starts = ends - samples
    return [
        Track(str(id), int(piece), times[first:last], places[first:last])
        for id, piece, first, last in zip(ids, pieces, starts, ends, strict=True)
    ]


def _on_map(place_m: NDArray[Any], grid: GridSpec) -> NDArray[np.float64]:
    east_m, south_m = place_m.astype(np.float64).reshape(-1, 2).T
    return np.stack([grid.west_m + east_m, grid.north_m - south_m], axis=1)
