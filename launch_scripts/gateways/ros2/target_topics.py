"""The topics of targets. Core: no bus, no clock."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping

import numpy as np

from launch_scripts.gateways.ros2.actions import Action, Channel, Declare, Put
from launch_scripts.gateways.ros2.messages import RosMessages
from launch_scripts.gateways.ros2.names import ros_name
from launch_scripts.gateways.ros2.topics import TARGET, TopicRow
from swarm.client.observer import SeenTarget


class TargetTopics:
    """The targets that ROS is told of. What nobody tracks may be anywhere: it is told again when somebody does.

    rows     of the table that are forwarded
    problem  is called with a sentence for people
    """

    def __init__(self, rows: Mapping[str, TopicRow], messages: RosMessages, problem: Callable[[str], None]) -> None:
        self._rows = rows
        self._messages = messages
        self._problem = problem
        self._ids: dict[str, str] = {}
        """Name in ROS -> id."""
        self._refused: set[str] = set()

    def follow(self, seen: Mapping[str, SeenTarget]) -> list[Action]:
        """Topics of targets that are new are declared. A target of a scenario stays."""
        actions: list[Action] = []
        for id in seen:
            name = ros_name(id)
            if self._ids.get(name) == id or id in self._refused:
                continue
            if name in self._ids:
                self._refused.add(id)
                self._problem(f"target {id} is not told to ROS: {self._ids[name]} is called {name}, too")
                continue
            self._ids[name] = id
            if "target_pose" in self._rows:
                actions.append(Declare((self._channel("target_pose", name),)))
        return actions

    def tell(self, due: Collection[str], seen: Mapping[str, SeenTarget], stamp_ns: int) -> Iterator[Action]:
        """Messages of the rows that are due."""
        tracked = {name: seen[id] for name, id in self._ids.items() if id in seen and not seen[id].lost}
        if "target_pose" in due:
            for name, each in tracked.items():
                pose = self._messages.pose_stamped(stamp_ns, each.x_m, each.y_m)
                yield Put(self._channel("target_pose", name), pose)
        if "targets" in due:
            places = [(each.x_m, each.y_m) for each in sorted(tracked.values(), key=lambda each: each.id)]
            array = self._messages.pose_array(stamp_ns, np.array(places, np.float64).reshape(-1, 2))
            yield Put(self._channel("targets", ""), array)

    def _channel(self, row: str, name: str) -> Channel:
        return Channel(row, self._rows[row].topic.replace(TARGET, name))
