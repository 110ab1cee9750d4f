"""Tracks and captures of a run in a file of its folder, so that they can be exported after it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.array_archive import arrays_in, packed
from launch_scripts.observe.history import Tracks
from launch_scripts.observe.latest_state import MarkedCells
from launch_scripts.observe.recorder import Recorder
from swarm.clock import NS_PER_S
from swarm.config.input_files import FileKind, read_bytes
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.wire.messages.map_data import STAMP_LIMIT_NS, MarkKind
from swarm.wire.messages.vehicles import Followed

_MARKS: dict[str, Any] = {"cells": np.int64, "kinds": np.uint8, "paces": np.float32, "stamps_ns": np.int64}
"""Columns of marks."""
_STEP_ROWS, _STEP_COLS = np.array(STEP_ROW, np.int64), np.array(STEP_COL, np.int64)
TRACKS_FILE = "tracks.npz"
_LEAST_M, _FARTHEST_M = 1e-4, 1e12
"""Cells of no terrain are so small, and no message places anything so far away."""


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
    began_ns: int | None = None
    """From when the time of the run counts, as its times do; None in a file of an older build."""


def packed_tracks(recorder: Recorder) -> bytes:
    """The content of the file."""
    grid = recorder.grid
    began_ns = recorder.observed.began_ns or 0
    arrays: dict[str, NDArray[Any]] = {
        "grid": np.array(json.dumps(asdict(grid))),
        "began_ns": np.array(began_ns, np.int64),
    }
    for name, tracks in (("vehicles", recorder.vehicle_tracks), ("targets", recorder.target_tracks)):
        arrays |= {f"{name}_{column}": array for column, array in _columns(tracks).items()}
    captures = list(recorder.captures)
    arrays["captures_id"] = np.array([each.target for each in captures], np.str_)
    arrays["captures_time_ns"] = np.array([began_ns + int(each.time_s * NS_PER_S) for each in captures], np.int64)
    places = [(each.east_m, each.south_m) for each in captures]
    arrays["captures_place_m"] = np.array(places, np.float32).reshape(-1, 2)
    marked = recorder.observed.marked()
    arrays |= {f"marks_{name}": getattr(marked, name) for name in _MARKS}
    arrays |= _route_columns([(each.time_ns, each.route) for each in recorder.routes.kept])
    return packed(arrays)


def _route_columns(routes: list[tuple[int, Followed]]) -> dict[str, NDArray[Any]]:
    """One row per route; and the directions of all, and the legs of those that are pulled, route by route."""
    return {
        "routes_vehicle": np.array([route.vehicle for _, route in routes], np.str_),
        "routes_target": np.array([route.target for _, route in routes], np.str_),
        "routes_time_ns": np.array([time_ns for time_ns, _ in routes], np.int64),
        "routes_start": np.array([route.start for _, route in routes], np.int64),
        "routes_cost_s": np.array([route.cost_s for _, route in routes], np.float64),
        "routes_bound_s": np.array([route.lower_bound_s for _, route in routes], np.float64),
        "routes_steps": np.array([len(route.directions) for _, route in routes], np.int64),
        "routes_directions": np.frombuffer(b"".join(route.directions for _, route in routes), np.uint8),
        "routes_legs": np.frombuffer(b"".join(route.legs for _, route in routes), "<u4"),
        "routes_many_legs": np.array([len(route.legs) // 4 for _, route in routes], np.int64),
    }


def _columns(tracks: Tracks) -> dict[str, NDArray[Any]]:
    """One row per track: its id, its piece, how many samples; and all samples, track by track."""
    lines = tracks.lines()
    keys = sorted(lines)
    return {
        "id": np.array([id for id, _ in keys], np.str_),
        "piece": np.array([piece for _, piece in keys], np.int64),
        "samples": np.array([len(lines[key][0]) for key in keys], np.int64),
        "time_ns": np.concatenate([lines[key][0] for key in keys]) if keys else np.zeros(0, np.int64),
        "place_m": np.concatenate([lines[key][1] for key in keys]) if keys else np.zeros((0, 2), np.float32),
    }


def read_tracks(path: Path) -> RunTracks:
    """The tracks that a run left. Raises StoreError in one sentence if there are none, or damaged ones."""
    return tracks_in(read_bytes(path, FileKind.TRACKS), path)


def tracks_in(content: bytes, path: Path) -> RunTracks:
    """What `packed_tracks` packed. Raises StoreError if it is damaged; `path` is how the sentence calls it."""
    with arrays_in(content, path) as arrays:
        grid = _grid(json.loads(str(arrays["grid"])))
        vehicles, targets = (_tracks(arrays, name, grid) for name in ("vehicles", "targets"))
        captured_ns, captured = _times(arrays, "captures_time_ns"), _on_map(arrays["captures_place_m"], grid)
        captures = [
            Track(str(id), 0, captured_ns[n : n + 1], captured[n : n + 1])
            for n, (id, _, _) in enumerate(zip(arrays["captures_id"], captured_ns, captured, strict=True))
        ]
        marks = _marks(arrays, grid)
        routes = _routes(arrays, grid)
        began_ns = int(arrays["began_ns"]) if "began_ns" in arrays else None
    return RunTracks(grid, vehicles, targets, captures, marks, routes, began_ns)


def _grid(fields: dict[str, Any]) -> GridSpec:
    grid = GridSpec(**fields)
    lengths = (grid.resolution_m, grid.west_m, grid.north_m)
    if not (isinstance(grid.rows, int) and isinstance(grid.cols, int) and isinstance(grid.crs, str)):
        raise ValueError("its grid has no number of cells or no coordinate system")
    if (
        not all(isinstance(each, int | float) and abs(each) <= _FARTHEST_M for each in lengths)
        or lengths[0] < _LEAST_M
    ):
        raise ValueError(
            f"its grid lies farther than {_FARTHEST_M:g} m away, or nowhere, or has cells without a side"
        )
    return grid


def _whole(arrays: Any, name: str) -> NDArray[np.int64]:
    """A column of whole numbers."""
    array = arrays[name]
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise ValueError(f"{name} is no column of whole numbers")
    return np.asarray(array, np.int64)


def _times(arrays: Any, name: str) -> NDArray[np.int64]:
    """A column of times that a message may have."""
    array = _whole(arrays, name)
    if len(array) and not 0 <= array.min() <= array.max() < STAMP_LIMIT_NS:
        raise ValueError(f"{name} has a time before 1970 or after 2116")
    return array


def _marks(arrays: Any, grid: GridSpec) -> MarkedCells:
    if "marks_cells" not in arrays:
        return MarkedCells(*(np.zeros(0, kind) for kind in _MARKS.values()))
    cells, stamps_ns = _whole(arrays, "marks_cells"), _times(arrays, "marks_stamps_ns")
    kinds, paces = (arrays[f"marks_{name}"].astype(_MARKS[name]) for name in ("kinds", "paces"))
    marks = MarkedCells(cells, kinds, paces, stamps_ns)
    if any(len(getattr(marks, name)) != len(marks.cells) for name in _MARKS):
        raise ValueError("the columns of marks differ in length")
    if len(marks.cells) and not 0 <= marks.cells.min() <= marks.cells.max() < grid.cells:
        raise ValueError("marks lie outside of the grid")
    if not np.isfinite(marks.paces[marks.kinds == MarkKind.PACE]).all():
        raise ValueError("a pace of marks is no number")
    return marks


def _routes(arrays: Any, grid: GridSpec) -> list[GivenRoute]:
    if "routes_vehicle" not in arrays:
        return []
    kinds = {"time_ns": _times, "start": _whole, "steps": _whole}
    names = ("vehicle", "target", "time_ns", "start", "cost_s", "bound_s", "steps")
    columns = [
        (kinds[name](arrays, f"routes_{name}") if name in kinds else arrays[f"routes_{name}"]).tolist()
        for name in names
    ]
    if min(columns[-1], default=0) < 0:
        raise ValueError("a route has less than no steps")
    directions = arrays["routes_directions"].astype(np.uint8)
    if len(directions) != sum(columns[-1]):
        raise ValueError("the directions of routes are not theirs")
    legs = iter(_legs(arrays, len(columns[-1])))
    routes, at = [], 0
    for vehicle, target, time_ns, start, cost_s, bound_s, steps in zip(*columns, strict=True):
        cells = _walked(grid, start, directions[at : at + steps])
        at += steps
        turns = np.concatenate(([0], np.cumsum(next(legs), dtype=np.int64)))
        if cells is not None and turns[-1] == steps:  # a pulled route: straight from turn to turn
            cells = cells[turns]
        if cells is not None and math.isfinite(cost_s):
            gap = cost_s / bound_s if bound_s > 0 else float("inf")
            routes.append(GivenRoute(vehicle, target, time_ns, cost_s, gap, cells))
    return routes


def _legs(arrays: Any, many: int) -> list[NDArray[Any]]:
    """Those of each route; none of one that is not pulled, as in files before there were any."""
    if "routes_legs" not in arrays:
        return [np.empty(0, np.int64)] * many
    counts = _whole(arrays, "routes_many_legs")
    legs = _whole(arrays, "routes_legs")
    if len(counts) != many or min(counts, default=0) < 0 or sum(counts) != len(legs) or min(legs, default=1) < 1:
        raise ValueError("the legs of routes are not theirs")
    return np.split(legs, np.cumsum(counts))[:many]


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
    ids, times = arrays[f"{name}_id"], _times(arrays, f"{name}_time_ns")
    pieces, samples = (_whole(arrays, f"{name}_{column}") for column in ("piece", "samples"))
    places = _on_map(arrays[f"{name}_place_m"], grid)
    ends = np.cumsum(samples)
    lengths_fit = len(ids) == len(pieces) == len(samples) and len(times) == len(places)
    if not lengths_fit or (len(ends) and (samples.min() < 0 or ends[-1] != len(times))):
        raise ValueError(f"{name} are not as many as their samples say")
    starts = ends - samples
    return [
        Track(str(id), int(piece), times[first:last], places[first:last])
        for id, piece, first, last in zip(ids, pieces, starts, ends, strict=True)
    ]


def _on_map(place_m: NDArray[Any], grid: GridSpec) -> NDArray[np.float64]:
    east_m, south_m = place_m.astype(np.float64).reshape(-1, 2).T
    if not (np.abs(place_m) <= _FARTHEST_M).all():  # nor is any of them NaN
        raise ValueError(f"a place lies farther than {_FARTHEST_M:g} m away, or nowhere")
    return np.stack([grid.west_m + east_m, grid.north_m - south_m], axis=1)
