"""Nodes for tests: one which calls back, and one without a network."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from launch_scripts.gateways.ros2.rmw import Endpoint, NodeName, Qos
from launch_scripts.gateways.ros2.ros_node import Node
from launch_scripts.gateways.ros2.ros_types import RosTypes


class PeerNode(Node):
    """A node of ours as a peer."""

    def subscribe(self, topic: str, type_name: str, hear: Callable[[Any], None], qos: Qos = Qos.DEFAULT) -> None:
        """Calls `hear` with what came last, on a thread of its own."""
        newest = self.newest(topic, type_name, qos)

        def read() -> None:
            while newest.endpoint in self.endpoints:
                if (message := newest.take()) is not None:
                    hear(message)
                time.sleep(0.002)

        threading.Thread(target=read, daemon=True).start()


class FakeNewest:
    """The newest message of a topic, put there by a test."""

    def __init__(self, topic: str) -> None:
        self.endpoint = SimpleNamespace(topic=topic)
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
        self.name = NodeName(0, "fake", "swarm_gateway")
        self.tell: Callable[[Endpoint, bool], None] = lambda seen, there: None
        self.topics: dict[str, FakeNewest] = {}
        self.heard: dict[str, list[Any]] = {}

    def watch(self, domain: str, seen: Callable[[Endpoint, bool], None]) -> None:
        self.tell = seen

    def newest(self, topic: str, *_: Any, **__: Any) -> FakeNewest:
        return self.topics.setdefault(topic, FakeNewest(topic))

    def publisher(self, topic: str, *_: Any) -> Any:
        told = self.heard.setdefault(topic, [])
        return SimpleNamespace(endpoint=topic, put=told.append)

    def serve(self, name: str, *_: Any) -> str:
        return name

    def remove(self, endpoint: Any) -> None:
        pass
