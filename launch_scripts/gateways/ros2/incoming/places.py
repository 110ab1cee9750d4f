"""Where ROS says something is, as places of the terrain; and why that is none, in a sentence. Pure.

No message raises here, whatever numbers and names are in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from launch_scripts.gateways.ros2.frames import TERRAIN_FRAME, RosMap, heading_of, heading_of_quaternion, yaw_of
from launch_scripts.gateways.ros2.incoming.settings import ROBOT, Robots
from swarm.wire.messages.vehicles import MOST_M_PER_S

_STANDS_M_PER_S = 0.05
"""What is slower does not drive anywhere: odometry of a robot that stands is seldom 0."""
_MOST_M = 1e12
_MOST_GAP_NS = 2_000_000_000
_LEAST_GAP_NS = 20_000_000
"""Two poses tell a speed if they are not nearer in time, nor further apart."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where something is, in metres of the terrain.

    heading_rad    clockwise from north: where it looks, or drives to if it moves; None if it does not tell
    speed_m_per_s  0 ... MOST_M_PER_S
    """

    x_m: float
    y_m: float
    heading_rad: float | None = None
    speed_m_per_s: float = 0.0


class FrameReader:
    """Reads places that are told in the map frame, in that of the terrain, or in one of somebody's own.

    own       name of that frame; empty: there is none
    offset_m  where its origin lies in the map frame
    turn_rad  how far it is turned, counter-clockwise
    """

    def __init__(
        self, map: RosMap, own: str = "", offset_m: tuple[float, float] = (0.0, 0.0), turn_rad: float = 0.0
    ) -> None:
        self._map, self._own, self._offset_m, self._turn_rad = map, own.strip("/"), offset_m, turn_rad

    @classmethod
    def of(cls, robots: Robots, robot: str, map: RosMap) -> FrameReader:
        """For what a robot tells."""
        return cls(map, robots.frame.replace(ROBOT, robot), robots.offset_m, robots.turn_rad)

    def pose(self, header: Any, pose: Any) -> Place | str:
        """Of a geometry_msgs/Pose under a std_msgs/Header."""
        at, towards = pose.position, pose.orientation
        found = self.point(header, at.x, at.y)
        if isinstance(found, str):
            return found
        heading_rad = heading_of_quaternion(towards.x, towards.y, towards.z, towards.w)
        if heading_rad is not None and self._is_own(header):
            heading_rad = heading_of(yaw_of(heading_rad) + self._turn_rad)
        return Place(*found, heading_rad)

    def point(self, header: Any, x: float, y: float) -> tuple[float, float] | str:
        """Metres of the terrain of a point under a header."""
        if not (abs(x) <= _MOST_M and abs(y) <= _MOST_M):
            return f"place is ({x!r}, {y!r}), expected numbers of metres"
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
            return f"frame is {frame[:80]!r}, expected {known}"
        if self._map.grid.cell_at(x_m, y_m) < 0:
            grid = self._map.grid
            east_m, north_m = grid.cols * grid.resolution_m, grid.rows * grid.resolution_m
            x, y = self._map.to_ros(x_m, y_m)
            return (
                f"place ({x:.10g}, {y:.10g}) of frame {self._map.frame!r} is outside the terrain, expected x 0 ... "
                f"{east_m:.10g} and y 0 ... {north_m:.10g}"
            )
        return x_m, y_m

    def _is_own(self, header: Any) -> bool:
        return bool(self._own) and header.frame_id.strip("/") == self._own != self._map.frame


def robot_place(reader: FrameReader, message: Any) -> Place | str:
    """Of nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped."""
    with_covariance = hasattr(message.pose, "covariance")
    place = reader.pose(message.header, message.pose.pose if with_covariance else message.pose)
    twist = getattr(message, "twist", None)
    if isinstance(place, str) or twist is None:
        return place
    forward, left = twist.twist.linear.x, twist.twist.linear.y
    speed = math.hypot(forward, left)
    if not speed <= MOST_M_PER_S:
        return f"speed is {speed!r} m/s, expected at most {MOST_M_PER_S:g}"
    if speed < _STANDS_M_PER_S:
        return place
    if place.heading_rad is None:
        return Place(place.x_m, place.y_m, None, speed)
    # Where it goes, not where it looks: what drives backwards endangers what is behind.
    return Place(place.x_m, place.y_m, heading_of(yaw_of(place.heading_rad) + math.atan2(left, forward)), speed)


def with_speed(before: tuple[Place, int] | None, now: Place, now_ns: int) -> Place:
    """A place with the speed that two poses tell, of a robot whose messages have none.

    before  where it was, and when that was heard
    """
    if before is None or now.speed_m_per_s or not _LEAST_GAP_NS <= now_ns - before[1] <= _MOST_GAP_NS:
        return now
    east_m, north_m = now.x_m - before[0].x_m, now.y_m - before[0].y_m
    speed = math.hypot(east_m, north_m) * 1e9 / (now_ns - before[1])
    if not _STANDS_M_PER_S <= speed <= MOST_M_PER_S:
        return now  # it stands, or was put somewhere else
    return Place(now.x_m, now.y_m, math.atan2(east_m, north_m) % math.tau, speed)
