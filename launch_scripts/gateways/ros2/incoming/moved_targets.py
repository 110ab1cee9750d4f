"""External targets that ROS moves: the last place that was said is told on, until another comes."""

from __future__ import annotations

import logging

from launch_scripts.gateways.ros2.incoming.place_routes import TRACKER
from launch_scripts.gateways.ros2.incoming.places import FrameReader
from launch_scripts.gateways.ros2.incoming.settings import TARGET
from launch_scripts.gateways.ros2.names import ros_name
from launch_scripts.gateways.ros2.node import Node
from swarm.client import Swarm, SwarmError, Target
from swarm.clock import NS_PER_S

log = logging.getLogger(__name__)

_EVERY_NS = NS_PER_S // 10
_MOST_BYTES = 1 << 14


class MovedTarget:
    """One target. A person who clicks once in RViz puts it somewhere: it stays there while the gateway lives."""

    def __init__(self, id: str, set_pose: str, node: Node, swarm: Swarm, reader: FrameReader) -> None:
        self.id = id
        self._swarm, self._reader = swarm, reader
        self._target: Target | None = None
        self._due_ns = 0
        self._said: str | None = None
        self._poses = node.newest(
            set_pose.replace(TARGET, ros_name(id)), "geometry_msgs/msg/PoseStamped", most_bytes=_MOST_BYTES
        )

    def tick(self, now_ns: int) -> None:
        """Put it where it was said to be, at most ten times a second."""
        if now_ns < self._due_ns or (message := self._poses.take()) is None:
            return
        self._due_ns = now_ns + _EVERY_NS
        place = self._reader.pose(message.header, message.pose)
        if isinstance(place, str):
            self._say(place)
            return
        try:
            if self._target is None:
                self._target = self._swarm.target(self.id, tracker=TRACKER)
            self._target.at(place.x_m, place.y_m)
            self._said = None
        except SwarmError as error:
            self._say(str(error))

    def close(self) -> None:
        """Hand it over to another tracker, if there is one."""
        self._poses.close()
        if self._target is not None:
            self._target.leave()

    def _say(self, sentence: str) -> None:
        kind = sentence.partition(" is ")[0]
        if kind != self._said:
            self._said = kind
            log.warning("topic %s: %s", self._poses.endpoint.topic, sentence)
