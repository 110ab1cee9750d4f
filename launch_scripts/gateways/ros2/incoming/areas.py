"""Polygons and grids of ROS as areas of the terrain: corners of a zone, cells of marks. Pure; no message raises."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.incoming.places import FrameReader
from swarm.grid import Window
from swarm.wire.messages.orders import MOST_CORNERS

MOST_CELLS = 1 << 16
"""Of the terrain, that one grid may close."""
_MOST_WORK = 1 << 25
"""Numbers that resampling may hold at once."""
_LEAST_SIDE_M = 1e-3
_COVERED = 0.5
"""A cell of the terrain is closed if so much of it is known and occupied."""


def corners_of(reader: FrameReader, message: Any) -> list[tuple[float, float]] | str:
    """Corners in metres of the terrain of a geometry_msgs/PolygonStamped; none of an empty one."""
    points = message.polygon.points
    if points and not 3 <= len(points) <= MOST_CORNERS:
        return f"polygon has {len(points)} corners, expected 3 ... {MOST_CORNERS}, or none to take the zone away"
    corners: list[tuple[float, float]] = []
    for point in points:
        found = reader.point(message.header, float(point.x), float(point.y))
        if isinstance(found, str):
            return found
        corners.append(found)
    return corners


def closed_cells(map: RosMap, message: Any, occupied: int) -> list[int] | str:
    """Cells of the terrain that a nav_msgs/OccupancyGrid closes, in order: those of which half or more lies under
    cells of the grid from `occupied` up to 100. What is unknown (-1) or beyond the grid closes nothing.

    Areas are exact: any resolution and origin in the map frame is resampled; a turned grid is refused.
    """
    fault = _fault(map, message)
    if fault is not None:
        return fault
    info, grid = message.info, map.grid
    window = _window(map, info)
    if window.empty:
        return "grid lies outside the terrain"
    rows, cols = window.row1 - window.row0, window.col1 - window.col0
    if (rows + 1) * max(info.width, cols) + info.width * info.height > _MOST_WORK:
        return f"grid has {info.width} x {info.height} cells over {rows} x {cols} of the terrain: too many at once"
    values = np.asarray(message.data, np.int8).reshape(info.height, info.width)
    theirs = ((values >= occupied) & (values <= 100)).astype(np.float64)
    # Borders of our cells, in cells of theirs; rows from the south, as theirs are.
    step = grid.resolution_m / info.resolution
    left = -info.origin.position.x / info.resolution
    bottom = -info.origin.position.y / info.resolution
    from_south = grid.rows - window.row1 + np.arange(rows + 1)
    by_row = _between(theirs, from_south * step + bottom)
    covered = _between(by_row.T, (window.col0 + np.arange(cols + 1)) * step + left).T / step**2
    in_window, col = np.nonzero(covered[::-1] >= _COVERED - 1e-9)
    if len(col) > MOST_CELLS:
        return f"grid closes {len(col)} cells of the terrain, expected at most {MOST_CELLS}"
    cells: list[int] = ((in_window + window.row0) * grid.cols + col + window.col0).tolist()
    return cells


def _between(values: NDArray[np.float64], borders: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, m) values by row and n + 1 borders in rows -> sums between each two borders, parts of rows included."""
    sums = np.zeros((len(values) + 1, values.shape[1]))
    np.cumsum(values, axis=0, out=sums[1:])
    inside = np.clip(borders, 0, len(values))
    below = np.minimum(inside.astype(np.int64), len(values) - 1)
    share = (inside - below)[:, None]
    at_borders = sums[below] * (1 - share) + sums[below + 1] * share
    return np.asarray(np.diff(at_borders, axis=0))


def _fault(map: RosMap, message: Any) -> str | None:
    info = message.info
    frame = message.header.frame_id.strip("/")
    if frame != map.frame:
        return f"frame is {frame[:80]!r}, expected {map.frame!r}"
    if info.width * info.height != len(message.data) or not len(message.data):
        return f"grid has {len(message.data)} cells, expected width x height, {info.width} x {info.height}"
    if not _LEAST_SIDE_M <= info.resolution < math.inf:
        return f"resolution is {float(info.resolution)!r} m, expected at least {_LEAST_SIDE_M:g}"
    at, turned = info.origin.position, info.origin.orientation
    if not (abs(at.x) <= 1e9 and abs(at.y) <= 1e9):
        return f"origin is ({at.x!r}, {at.y!r}), expected numbers of metres"
    if not all(abs(each) < 1e-6 for each in (turned.x, turned.y, turned.z)):
        return "grid is turned, expected an origin whose orientation is (0, 0, 0, 1)"
    return None


def _window(map: RosMap, info: Any) -> Window:
    """Our cells that the grid touches."""
    grid, at = map.grid, info.origin.position
    side_m = grid.resolution_m
    south, north = (math.floor(y_m / side_m) for y_m in (at.y, at.y + info.height * float(info.resolution)))
    west, east = (math.floor(x_m / side_m) for x_m in (at.x, at.x + info.width * float(info.resolution)))
    return Window(
        max(grid.rows - 1 - north, 0), max(west, 0), min(grid.rows - south, grid.rows), min(east + 1, grid.cols)
    )
