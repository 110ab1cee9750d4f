"""Messages of ROS as places and areas of the terrain. Pure.

Any numbers and names in a message become a valid value, or a ConfigError that states the fault.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.ros_messages import (
    TERRAIN_FRAME,
    RosMap,
    heading_of,
    heading_of_quaternion,
    yaw_of,
)
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.grid import Window
from swarm.wire.messages.orders import MOST_CORNERS
from swarm.wire.messages.vehicles import MOST_M_PER_S

_STANDS_M_PER_S = 0.05
"""A slower robot is at rest: odometry at rest is seldom exactly 0."""
_MOST_M = 1e12
"""Bound on coordinates, as of places in a scenario (`setting_types.Metres`)."""
_LEAST_GAP_NS, _MOST_GAP_NS = NS_PER_S // 50, 2 * NS_PER_S
"""Two poses tell a speed if they are not nearer in time, nor further apart."""
MOST_CELLS = 1 << 16
"""Limit of terrain cells that one grid may close."""
_MOST_WORK = 1 << 25
"""Numbers that resampling may hold at once."""
_LEAST_SIDE_M = 1e-3
"""A millimetre: a finer grid is damaged."""
_COVERED = 0.5
"""A cell of the terrain is closed if so much of it is known and occupied."""


# --- places -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Place:
    """Position, in metres of the terrain.

    heading_rad    clockwise from north: where it looks, or drives to if it moves; None if it does not tell
    speed_m_per_s  0 ... MOST_M_PER_S
    """

    x_m: float
    y_m: float
    heading_rad: float | None = None
    speed_m_per_s: float = 0.0


class FrameReader:
    """Reads positions in the map frame, in that of the terrain, or in a frame of the sender's.

    own       name of that frame; empty: there is none
    offset_m  where its origin lies in the map frame
    turn_rad  how far it is turned, counter-clockwise
    """

    def __init__(
        self, map: RosMap, own: str = "", offset_m: tuple[float, float] = (0.0, 0.0), turn_rad: float = 0.0
    ) -> None:
        self._map, self._own, self._offset_m, self._turn_rad = map, own.strip("/"), offset_m, turn_rad

    def pose(self, header: Any, pose: Any) -> Place:
        """Reads a geometry_msgs/Pose under a std_msgs/Header. Raises ConfigError."""
        towards = pose.orientation
        x_m, y_m = self.point(header, pose.position.x, pose.position.y)
        heading_rad = heading_of_quaternion(towards.x, towards.y, towards.z, towards.w)
        if heading_rad is not None and self._is_own(header):
            heading_rad = heading_of(yaw_of(heading_rad) + self._turn_rad)
        return Place(x_m, y_m, heading_rad)

    def point(self, header: Any, x: float, y: float) -> tuple[float, float]:
        """Metres of the terrain of a point under a header. Raises ConfigError."""
        if not (abs(x) <= _MOST_M and abs(y) <= _MOST_M):
            raise ConfigError(f"place is ({x!r}, {y!r}), expected numbers of metres")
        frame = header.frame_id.strip("/")
        if frame == TERRAIN_FRAME:
            x_m, y_m = x, y
        elif frame == self._map.frame or self._is_own(header):
            if self._is_own(header):
                cos, sin = math.cos(self._turn_rad), math.sin(self._turn_rad)
                x, y = cos * x - sin * y + self._offset_m[0], sin * x + cos * y + self._offset_m[1]
            x_m, y_m = self._map.to_terrain(x, y)
        else:
            known = " or ".join(repr(each) for each in (self._map.frame, self._own, TERRAIN_FRAME) if each)
            raise ConfigError(f"frame is {frame[:80]!r}, expected {known}")
        grid = self._map.grid
        if grid.cell_at(x_m, y_m) < 0:
            east_m, north_m = grid.cols * grid.resolution_m, grid.rows * grid.resolution_m
            x, y = self._map.to_ros(x_m, y_m)
            raise ConfigError(
                f"place ({x:.10g}, {y:.10g}) of frame {self._map.frame!r} is outside the terrain, expected x 0 ... "
                f"{east_m:.10g} and y 0 ... {north_m:.10g}"
            )
        return x_m, y_m

    def _is_own(self, header: Any) -> bool:
        return bool(self._own) and header.frame_id.strip("/") == self._own != self._map.frame


def robot_place(reader: FrameReader, message: Any) -> Place:
    """Reads nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped. Raises ConfigError."""
    with_covariance = hasattr(message.pose, "covariance")
    place = reader.pose(message.header, message.pose.pose if with_covariance else message.pose)
    twist = getattr(message, "twist", None)
    if twist is None:
        return place
    forward, left = twist.twist.linear.x, twist.twist.linear.y
    speed = math.hypot(forward, left)
    if not speed <= MOST_M_PER_S:
        raise ConfigError(f"speed is {speed!r} m/s, expected at most {MOST_M_PER_S:g}")
    if speed < _STANDS_M_PER_S:
        return place
    heading_rad = place.heading_rad
    if heading_rad is not None:
        # Direction of motion, not heading: a robot that reverses endangers the cells behind it.
        heading_rad = heading_of(yaw_of(heading_rad) + math.atan2(left, forward))
    return Place(place.x_m, place.y_m, heading_rad, speed)


class RobotTrack:
    """One robot's messages, over time: where it is, and when it is none any more.

    Only the time of arrival counts: clocks of robots may be simulated, leap or stand still.

    lease_s  time after its last valid message at which it counts as ended
    place    its last reported position; None before the first message and once it has ended
    """

    def __init__(self, reader: FrameReader, lease_s: float) -> None:
        self.place: Place | None = None
        self._reader, self._lease_s = reader, lease_s
        self._received_ns = 0

    def on_reading(self, message: Any, now_ns: int) -> Place:
        """Takes in where it is. Without a twist its speed is what two poses tell. Raises ConfigError."""
        found, before, since_ns = robot_place(self._reader, message), self.place, now_ns - self._received_ns
        if before is not None and not hasattr(message, "twist") and _LEAST_GAP_NS <= since_ns <= _MOST_GAP_NS:
            east_m, north_m = found.x_m - before.x_m, found.y_m - before.y_m
            speed = math.hypot(east_m, north_m) * NS_PER_S / since_ns
            if _STANDS_M_PER_S <= speed <= MOST_M_PER_S:  # or it stands, or was put somewhere else
                found = Place(found.x_m, found.y_m, math.atan2(east_m, north_m) % math.tau, speed)
        self.place, self._received_ns = found, now_ns
        return found

    def gone(self, now_ns: int) -> bool:
        """True if its lease has ended. Said once: it may come back."""
        if self.place is None or now_ns - self._received_ns <= self._lease_s * NS_PER_S:
            return False
        self.place = None
        return True


# --- areas --------------------------------------------------------------------------------------------------------


def corners_of(reader: FrameReader, message: Any) -> list[tuple[float, float]]:
    """Corners in metres of the terrain of a geometry_msgs/PolygonStamped; none of an empty one. Raises
    ConfigError."""
    points = message.polygon.points
    if points and not 3 <= len(points) <= MOST_CORNERS:
        raise ConfigError(
            f"polygon has {len(points)} corners, expected 3 ... {MOST_CORNERS}, or none to take the zone away"
        )
    return [reader.point(message.header, float(point.x), float(point.y)) for point in points]


def closed_cells(map: RosMap, message: Any, occupied: int) -> list[int]:
    """Cells of the terrain that a nav_msgs/OccupancyGrid closes, in order: those of which half or more lies under
    cells of the grid from `occupied` up to 100. Cells that are unknown (-1) or beyond the grid close nothing.

    Areas are exact: any resolution and origin in the map frame is resampled. Raises ConfigError, also on a turned
    grid.
    """
    _check_grid(map, message)
    info, grid = message.info, map.grid
    window = _window(map, info)
    if window.empty:
        raise ConfigError("grid lies outside the terrain")
    rows, cols = window.row1 - window.row0, window.col1 - window.col0
    if (rows + 1) * max(info.width, cols) + info.width * info.height > _MOST_WORK:
        raise ConfigError(
            f"grid has {info.width} x {info.height} cells over {rows} x {cols} of the terrain: too many at once"
        )
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
        raise ConfigError(f"grid closes {len(col)} cells of the terrain, expected at most {MOST_CELLS}")
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


def _check_grid(map: RosMap, message: Any) -> None:
    info, frame, many = message.info, message.header.frame_id.strip("/"), len(message.data)
    at, rotation = info.origin.position, info.origin.orientation
    fault = None
    if frame != map.frame:
        fault = f"frame is {frame[:80]!r}, expected {map.frame!r}"
    elif info.width * info.height != many or not many:
        fault = f"grid has {many} cells, expected width x height, {info.width} x {info.height}"
    elif not _LEAST_SIDE_M <= info.resolution < math.inf:
        fault = f"resolution is {float(info.resolution)!r} m, expected at least {_LEAST_SIDE_M:g}"
    elif not (abs(at.x) <= 1e9 and abs(at.y) <= 1e9):
        fault = f"origin is ({at.x!r}, {at.y!r}), expected numbers of metres"
    elif not all(abs(each) < 1e-6 for each in (rotation.x, rotation.y, rotation.z)):
        fault = "grid is turned, expected an origin whose orientation is (0, 0, 0, 1)"
    if fault is not None:
        raise ConfigError(fault)


def _window(map: RosMap, info: Any) -> Window:
    """Our cells that the grid touches."""
    grid, at = map.grid, info.origin.position
    side_m = grid.resolution_m
    south, north = (math.floor(y_m / side_m) for y_m in (at.y, at.y + info.height * float(info.resolution)))
    west, east = (math.floor(x_m / side_m) for x_m in (at.x, at.x + info.width * float(info.resolution)))
    return Window(
        max(grid.rows - 1 - north, 0), max(west, 0), min(grid.rows - south, grid.rows), min(east + 1, grid.cols)
    )
