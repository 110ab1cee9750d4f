"""A foreign ROS 2 peer: zenoh-ros2-sdk and nothing of ours. Run by `ros_peer.RosPeer`, a line of JSON per word.

argv: folder of definitions, port of the router, seconds after which it ends by itself. It ends with its input, too.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import threading
import time
from typing import Any

import numpy as np
from zenoh_ros2_sdk.message_registry import get_registry

DEFINITIONS, PORT, ENDS_S = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
get_registry(DEFINITIONS)  # the first call wins: definitions from here, no git

from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2Subscriber  # noqa: E402
from zenoh_ros2_sdk.session import ZenohSession  # noqa: E402

_MOST_ITEMS = 4096
"""Elements of an array that are printed, which keeps a map readable as a line."""


def as_fields(value: Any) -> Any:
    """A message as JSON has it."""
    if dataclasses.is_dataclass(value):
        fields = (field.name for field in dataclasses.fields(value) if not field.name.startswith("__"))
        return {name: as_fields(getattr(value, name)) for name in fields}
    if isinstance(value, np.ndarray):
        return value[:_MOST_ITEMS].tolist()
    if isinstance(value, (list, tuple)):
        return [as_fields(each) for each in value[:_MOST_ITEMS]]
    return value


def made(store: Any, name: str, given: dict[str, Any]) -> Any:
    """A message of a type: missing fields are 0, empty or false."""
    known = name if name in store.fielddefs else name.replace("/srv/", "/srv/msg/")
    return store.types[known](
        **{field: _value(store, kind, given.get(field)) for field, kind in store.fielddefs[known][1]}
    )


def _value(store: Any, kind: Any, given: Any) -> Any:
    node, inner = kind[0].name, kind[1]
    if node == "NAME":
        return made(store, inner, given or {})
    if node == "BASE":
        if given is None:
            given = "" if inner[0] == "string" else 0
        if inner[0] == "string":
            return str(given)
        return bool(given) if inner[0] == "bool" else float(given) if "float" in inner[0] else int(given)
    (of, base), length = inner
    if of.name == "NAME":
        return [made(store, base, each) for each in given or []]
    if base[0] == "string":
        return list(given or [])
    return np.array(given if given is not None else [0] * (length if node == "ARRAY" else 0), dtype=base[0])


class Peer:
    def __init__(self) -> None:
        self._publishers: dict[str, ROS2Publisher] = {}
        self._clients: dict[str, ROS2ServiceClient] = {}
        self._kept: list[Any] = []
        self._repeated: dict[str, tuple[Any, float]] = {}
        self._lock = threading.Lock()

    def say(self, **words: Any) -> None:
        with self._lock:
            sys.stdout.write(json.dumps(words) + "\n")
            sys.stdout.flush()

    def hear(self, topic: str, type: str) -> None:
        def received(message: Any) -> None:
            self.say(received=topic, message=as_fields(message))

        self._kept.append(ROS2Subscriber(topic=topic, msg_type=type, callback=received, router_port=PORT))

    def put(self, topic: str, type: str, fields: dict[str, Any], hz: float | None = None) -> None:
        if topic not in self._publishers:
            self._publishers[topic] = ROS2Publisher(topic=topic, msg_type=type, router_port=PORT)
        message = made(ZenohSession.get_instance().store, type, fields)
        if hz is None:
            self._publish(topic, message)
            return
        begun = topic in self._repeated
        self._repeated[topic] = message, hz
        if not begun:
            threading.Thread(target=self._repeat, args=(topic,), daemon=True).start()

    def ask(self, service: str, type: str, fields: dict[str, Any], timeout_s: float) -> None:
        """Answers with the response, or None without one, and how long it took."""
        if service not in self._clients:
            self._clients[service] = ROS2ServiceClient(
                service_name=service, srv_type=type, router_port=PORT, timeout=timeout_s
            )
            time.sleep(0.3)  # until its querier knows who answers
        request = made(ZenohSession.get_instance().store, f"{type}_Request", fields)
        parts = {field.name: getattr(request, field.name) for field in dataclasses.fields(request)}
        parts = {name: value for name, value in parts.items() if not name.startswith("__")}
        began_ns = time.perf_counter_ns()
        response = self._clients[service].call(**parts)
        self.say(answer=service, message=as_fields(response), took_ms=(time.perf_counter_ns() - began_ns) / 1e6)

    def _publish(self, topic: str, message: Any) -> None:
        parts = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}
        self._publishers[topic].publish(**{k: v for k, v in parts.items() if not k.startswith("__")})

    def _repeat(self, topic: str) -> None:
        while True:
            message, hz = self._repeated[topic]
            self._publish(topic, message)
            time.sleep(1 / hz)


def main() -> None:
    threading.Timer(ENDS_S, os._exit, (3,)).start()
    ZenohSession.get_instance("127.0.0.1", PORT)
    peer = Peer()
    peer.say(ready=True)
    for line in sys.stdin:
        words = json.loads(line)
        do = words.pop("do")
        getattr(peer, do)(**words)
        peer.say(done=do)
    os._exit(0)


main()
