"""Nodes for tests: one which calls back, and one without a network."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from launch_scripts.gateways.ros2.gateway_settings import TopicRow
from launch_scripts.gateways.ros2.rmw import Endpoint, NodeName, Qos
from launch_scripts.gateways.ros2.ros_node import Input, Node
from launch_scripts.gateways.ros2.ros_types import LARGEST_MESSAGE_BYTES, RosTypes


class PeerNode(Node):
    """A node of ours as a peer."""

    def subscribe(self, topic: str, type_name: str, hear: Callable[[Any], None], qos: Qos = Qos.DEFAULT) -> None:
        """Calls `hear` with what came last, on a thread of its own."""
        row = TopicRow("heard", topic, type_name, qos, "", hz=1000.0)
        reader = Input(self, topic, row, lambda message, _: hear(message), most_bytes=LARGEST_MESSAGE_BYTES)

        def read() -> None:
            while reader.endpoint in self.endpoints:
                reader.tick(time.monotonic_ns())
                time.sleep(0.002)

        threading.Thread(target=read, daemon=True).start()


class FakeNode:
    """A node whose topics a test hears and says.

    received  topic -> messages that were put
    topics    topic -> where a test puts a message that comes
    """

    def __init__(self, types: RosTypes) -> None:
        self.types = types
        self.name = NodeName(0, "fake", "swarm_gateway")
        self.report: Callable[[Endpoint, bool], None] = lambda seen, there: None
        self.topics: dict[str, Any] = {}
        self.received: dict[str, list[Any]] = {}

    def watch(self, domain: str, seen: Callable[[Endpoint, bool], None]) -> None:
        self.report = seen

    def listen(self, topic: str, row: TopicRow, keep: Callable[[Any], object]) -> Any:
        self.topics[topic] = SimpleNamespace(waiting=SimpleNamespace(append=keep))
        return SimpleNamespace(topic=topic)

    def read(self, endpoint: Endpoint, sample: Any, most_bytes: int) -> Any:
        return sample

    def publisher(self, topic: str, *_: Any) -> Any:
        messages = self.received.setdefault(topic, [])
        return SimpleNamespace(endpoint=topic, put=messages.append)

    def serve(self, name: str, *_: Any) -> str:
        return name

    def remove(self, endpoint: Any) -> None:
        pass
