"""A ROS 2 node on a Zenoh session: publishers, subscriptions, services and clients that rmw_zenoh understands.

Called back on Zenoh's threads, with messages that are parsed; what cannot be parsed is counted and dropped.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import zenoh
from zenoh import ext
from zenoh.handlers import Callback

from launch_scripts.gateways.ros2.rmw import Attachment, Endpoint, Kind, NodeName, Qos, read_token
from launch_scripts.gateways.ros2.ros_types import LARGEST_MESSAGE_BYTES, REQUEST, RESPONSE, RosTypes
from swarm.errors import BusError, ProtocolError

log = logging.getLogger(__name__)

_HEARTBEAT_S = 0.5
"""A latched message that was lost is missed by its subscribers this long after it was put. Nothing is sent while
nothing new is put."""


class Publisher:
    """Puts messages of one type on one topic. `put` may be called by one thread at a time."""

    def __init__(self, types: RosTypes, endpoint: Endpoint, put: Callable[..., None]) -> None:
        self.endpoint = endpoint
        self._types, self._put = types, put
        self._sequence = itertools.count(1)
        self._gid = endpoint.gid

    def put(self, message: Any) -> None:
        """Puts a message, or CDR that was made before. Raises BusError if Zenoh refuses it."""
        content = self._types.pack(message, self.endpoint.type_name)
        attachment = Attachment(next(self._sequence), time.time_ns(), self._gid)
        try:
            self._put(content, attachment=attachment.packed())
        except zenoh.ZError as error:
            raise BusError(f"{self.endpoint.topic} is not put: {error}") from error


class Newest:
    """Last message of a topic that was not taken yet. Made by `Node.newest`."""

    def __init__(self, node: Node, endpoint: Endpoint, most_bytes: int) -> None:
        self.endpoint = endpoint
        self._node, self._most_bytes = node, most_bytes
        self._waiting: deque[zenoh.Sample] = deque(maxlen=1)

    def keep(self, sample: zenoh.Sample) -> None:
        """On Zenoh's threads: keeps the bytes as they are."""
        self._waiting.append(sample)

    def take(self) -> Any | None:
        """The newest message, once; None if none has come, or it is none of its type."""
        try:
            payload = self._waiting.pop().payload
        except IndexError:
            return None
        try:
            if len(payload) > self._most_bytes:
                raise ProtocolError(f"message of {len(payload)} bytes, expected at most {self._most_bytes}")
            return self._node.types.unpack(payload.to_bytes(), self.endpoint.type_name)
        except ProtocolError as error:
            self._node.dropped(self.endpoint.topic, error)
            return None

    def close(self) -> None:
        """Hears no more."""
        self._node.remove(self.endpoint)


class Node:
    """A node with its endpoints, until `close`.

    session  with timestamps on, a client of the ROS side's router (`open_ros`)
    """

    def __init__(self, session: zenoh.Session, name: str, types: RosTypes, domain: int = 0) -> None:
        self.name = NodeName(domain, str(session.info.zid()), name)
        self.types = types
        self.counts: Counter[str] = Counter()
        self._session = session
        self._numbers = itertools.count(1)
        self._declared: dict[Endpoint, list[Any]] = {}
        self._own: list[Any] = [session.liveliness().declare_token(self.name.token)]
        self._lock = threading.Lock()

    @property
    def endpoints(self) -> list[Endpoint]:
        """Endpoints that are declared now."""
        with self._lock:
            return list(self._declared)

    @property
    def connected(self) -> bool:
        """True if a router is connected now. Zenoh connects again by itself, and repeats all declarations there."""
        return bool(self._session.info.routers_zid())

    def publisher(self, topic: str, type_name: str, qos: Qos = Qos.DEFAULT) -> Publisher:
        endpoint = self._endpoint(Kind.PUBLISHER, topic, type_name, qos)
        reliability = zenoh.Reliability.BEST_EFFORT if qos is Qos.SENSOR else zenoh.Reliability.RELIABLE
        made: Any
        if qos is Qos.LATCHED:
            made = ext.declare_advanced_publisher(
                self._session,
                endpoint.key,
                reliability=reliability,
                cache=ext.CacheConfig(1),
                publisher_detection=True,
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
            )
        else:
            made = self._session.declare_publisher(endpoint.key, reliability=reliability)
        self._declare(endpoint, made)
        return Publisher(self.types, endpoint, made.put)

    def newest(
        self, topic: str, type_name: str, qos: Qos = Qos.DEFAULT, most_bytes: int = LARGEST_MESSAGE_BYTES
    ) -> Newest:
        """Subscribes, and keeps only what came last until it is taken: a flood costs no more than one message."""
        endpoint = self._endpoint(Kind.SUBSCRIPTION, topic, type_name, qos)
        newest = Newest(self, endpoint, most_bytes)
        made: Any
        # This node ignores its own messages: a topic may go both ways.
        if qos is Qos.LATCHED:
            made = ext.declare_advanced_subscriber(
                self._session,
                endpoint.key,
                newest.keep,
                allowed_origin=zenoh.Locality.REMOTE,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
                recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        else:
            made = self._session.declare_subscriber(endpoint.key, newest.keep, allowed_origin=zenoh.Locality.REMOTE)
        self._declare(endpoint, made)
        return newest

    def serve(self, name: str, type_name: str, answer: Callable[[Any, Callable[[Any], None]], None]) -> Endpoint:
        """Answers a service.

        `answer(request, reply)` is called on Zenoh's thread and must return soon; `reply` is called once, then or
        later, on any thread, with a response or its CDR. A client of ROS waits for ever for a missing reply, so
        errors go into the response.
        """
        endpoint = self._endpoint(Kind.SERVICE, name, type_name, Qos.DEFAULT)

        def take(query: zenoh.Query) -> None:
            try:
                asked = Attachment.of(query.attachment.to_bytes() if query.attachment else b"")
                content = query.payload.to_bytes() if query.payload else b""
                request = self.types.unpack(content, type_name + REQUEST)
            except ProtocolError as error:
                self.dropped(name, error)
                return

            def reply(response: Any) -> None:
                attachment = Attachment(asked.sequence, time.time_ns(), asked.gid).packed()
                content = self.types.pack(response, type_name + RESPONSE)
                with query, suppress(zenoh.ZError):  # the session may be closed, or the link cut
                    query.reply(endpoint.key, content, attachment=attachment)

            answer(request, reply)

        made = self._session.declare_queryable(endpoint.key, Callback(take), complete=True)
        self._declare(endpoint, made)
        return endpoint

    def watch(self, domain: str, seen: Callable[[Endpoint, bool], None]) -> None:
        """Tells of every endpoint of others that is there, comes (True) or goes (False): of a domain, or of "*"."""

        def take(sample: zenoh.Sample) -> None:
            try:
                endpoint = read_token(str(sample.key_expr))
            except ProtocolError as error:
                self.dropped("tokens", error)
                return
            if endpoint is not None and endpoint.node.zid != self.name.zid:
                seen(endpoint, sample.kind == zenoh.SampleKind.PUT)

        # No `get` of tokens: beside a subscription it blocks for ever beyond 256 of them. History brings all.
        self._own.append(
            self._session.liveliness().declare_subscriber(f"@ros2_lv/{domain}/**", Callback(take), history=True)
        )

    def remove(self, endpoint: Endpoint) -> None:
        """Takes an endpoint back. Its last message is not repeated to late subscribers any more."""
        with self._lock:
            declared = self._declared.pop(endpoint, [])
        for each in declared:
            each.undeclare()

    def close(self) -> None:
        """Takes back all, as `remove` does. The session stays open."""
        for endpoint in list(self._declared):
            self.remove(endpoint)
        for each in self._own:
            each.undeclare()
        self._own = []

    def _endpoint(self, kind: Kind, topic: str, type_name: str, qos: Qos) -> Endpoint:
        type_hash = self.types.hash_of(type_name)
        return Endpoint(self.name, next(self._numbers), kind, topic, type_name, type_hash, qos.value)

    def _declare(self, endpoint: Endpoint, made: Any) -> None:
        token = self._session.liveliness().declare_token(endpoint.token)
        with self._lock:
            self._declared[endpoint] = [token, made]

    def dropped(self, topic: str, error: ProtocolError) -> None:
        """Counts messages of another type."""
        self.counts["dropped"] += 1
        log.debug("%s: %s", topic, error)


def open_ros(endpoint: str, timeout_s: float = 10.0) -> zenoh.Session:
    """A session for a node, such as open_ros("tcp/127.0.0.1:7447"). Raises BusError if no router answers there.

    A client, never a peer: a router of rmw_zenoh does not forward between peers. With timestamps, without which
    latched topics are refused.
    """
    config = zenoh.Config()
    for key, value in {
        "mode": '"client"',
        "connect/endpoints": f'["{endpoint}"]',
        "connect/timeout_ms": str(int(timeout_s * 1000)),
        "timestamping/enabled": "true",
        "scouting/multicast/enabled": "false",
        "scouting/gossip/enabled": "false",
    }.items():
        config.insert_json5(key, value)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise BusError(f"no router of the ROS side answers at {endpoint}: {error}") from error
