"""Nodes for tests: one which hears each message, as no gateway does, and one without a network."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import zenoh

from launch_scripts.gateways.ros2.rmw import Endpoint, Kind, Qos
from launch_scripts.gateways.ros2.ros_node import Node
from launch_scripts.gateways.ros2.ros_types import RosTypes
from swarm.errors import ProtocolError


class PeerNode(Node):
    """A node of ours as a peer."""

    def subscribe(
        self, topic: str, type_name: str, hear: Callable[[Any], None], qos: Qos = Qos.DEFAULT
    ) -> Endpoint:
        endpoint = self._endpoint(Kind.SUBSCRIPTION, topic, type_name, qos)

        def take(sample: zenoh.Sample) -> None:
            try:
                hear(self.types.unpack(sample.payload.to_bytes(), type_name))
            except ProtocolError as error:
                self.dropped(topic, error)

        self._listen(endpoint, qos, take)
        return endpoint


class FakeNewest:
    """What came last on a topic, put there by a test."""

    def __init__(self, topic: str) -> None:
        self.endpoint = SimpleNamespace(topic=topic)
        self.wake: Callable[[], None] | None = None
        self.waiting: deque[Any] = deque(maxlen=1)

    def take(self) -> Any | None:
        return self.waiting.pop() if self.waiting else None

    def close(self) -> None:
        pass


class FakeNode:
    """A node whose topics a test hears and says.

    heard  topic -> messages that were put
    """

    def __init__(self, types: RosTypes) -> None:
        self.types = types
        self.topics: dict[str, FakeNewest] = {}
        self.heard: dict[str, list[Any]] = {}

    def newest(self, topic: str, *_: Any, **__: Any) -> FakeNewest:
        return self.topics.setdefault(topic, FakeNewest(topic))

    def publisher(self, topic: str, *_: Any) -> Any:
        told = self.heard.setdefault(topic, [])
        return SimpleNamespace(endpoint=topic, put=told.append)

    def serve(self, name: str, *_: Any) -> str:
        return name

    def remove(self, endpoint: Any) -> None:
        pass
