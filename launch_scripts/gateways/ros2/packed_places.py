"""CDR of what is put at every tick for every vehicle: odometry, pose, transforms, written into bytes made before.

rosbags makes and packs the first message of each; later ones have the same names of frames, so all but numbers lies
where it did. Behind the names everything has a fixed size, so that numbers are found from the end. For 100 vehicles
this takes a tenth of the time that objects take; a test compares the bytes of both.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from launch_scripts.gateways.ros2.frames import RosMap, quaternion_of
from launch_scripts.gateways.ros2.messages import RosMessages
from swarm.clock import NS_PER_S

ODOMETRY, POSE, TRANSFORMS = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
_STAMP, _POSE, _TWIST = struct.Struct("<iI"), struct.Struct("<7d"), struct.Struct("<6d")
_HEADER_BYTES = 4
_COVARIANCE_BYTES = 36 * 8
_LEVEL = (0.0, 0.0, 0.0, 1.0)
Place = tuple[float, float, float | None]
"""x, y in metres of the terrain, heading clockwise from north."""


class PackedOdometry:
    """messages  whose map it is told in; frame, child  names of the frames of pose and twist"""

    def __init__(self, messages: RosMessages, frame: str, child: str) -> None:
        first = messages.odometry(0, "", *messages.map.origin_m, None)
        first.header.frame_id, first.child_frame_id = frame, child
        self._bytes = bytearray(messages.types.pack(first, ODOMETRY))
        self._map = messages.map
        self._twist_at = len(self._bytes) - _COVARIANCE_BYTES - _TWIST.size
        self._pose_at = self._twist_at - _COVARIANCE_BYTES - _POSE.size

    def at(self, stamp_ns: int, place: Place, speed_m_per_s: float, turn_rad_per_s: float) -> bytes:
        """As `RosMessages.odometry`."""
        _STAMP.pack_into(self._bytes, _HEADER_BYTES, *divmod(stamp_ns, NS_PER_S))
        _POSE.pack_into(self._bytes, self._pose_at, *_numbers(self._map, place))
        _TWIST.pack_into(self._bytes, self._twist_at, speed_m_per_s, 0.0, 0.0, 0.0, 0.0, -turn_rad_per_s)
        return bytes(self._bytes)


class PackedPose:
    """messages  in whose map the pose is told"""

    def __init__(self, messages: RosMessages) -> None:
        self._bytes = bytearray(messages.types.pack(messages.pose_stamped(0, *messages.map.origin_m), POSE))
        self._map = messages.map

    def at(self, stamp_ns: int, place: Place) -> bytes:
        """As `RosMessages.pose_stamped`."""
        _STAMP.pack_into(self._bytes, _HEADER_BYTES, *divmod(stamp_ns, NS_PER_S))
        _POSE.pack_into(self._bytes, len(self._bytes) - _POSE.size, *_numbers(self._map, place))
        return bytes(self._bytes)


class PackedTransforms:
    """The transforms of some vehicles, in one message.

    frames  (parent, child) of each
    """

    def __init__(self, messages: RosMessages, frames: Sequence[tuple[str, str]]) -> None:
        told = []
        for parent, child in frames:
            transform = messages.vehicle_transforms(0, "", *messages.map.origin_m, None)[1]
            transform.header.frame_id, transform.child_frame_id = parent, child
            told.append(transform)
        self._bytes = bytearray(messages.types.pack(messages.transforms(told), TRANSFORMS))
        self._map = messages.map
        self._at: list[tuple[int, int]] = []
        """Where stamp and numbers of each lie."""
        at = 4  # behind the count; without the header, as CDR aligns by that
        for parent, child in frames:
            stamp_at = at
            at = _behind(_behind(at + _STAMP.size, parent), child)
            at += -at % 8
            self._at.append((stamp_at + _HEADER_BYTES, at + _HEADER_BYTES))
            at += _POSE.size

    def at(self, stamp_ns: int, places: Sequence[Place]) -> bytes:
        """As `RosMessages.transforms` of the second of `vehicle_transforms` of each.

        places  as many as there are frames, in their order
        """
        content, stamp = self._bytes, divmod(stamp_ns, NS_PER_S)
        for place, (stamp_at, numbers_at) in zip(places, self._at, strict=True):
            _STAMP.pack_into(content, stamp_at, *stamp)
            _POSE.pack_into(content, numbers_at, *_numbers(self._map, place))
        return bytes(content)


def _behind(at: int, text: str) -> int:
    """Where a text ends that is written at the next multiple of 4: its length, its bytes, a zero."""
    return at + -at % 4 + 4 + len(text.encode()) + 1


def _numbers(map: RosMap, place: Place) -> tuple[float, ...]:
    x_m, y_m, heading_rad = place
    return *map.to_ros(x_m, y_m), 0.0, *(_LEVEL if heading_rad is None else quaternion_of(heading_rad))
