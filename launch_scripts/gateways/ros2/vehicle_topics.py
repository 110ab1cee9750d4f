"""The topics of vehicles: they come and go with them. Core: no bus, no clock."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from launch_scripts.gateways.ros2.actions import Action, Channel, Declare, Put, Remove
from launch_scripts.gateways.ros2.frames import base_frame, odom_frame
from launch_scripts.gateways.ros2.messages import RosMessages
from launch_scripts.gateways.ros2.moving import Moving
from launch_scripts.gateways.ros2.names import ros_name
from launch_scripts.gateways.ros2.packed_path import packed_path
from launch_scripts.gateways.ros2.packed_places import PackedOdometry, PackedPose, PackedTransforms
from launch_scripts.gateways.ros2.topics import VEHICLE, TopicRow
from swarm.client.observer import SeenVehicle

MOST_VEHICLES = 1000
"""More are not told: each has topics of its own, and each topic a token."""
BARE = ("tf", "tf_static")
"""Topics that each vehicle has for itself where its frames are bare."""
ToWgs84 = Callable[[float, float], tuple[float, float]]


class VehicleTopics:
    """The vehicles that ROS is told of.

    rows      of the table that are forwarded
    patterns  of ids of vehicles to tell, with * and ?
    bare      frames without the name of the vehicle, under /VEHICLE/tf
    to_wgs84  (latitude, longitude) of a place of the terrain; None: there is no fix
    problem   is called with a sentence for people
    """

    def __init__(
        self,
        rows: Mapping[str, TopicRow],
        messages: RosMessages,
        patterns: Iterable[str],
        bare: bool,
        to_wgs84: ToWgs84 | None,
        problem: Callable[[str], None],
    ) -> None:
        self._rows = rows
        self._messages = messages
        self._patterns = tuple(patterns)
        self._bare = bare
        self._to_wgs84 = to_wgs84
        self._problem = problem
        self._told: dict[str, Moving] = {}
        """By name in ROS."""
        self._odometry: dict[str, PackedOdometry] = {}
        self._own_transform: dict[str, PackedTransforms] = {}
        """Of each where frames are bare."""
        self._transforms: PackedTransforms | None = None
        """Of all in their order; None when others have come since it was made."""
        self._pose = PackedPose(messages)
        self._wanted: dict[str, bool] = {}
        """Ids that were matched with the patterns. Cleared when vehicles leave, so that it does not grow."""
        self._refused: set[str] = set()

    @property
    def told(self) -> Iterable[Moving]:
        return self._told.values()

    def follow(self, seen: Mapping[str, SeenVehicle], now_ns: int, stamp_ns: int) -> list[Action]:
        """Take in who is where. Topics of those that are new are declared, of those that have left taken down.

        now_ns    by a clock that never leaps
        stamp_ns  since 1970
        """
        gone = [name for name, moving in self._told.items() if moving.id not in seen]
        actions: list[Action] = [Remove(self._channels(name)) for name in gone]
        for name in gone:
            del self._told[name], self._odometry[name]
            self._own_transform.pop(name, None)
        if gone:
            self._transforms = None
            self._wanted.clear()
            self._refused.clear()  # their names are free
        came = [new for id, each in seen.items() if (new := self._take(id, each, now_ns)) is not None]
        actions += [Declare(self._channels(name)) for name in came]
        if "tf_static" in self._rows and self._told:
            if self._bare:
                actions += [
                    self._put("tf_static", self._static([self._told[name]], stamp_ns), name) for name in came
                ]
            elif came or gone:
                actions.append(self._put("tf_static", self._static(self.told, stamp_ns)))
        return actions

    def _take(self, id: str, seen: SeenVehicle, now_ns: int) -> str | None:
        """The name of a vehicle that is told from now on; None of one that is known, or not told."""
        name = ros_name(id)
        moving = self._told.get(name)
        if moving is not None and moving.id == id:
            moving.take(seen, now_ns)
            return None
        if id not in self._wanted:
            self._wanted[id] = any(fnmatchcase(id, pattern) for pattern in self._patterns)
        if not self._wanted[id] or id in self._refused:
            return None
        if moving is not None or len(self._told) >= MOST_VEHICLES:
            self._refused.add(id)
            why = f"there are {MOST_VEHICLES} already" if moving is None else f"{moving.id} is called {name}, too"
            self._problem(f"vehicle {id} is not told to ROS: {why}")
            return None
        self._told[name] = Moving(id, name, seen, now_ns)
        odom, base = self._frames(name)
        self._odometry[name] = PackedOdometry(self._messages, odom, base)
        self._transforms = None
        if self._bare:
            self._own_transform[name] = PackedTransforms(self._messages, [(odom, base)])
        return name

    def route(self, id: str, points_m: Iterable[tuple[float, float]]) -> None:
        """A vehicle has begun to follow another route."""
        moving = self._told.get(ros_name(id))
        if moving is not None and moving.id == id:
            moving.follow(np.array(list(points_m), np.float64).reshape(-1, 2))

    def tell(self, due: Collection[str], now_ns: int, stamp_ns: int) -> Iterator[Action]:
        """Messages of the rows that are due. Times as those of `follow`."""
        for moving in self._told.values():
            yield from self._of_one(due, moving, now_ns, stamp_ns)
        if "tf" in due and not self._bare and self._told:
            if self._transforms is None:
                self._transforms = PackedTransforms(self._messages, [self._frames(name) for name in self._told])
            places = [moving.place for moving in self._told.values()]
            yield self._put("tf", self._transforms.at(stamp_ns, places))
        if "poses" in due:
            told = sorted(self._told.values(), key=lambda moving: moving.id)
            points_m = np.array([(each.x_m, each.y_m) for each in told], np.float64).reshape(-1, 2)
            headings = [each.heading_rad for each in told]
            yield self._put("poses", self._messages.pose_array(stamp_ns, points_m, headings))

    def _of_one(self, due: Collection[str], moving: Moving, now_ns: int, stamp_ns: int) -> Iterator[Action]:
        messages, name = self._messages, moving.name
        if "odom" in due:
            speeds = moving.speed_m_per_s, moving.turn_rad_per_s
            yield self._put("odom", self._odometry[name].at(stamp_ns, moving.place, *speeds), name)
        if "pose" in due:
            yield self._put("pose", self._pose.at(stamp_ns, moving.place), name)
        if "fix" in due and self._to_wgs84 is not None:
            frame = self._frames(name)[1]
            yield self._put("fix", messages.fix(stamp_ns, frame, *self._to_wgs84(moving.x_m, moving.y_m)), name)
        if "plan" in due and moving.route_is_due(now_ns):
            moving.route_is_new, moving.route_told_ns = False, now_ns
            yield self._put("plan", packed_path(messages.map, stamp_ns, moving.route), name)
        if "tf" in due and self._bare:
            yield self._put("tf", self._own_transform[name].at(stamp_ns, [moving.place]), name)

    def _frames(self, name: str) -> tuple[str, str]:
        """Of a vehicle: the one that does not move, and its own."""
        return ("odom", "base_link") if self._bare else (odom_frame(name), base_frame(name))

    def _static(self, told: Iterable[Moving], stamp_ns: int) -> Any:
        transforms = []
        for moving in told:
            transform = self._messages.vehicle_transforms(
                stamp_ns, moving.name, *self._messages.map.origin_m, None
            )[0]
            transform.child_frame_id = self._frames(moving.name)[0]
            transforms.append(transform)
        return self._messages.transforms(transforms)

    def _channels(self, name: str) -> tuple[Channel, ...]:
        return tuple(
            self._channel(row.name, name)
            for row in self._rows.values()
            if row.per == VEHICLE or (self._bare and row.name in BARE)
        )

    def _channel(self, row: str, name: str | None) -> Channel:
        topic = self._rows[row].topic
        if name is None:
            return Channel(row, topic)
        return Channel(row, topic.replace(VEHICLE, name) if VEHICLE in topic else f"/{name}{topic}")

    def _put(self, row: str, message: Any, name: str | None = None) -> Put:
        return Put(self._channel(row, name), message)
