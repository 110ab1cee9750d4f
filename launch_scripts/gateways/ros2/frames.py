"""Where things lie for ROS, and which way they look: REP 103 and REP 105. Pure.

The swarm has metres of the terrain's own system, rows that begin in the north, and headings clockwise from north.
ROS has metres of a frame, grids whose row 0 is in the south, and yaw counter-clockwise from east (x), around z, up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from swarm.grid import GridSpec

TERRAIN_FRAME = "terrain"
"""The frame whose metres are those of the terrain's coordinate system."""
Metres = TypeVar("Metres", float, NDArray[np.float64])


@dataclass(frozen=True, slots=True)
class RosMap:
    """The frame in which all is told: its origin is the outer south-west corner of the grid.

    It is not that of the terrain's system, as RViz computes in float32: half a metre at 5,200 km north.

    frame  its name
    """

    grid: GridSpec
    frame: str = "map"

    @property
    def origin_m(self) -> tuple[float, float]:
        """Where the frame's origin lies in metres of the terrain: what `TERRAIN_FRAME` -> `frame` translates by."""
        return self.grid.west_m, self.grid.north_m - self.grid.rows * self.grid.resolution_m

    def to_ros(self, x_m: Metres, y_m: Metres) -> tuple[Metres, Metres]:
        """Metres of the terrain as metres of the frame."""
        west_m, south_m = self.origin_m
        return x_m - west_m, y_m - south_m

    def to_terrain(self, x_m: Metres, y_m: Metres) -> tuple[Metres, Metres]:
        """Metres of the frame as metres of the terrain."""
        west_m, south_m = self.origin_m
        return x_m + west_m, y_m + south_m


def odom_frame(id: str) -> str:
    """Of a vehicle, between the map and its base (REP 105). Both lie in one place: the swarm tells no drift."""
    return f"{id}/odom"


def base_frame(id: str) -> str:
    """Fixed to a vehicle: x forward, y to the left, z up."""
    return f"{id}/base_link"


def yaw_of(heading_rad: float) -> float:
    """Counter-clockwise from east, above -pi and up to pi, of a heading clockwise from north."""
    return math.pi - (heading_rad + math.pi / 2) % math.tau


def heading_of(yaw_rad: float) -> float:
    """Clockwise from north, from 0 to below 2 pi, of a yaw counter-clockwise from east."""
    heading_rad = (math.pi / 2 - yaw_rad) % math.tau
    return heading_rad if heading_rad < math.tau else 0.0  # the rest of a tiny negative number is rounded up


def quaternion_of(heading_rad: float) -> tuple[float, float, float, float]:
    """(x, y, z, w) of what stands level and looks there."""
    half_rad = yaw_of(heading_rad) / 2
    return 0.0, 0.0, math.sin(half_rad), math.cos(half_rad)


def heading_of_quaternion(x: float, y: float, z: float, w: float) -> float | None:
    """The heading of what is turned so, whatever its roll and pitch; None if all four are 0, or one is no number.

    It need not be of length 1, as what others send is not always.
    """
    length = math.hypot(x, y, z, w)
    if not 1e-9 < length < math.inf:
        return None
    x, y, z, w = (each / length for each in (x, y, z, w))
    return heading_of(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def headings_along(points_m: NDArray[np.float64]) -> list[float]:
    """The heading at each point of a line to the next one; at the last, and where two are one, as before.

    points_m  float64 (n, 2): x to the east, y to the north
    """
    headings: list[float] = []
    steps = np.diff(points_m, axis=0).tolist()
    moving = [math.atan2(east_m, north_m) % math.tau for east_m, north_m in steps if east_m or north_m]
    at = -1
    for east_m, north_m in steps:
        at += bool(east_m or north_m)
        headings.append(moving[max(at, 0)] if moving else 0.0)
    return (headings + (headings[-1:] or [0.0]))[: len(points_m)]
