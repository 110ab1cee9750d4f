"""ROS messages of what the swarm tells: poses, odometry, routes, transforms, fixes, diagnostics, log. Pure.

Places go in as metres of the terrain and headings as the swarm has them, clockwise from north; what comes out is as
REP 103 and REP 105 want it: metres of the map frame, yaw counter-clockwise from east. Grids are in `grids`, markers
in `markers`.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.frames import (
    TERRAIN_FRAME,
    RosMap,
    base_frame,
    headings_along,
    odom_frame,
    quaternion_of,
)
from launch_scripts.gateways.ros2.types import RosTypes
from swarm.clock import NS_PER_S

_COVARIANCE = np.zeros(36, np.float64)
"""Of poses and twists: all zeros, which readers take for "not told"."""
_LAST_NS = (1 << 31) * NS_PER_S - 1


class Level(enum.IntEnum):
    """How bad something is: of diagnostics."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Severity(enum.IntEnum):
    """How bad something is: of log messages."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


class RosMessages:
    """Makes messages.

    types  of the distribution that hears them
    map    the frame in which places are told
    """

    def __init__(self, types: RosTypes, map: RosMap) -> None:
        self.types, self.map = types, map
        self._make = types.make

    def time(self, stamp_ns: int) -> Any:
        """builtin_interfaces/Time of ns since 1970, or since a simulation began. It has 31 bits of seconds: what is
        after 2038 is told as the last second there is."""
        sec, nanosec = divmod(min(max(stamp_ns, 0), _LAST_NS), NS_PER_S)
        return self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def duration(self, seconds: float) -> Any:
        """builtin_interfaces/Duration."""
        sec, nanosec = divmod(round(seconds * NS_PER_S), NS_PER_S)
        return self._make("builtin_interfaces/msg/Duration", sec=sec, nanosec=nanosec)

    def header(self, stamp_ns: int, frame: str | None = None) -> Any:
        """std_msgs/Header; without a frame, of the map."""
        frame_id = self.map.frame if frame is None else frame
        return self._make("std_msgs/msg/Header", stamp=self.time(stamp_ns), frame_id=frame_id)

    def pose(self, x_m: float, y_m: float, heading_rad: float | None = None, z_m: float = 0.0) -> Any:
        """geometry_msgs/Pose in the map; what looks nowhere in particular looks east, along x."""
        x_m, y_m = self.map.to_ros(x_m, y_m)
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x_m, y=y_m, z=z_m),
            orientation=self._quaternion(heading_rad),
        )

    def pose_stamped(
        self, stamp_ns: int, x_m: float, y_m: float, heading_rad: float | None = None, z_m: float = 0.0
    ) -> Any:
        """geometry_msgs/PoseStamped."""
        pose = self.pose(x_m, y_m, heading_rad, z_m)
        return self._make("geometry_msgs/msg/PoseStamped", header=self.header(stamp_ns), pose=pose)

    def pose_array(
        self, stamp_ns: int, places_m: NDArray[np.floating[Any]], headings_rad: Iterable[float | None] | None = None
    ) -> Any:
        """geometry_msgs/PoseArray.

        places_m      float (n, 2): x, y
        headings_rad  one for each place
        """
        headings = [None] * len(places_m) if headings_rad is None else headings_rad
        poses = [self.pose(x, y, heading) for (x, y), heading in zip(places_m.tolist(), headings, strict=True)]
        return self._make("geometry_msgs/msg/PoseArray", header=self.header(stamp_ns), poses=poses)

    def odometry(
        self,
        stamp_ns: int,
        id: str,
        x_m: float,
        y_m: float,
        heading_rad: float | None,
        speed_m_per_s: float = 0.0,
        turn_rad_per_s: float = 0.0,
    ) -> Any:
        """nav_msgs/Odometry of a vehicle: its pose in `odom_frame`, its twist in `base_frame`.

        speed_m_per_s   forward
        turn_rad_per_s  clockwise, as headings count
        """
        twist = self._make(
            "geometry_msgs/msg/Twist",
            linear=self._vector(speed_m_per_s),
            angular=self._vector(0.0, 0.0, -turn_rad_per_s),
        )
        return self._make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, odom_frame(id)),
            child_frame_id=base_frame(id),
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self.pose(x_m, y_m, heading_rad),
                covariance=_COVARIANCE,
            ),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=_COVARIANCE),
        )

    def path(self, stamp_ns: int, points_m: NDArray[np.float64] | Sequence[tuple[float, float]]) -> Any:
        """nav_msgs/Path: each pose looks along the path. Without points it says that there is none.

        points_m  float64 (n, 2): x, y
        """
        points = np.asarray(points_m, np.float64).reshape(-1, 2)
        header = self.header(stamp_ns)
        poses = [
            self._make("geometry_msgs/msg/PoseStamped", header=header, pose=self.pose(x_m, y_m, heading_rad))
            for (x_m, y_m), heading_rad in zip(points.tolist(), headings_along(points), strict=True)
        ]
        return self._make("nav_msgs/msg/Path", header=header, poses=poses)

    def vehicle_transforms(
        self, stamp_ns: int, id: str, x_m: float, y_m: float, heading_rad: float | None, z_m: float = 0.0
    ) -> list[Any]:
        """map -> <id>/odom, which is the identity, -> <id>/base_link: geometry_msgs/TransformStamped."""
        x_m, y_m = self.map.to_ros(x_m, y_m)
        return [
            self._transform(stamp_ns, self.map.frame, odom_frame(id), (0.0, 0.0, 0.0), None),
            self._transform(stamp_ns, odom_frame(id), base_frame(id), (x_m, y_m, z_m), heading_rad),
        ]

    def map_transform(self, stamp_ns: int) -> Any:
        """terrain -> map, which never changes: geometry_msgs/TransformStamped for /tf_static."""
        return self._transform(stamp_ns, TERRAIN_FRAME, self.map.frame, (*self.map.origin_m, 0.0), None)

    def transforms(self, transforms: Iterable[Any]) -> Any:
        """tf2_msgs/TFMessage."""
        return self._make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def fix(self, stamp_ns: int, frame: str, lat_deg: float, lon_deg: float, alt_m: float = float("nan")) -> Any:
        """sensor_msgs/NavSatFix in WGS 84; the altitude, above the ellipsoid, is NaN where it is not known."""
        return self._make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(stamp_ns, frame),
            status=self._make("sensor_msgs/msg/NavSatStatus", status=0, service=1),  # a fix, by GPS
            latitude=lat_deg,
            longitude=lon_deg,
            altitude=alt_m,
            position_covariance=np.zeros(9, np.float64),
            position_covariance_type=0,  # not known
        )

    def diagnostic(
        self, name: str, level: Level, message: str, values: Mapping[str, object], hardware: str = ""
    ) -> Any:
        """diagnostic_msgs/DiagnosticStatus of one part of the swarm."""
        return self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=int(level),
            name=name,
            message=message,
            hardware_id=hardware,
            values=[
                self._make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
                for key, value in values.items()
            ],
        )

    def diagnostics(self, stamp_ns: int, statuses: Iterable[Any]) -> Any:
        """diagnostic_msgs/DiagnosticArray."""
        header = self.header(stamp_ns, "")
        return self._make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=list(statuses))

    def log(self, stamp_ns: int, severity: Severity, name: str, text: str) -> Any:
        """rcl_interfaces/Log: a line of /rosout. Who says it is `name`."""
        return self._make(
            "rcl_interfaces/msg/Log",
            stamp=self.time(stamp_ns),
            level=int(severity),
            name=name,
            msg=text,
            file="",
            function="",
            line=0,
        )

    def _transform(
        self,
        stamp_ns: int,
        parent: str,
        child: str,
        place_m: tuple[float, float, float],
        heading_rad: float | None,
    ) -> Any:
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector(*place_m),
            rotation=self._quaternion(heading_rad),
        )
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )

    def _vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _quaternion(self, heading_rad: float | None) -> Any:
        x, y, z, w = (0.0, 0.0, 0.0, 1.0) if heading_rad is None else quaternion_of(heading_rad)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
