"""ROS messages of what the swarm tells, and the frames in which they tell it: REP 103 and REP 105. Pure.

The swarm has metres of the terrain's own system, rows that begin in the north, and headings clockwise from north.
ROS has metres of a frame, grids whose row 0 is in the south, and yaw counter-clockwise from east (x), around z, up.
Places and headings go in as the swarm has them. Grids and markers are in `map_messages`.
"""

from __future__ import annotations

import enum
import math
import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.ros_types import RosTypes
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec

TERRAIN_FRAME = "terrain"
"""The frame whose metres are those of the terrain's coordinate system."""
ODOMETRY, PATH = "nav_msgs/msg/Odometry", "nav_msgs/msg/Path"
POSE, TRANSFORMS = "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
_LAST_NS = (1 << 31) * NS_PER_S - 1
"""Seconds of builtin_interfaces/Time are an int32."""
_MOST_PATHS = 256
"""Lengths of paths whose bytes are kept: 9 MB for 300 poses each."""
_STAMP, _POSE, _TWIST = struct.Struct("<iI"), struct.Struct("<7d"), struct.Struct("<6d")
_COVARIANCE_BYTES = 36 * 8
"""36 float64, at the end of a message."""
_LEVEL = (0.0, 0.0, 0.0, 1.0)
"""The quaternion (x, y, z, w) of no turn."""
Metres = TypeVar("Metres", float, NDArray[np.float64])
Place = tuple[float, float, float | None]
"""x, y in metres of the terrain, heading clockwise from north."""


class Level(enum.IntEnum):
    """Level of a diagnostic message."""

    OK = 0
    WARN = 1
    ERROR = 2


class Severity(enum.IntEnum):
    """Severity of a log message."""

    INFO = 20
    WARN = 30
    ERROR = 40


# --- frames -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RosMap:
    """Frame of all published positions: its origin is the outer south-west corner of the grid.

    It is not that of the terrain's system, as RViz computes in float32: half a metre at 5,200 km north.

    frame  its name
    """

    grid: GridSpec
    frame: str = "map"

    @property
    def origin_m(self) -> tuple[float, float]:
        """Position of the frame's origin in metres of the terrain: the translation of `TERRAIN_FRAME` ->
        `frame`."""
        return self.grid.west_m, self.grid.north_m - self.grid.rows * self.grid.resolution_m

    def to_ros(self, x_m: Metres, y_m: Metres) -> tuple[Metres, Metres]:
        """Metres of the terrain as metres of the frame."""
        west_m, south_m = self.origin_m
        return x_m - west_m, y_m - south_m

    def to_terrain(self, x_m: Metres, y_m: Metres) -> tuple[Metres, Metres]:
        """Metres of the frame as metres of the terrain."""
        west_m, south_m = self.origin_m
        return x_m + west_m, y_m + south_m


def ros_name(id: str) -> str:
    """An id as a part of a topic: a0-07 -> a0_07. ROS knows letters, digits and '_', and lets no part begin with a
    digit."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", id)
    return f"v{name}" if name[:1].isdigit() else name or "_"


def frames_of(name: str) -> tuple[str, str]:
    """The two frames of a vehicle (REP 105).

    The first lies where the map does, as the swarm tells no drift. The second is fixed to the vehicle: x forward, y
    to the left, z up.
    """
    return f"{name}/odom", f"{name}/base_link"


def yaw_of(heading_rad: float) -> float:
    """Counter-clockwise from east, above -pi and up to pi, of a heading clockwise from north."""
    return math.pi - (heading_rad + math.pi / 2) % math.tau


def heading_of(yaw_rad: float) -> float:
    """Clockwise from north, from 0 to below 2 pi, of a yaw counter-clockwise from east."""
    heading_rad = (math.pi / 2 - yaw_rad) % math.tau
    return heading_rad if heading_rad < math.tau else 0.0  # the rest of a tiny negative number is rounded up


def quaternion_of(heading_rad: float | None) -> tuple[float, float, float, float]:
    """Returns (x, y, z, w) of a level pose with this heading; without a heading it looks east, along x."""
    if heading_rad is None:
        return _LEVEL
    half_rad = yaw_of(heading_rad) / 2
    return 0.0, 0.0, math.sin(half_rad), math.cos(half_rad)


def heading_of_quaternion(x: float, y: float, z: float, w: float) -> float | None:
    """Returns the heading of a quaternion, with any roll and pitch; None if all four are 0, or one is not a number.

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
    steps = np.diff(points_m, axis=0)
    moves = steps.any(axis=1)
    if not moves.any():
        return [0.0] * len(points_m)
    headings = np.arctan2(*steps[moves].T) % math.tau
    newest = np.maximum(np.cumsum(moves) - 1, 0)  # of those before the first: the first
    found: list[float] = headings[np.append(newest, newest[-1])].tolist()
    return found


# --- messages -----------------------------------------------------------------------------------------------------


class RosMessages:
    """Makes messages. Parts of them are dicts, which `RosTypes.make` reads.

    types  of the distribution that hears them
    map    frame of published positions
    """

    def __init__(self, types: RosTypes, map: RosMap) -> None:
        self.types, self.map = types, map
        self._paths: dict[int, PackedPlaces] = {}
        """By number of poses."""

    def stamp(self, stamp_ns: int) -> dict[str, int]:
        """builtin_interfaces/Time of ns since 1970, or since a simulation began. It has 31 bits of seconds: times
        after 2038 are published as the last possible second."""
        sec, nanosec = divmod(min(max(stamp_ns, 0), _LAST_NS), NS_PER_S)
        return {"sec": sec, "nanosec": nanosec}

    def header(self, stamp_ns: int, frame: str | None = None) -> dict[str, Any]:
        """std_msgs/Header; without a frame, of the map."""
        return {"stamp": self.stamp(stamp_ns), "frame_id": self.map.frame if frame is None else frame}

    def pose(self, x_m: float, y_m: float, heading_rad: float | None = None) -> dict[str, Any]:
        """geometry_msgs/Pose in the map."""
        x, y = self.map.to_ros(x_m, y_m)
        return {"position": {"x": x, "y": y}, "orientation": _quaternion(heading_rad)}

    def pose_stamped(self, stamp_ns: int, x_m: float, y_m: float, heading_rad: float | None = None) -> Any:
        """geometry_msgs/PoseStamped."""
        return self.types.make(POSE, header=self.header(stamp_ns), pose=self.pose(x_m, y_m, heading_rad))

    def pose_array(
        self, stamp_ns: int, places_m: NDArray[np.floating[Any]], headings_rad: Iterable[float | None] | None = None
    ) -> Any:
        """geometry_msgs/PoseArray.

        places_m      float (n, 2): x, y
        headings_rad  one for each place
        """
        headings = [None] * len(places_m) if headings_rad is None else headings_rad
        poses = [self.pose(x, y, heading) for (x, y), heading in zip(places_m.tolist(), headings, strict=True)]
        return self.types.make("geometry_msgs/msg/PoseArray", header=self.header(stamp_ns), poses=poses)

    def path(self, stamp_ns: int, points_m: NDArray[np.float64] | Sequence[tuple[float, float]]) -> bytes:
        """CDR of nav_msgs/Path; each pose looks along the path. Without points it says that there is none.

        points_m  float64 (n, 2): x, y in metres of the terrain
        """
        points = np.asarray(points_m, np.float64).reshape(-1, 2)
        packed = self._paths.get(len(points))
        if packed is None:
            if len(self._paths) >= _MOST_PATHS:
                self._paths.clear()
            pose = {"header": self.header(_MARK_NS), "pose": self.pose(*_MARK_M)}
            made = self.types.make(PATH, header=self.header(_MARK_NS), poses=[pose] * len(points))
            packed = self._paths[len(points)] = PackedPlaces(self, made, PATH)
        places = zip(points[:, 0].tolist(), points[:, 1].tolist(), headings_along(points), strict=True)
        return packed.at(stamp_ns, list(places))

    def odometry(
        self, stamp_ns: int, frames: tuple[str, str], place: Place, speed_m_per_s: float, turn_rad_per_s: float
    ) -> Any:
        """nav_msgs/Odometry of a vehicle. Covariances are zeros, which readers take for "unknown".

        frames          of the pose, and of the twist
        speed_m_per_s   forward
        turn_rad_per_s  clockwise, as headings count
        """
        twist = {"linear": {"x": speed_m_per_s}, "angular": {"z": -turn_rad_per_s}}
        return self.types.make(
            ODOMETRY, header=self.header(stamp_ns, frames[0]), child_frame_id=frames[1],
            pose={"pose": self.pose(*place)}, twist={"twist": twist},
        )  # fmt: skip

    def transform(
        self,
        stamp_ns: int,
        frames: tuple[str, str],
        at_m: tuple[float, float] = (0.0, 0.0),
        heading_rad: float | None = None,
    ) -> dict[str, Any]:
        """geometry_msgs/TransformStamped.

        frames  the parent, and the child
        at_m    where the child lies in the parent
        """
        to = {"translation": {"x": at_m[0], "y": at_m[1]}, "rotation": _quaternion(heading_rad)}
        return {"header": self.header(stamp_ns, frames[0]), "child_frame_id": frames[1], "transform": to}

    def transforms(self, transforms: Iterable[Mapping[str, Any]]) -> Any:
        """tf2_msgs/TFMessage."""
        return self.types.make(TRANSFORMS, transforms=list(transforms))

    def fix(self, stamp_ns: int, frame: str, lat_deg: float, lon_deg: float) -> Any:
        """sensor_msgs/NavSatFix in WGS 84, by GPS; the altitude, above the ellipsoid, is not known."""
        return self.types.make(
            "sensor_msgs/msg/NavSatFix", header=self.header(stamp_ns, frame), status={"service": 1},
            latitude=lat_deg, longitude=lon_deg, altitude=math.nan,
        )  # fmt: skip

    def diagnostic(self, name: str, level: Level, message: str, values: Mapping[str, object]) -> Any:
        """diagnostic_msgs/DiagnosticStatus of one part of the swarm."""
        pairs = [{"key": key, "value": str(value)} for key, value in values.items()]
        status = "diagnostic_msgs/msg/DiagnosticStatus"
        return self.types.make(status, level=int(level), name=name, message=message, values=pairs)

    def log(self, stamp_ns: int, severity: Severity, name: str, text: str) -> Any:
        """rcl_interfaces/Log: a line of /rosout. The sender is `name`."""
        log = "rcl_interfaces/msg/Log"
        return self.types.make(log, stamp=self.stamp(stamp_ns), level=int(severity), name=name, msg=text)


def _quaternion(heading_rad: float | None) -> dict[str, float]:
    return dict(zip("xyzw", quaternion_of(heading_rad), strict=True))


# --- CDR without objects ------------------------------------------------------------------------------------------

_MARK_NS = 0x7EADBEEF * NS_PER_S + 0x3AC0FFEE
_MARK_M = (-7e280, 7e281)
"""A stamp and a place which are written over. No map's origin is so large that it changes such a place."""
_MARKS = _STAMP.pack(*divmod(_MARK_NS, NS_PER_S)), struct.pack("<3d", *_MARK_M, 0.0)


class PackedPlaces:
    """CDR of a message of which only stamps and places change, written into bytes made before.

    It serves messages that are published at every tick for every vehicle, and routes: objects take ten times as
    long for 100 vehicles. rosbags packs the first message, with a mark in the place of each stamp and each pose.
    Names and lengths stay, and so all stays where it was. Any thread may call `at`.
    """

    def __init__(self, messages: RosMessages, message: Any, type_name: str) -> None:
        self._map = messages.map
        self._bytes = bytearray(messages.types.pack(message, type_name))
        self._stamps, self._poses = (
            [found.start() for found in re.finditer(re.escape(mark), self._bytes)] for mark in _MARKS
        )

    def at(self, stamp_ns: int, places: Sequence[Place], twist: tuple[float, float] | None = None) -> bytes:
        """Returns the message of other places.

        places  as many as the message has, in their order
        twist   of odometry: speed forward in m/s, and turn clockwise in rad/s
        """
        content, stamp = self._bytes.copy(), divmod(stamp_ns, NS_PER_S)
        for at in self._stamps:
            _STAMP.pack_into(content, at, *stamp)
        for (x_m, y_m, heading_rad), at in zip(places, self._poses, strict=True):
            _POSE.pack_into(content, at, *self._map.to_ros(x_m, y_m), 0.0, *quaternion_of(heading_rad))
        if twist is not None:
            at = len(content) - _COVARIANCE_BYTES - _TWIST.size
            _TWIST.pack_into(content, at, twist[0], 0.0, 0.0, 0.0, 0.0, -twist[1])
        return bytes(content)


def packed_odometry(messages: RosMessages, frames: tuple[str, str]) -> PackedPlaces:
    """Odometry of one vehicle, as `RosMessages.odometry`."""
    return PackedPlaces(messages, messages.odometry(_MARK_NS, frames, (*_MARK_M, None), 0.0, 0.0), ODOMETRY)


def packed_pose(messages: RosMessages) -> PackedPlaces:
    """A pose, as `RosMessages.pose_stamped`."""
    return PackedPlaces(messages, messages.pose_stamped(_MARK_NS, *_MARK_M), POSE)


def packed_transforms(messages: RosMessages, frames: Iterable[tuple[str, str]]) -> PackedPlaces:
    """The transforms of some vehicles in one message.

    frames  (parent, child) of each
    """
    made = messages.transforms(messages.transform(_MARK_NS, each, _MARK_M) for each in frames)
    return PackedPlaces(messages, made, TRANSFORMS)
