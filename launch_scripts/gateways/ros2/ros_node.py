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
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import Any

import zenoh
from zenoh import ext
from zenoh.handlers import Callback

from launch_scripts.gateways.ros2 import rmw
from launch_scripts.gateways.ros2.gateway_settings import TopicRow
from launch_scripts.gateways.ros2.rmw import Endpoint, Kind, NodeName, Qos
from launch_scripts.gateways.ros2.ros_types import REQUEST, RESPONSE, RosTypes
from swarm.clock import NS_PER_S
from swarm.errors import BusError, ProtocolError, SwarmError

log = logging.getLogger(__name__)

_HEARTBEAT_S = 0.5
"""A latched message that was lost is missed by its subscribers this long after it was put. Nothing is sent while
nothing new is put."""
_MOST_BYTES = 1 << 14
"""A pose, a goal or a polygon of 256 corners is smaller."""
Failed = Callable[[str], None]


class Publisher:
    """Puts messages of one type on one topic. `put` may be called by one thread at a time."""

    def __init__(self, node: Node, endpoint: Endpoint, put: Callable[..., None]) -> None:
        self.endpoint = endpoint
        self._node, self._put = node, put
        self._sequence = itertools.count(1)
        self._gid = endpoint.gid

    def put(self, message: Any) -> None:
        """Puts a message, or CDR that was made before. One that Zenoh refuses, as without a link, is counted and
        lost."""
        content = self._node.types.pack(message, self.endpoint.type_name)
        try:
            self._put(content, attachment=rmw.attachment(next(self._sequence), time.time_ns(), self._gid))
            self._node.counts["put"] += 1
        except zenoh.ZError as error:
            self._node.counts["put_failed"] += 1
            log.debug("%s is not put: %s", self.endpoint.topic, error)


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
        self._own = ExitStack()
        """Takes back the node's token, and what it watches."""
        self._own.callback(session.liveliness().declare_token(self.name.token).undeclare)
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

    def publisher(self, topic: str, row: TopicRow) -> Publisher:
        endpoint = self._endpoint(Kind.PUBLISHER, topic, row)
        reliability = zenoh.Reliability.BEST_EFFORT if row.qos is Qos.SENSOR else zenoh.Reliability.RELIABLE
        made: Any
        if row.qos is Qos.LATCHED:
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
        return Publisher(self, endpoint, made.put)

    def listen(self, topic: str, row: TopicRow, keep: Callable[[zenoh.Sample], object]) -> Endpoint:
        """Subscribes. `keep` is called with each sample on Zenoh's threads; `read` makes a message of one."""
        endpoint = self._endpoint(Kind.SUBSCRIPTION, topic, row)
        made: Any
        # This node ignores its own messages: a topic may go both ways.
        if row.qos is Qos.LATCHED:
            made = ext.declare_advanced_subscriber(
                self._session,
                endpoint.key,
                keep,
                allowed_origin=zenoh.Locality.REMOTE,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
                recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        else:
            made = self._session.declare_subscriber(endpoint.key, keep, allowed_origin=zenoh.Locality.REMOTE)
        self._declare(endpoint, made)
        return endpoint

    def read(self, endpoint: Endpoint, sample: zenoh.Sample, most_bytes: int) -> Any | None:
        """The message of a sample; None if it is none of its type, or larger than allowed."""
        try:
            if len(sample.payload) > most_bytes:
                raise ProtocolError(f"message of {len(sample.payload)} bytes, expected at most {most_bytes}")
            return self.types.unpack(sample.payload.to_bytes(), endpoint.type_name)
        except ProtocolError as error:
            self.dropped(endpoint.topic, error)
            return None

    def serve(self, topic: str, row: TopicRow, answer: Callable[[Any, Callable[[Any], None]], None]) -> Endpoint:
        """Answers a service.

        `answer(request, reply)` is called on Zenoh's thread and must return soon; `reply` is called once, then or
        later, on any thread, with a response or its CDR. A client of ROS waits for ever for a missing reply, so
        errors go into the response.
        """
        endpoint = self._endpoint(Kind.SERVICE, topic, row)

        def take(query: zenoh.Query) -> None:
            try:
                sequence, _, gid = rmw.read_attachment(query.attachment.to_bytes() if query.attachment else b"")
                content = query.payload.to_bytes() if query.payload else b""
                request = self.types.unpack(content, row.type_name + REQUEST)
            except ProtocolError as error:
                self.dropped(topic, error)
                return

            def reply(response: Any) -> None:
                content = self.types.pack(response, row.type_name + RESPONSE)
                with query, suppress(zenoh.ZError):  # the session may be closed, or the link cut
                    query.reply(endpoint.key, content, attachment=rmw.attachment(sequence, time.time_ns(), gid))

            answer(request, reply)

        made = self._session.declare_queryable(endpoint.key, Callback(take), complete=True)
        self._declare(endpoint, made)
        return endpoint

    def watch(self, domain: str, seen: Callable[[Endpoint, bool], None]) -> None:
        """Tells of every endpoint of others that is there, comes (True) or goes (False): of a domain, or of "*"."""

        def take(sample: zenoh.Sample) -> None:
            try:
                endpoint = rmw.read_token(str(sample.key_expr))
            except ProtocolError as error:
                self.dropped("tokens", error)
                return
            if endpoint is not None and endpoint.node.zid != self.name.zid:
                seen(endpoint, sample.kind == zenoh.SampleKind.PUT)

        # No `get` of tokens: beside a subscription it blocks for ever beyond 256 of them. History brings all.
        tokens, key = self._session.liveliness(), f"{rmw.TOKEN_SPACE}/{domain}/**"
        self._own.callback(tokens.declare_subscriber(key, Callback(take), history=True).undeclare)

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
        self._own.close()

    def _endpoint(self, kind: Kind, topic: str, row: TopicRow) -> Endpoint:
        type_hash = self.types.hash_of(row.type_name)
        return Endpoint(self.name, next(self._numbers), kind, topic, row.type_name, type_hash, row.qos.value)

    def _declare(self, endpoint: Endpoint, made: Any) -> None:
        token = self._session.liveliness().declare_token(endpoint.token)
        with self._lock:
            self._declared[endpoint] = [token, made]

    def dropped(self, topic: str, error: ProtocolError) -> None:
        """Counts messages of another type."""
        self.counts["dropped"] += 1
        log.debug("%s: %s", topic, error)


# --- what no flood from ROS fills: the newest message of a topic, and a bounded queue -----------------------------


class WorkQueue:
    """Does work that may wait, on threads of its own.

    most  the pieces that may wait, or are at work
    """

    def __init__(self, name: str, threads: int, most: int) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix=name)
        self._room = threading.Semaphore(most)

    def give(self, what: str, work: Callable[[], None], failed: Failed) -> bool:
        """Does it when its turn comes; `failed` is called with a sentence if it raises, or the queue is closed.
        Returns False, and does nothing, if too much waits already."""
        if not self._room.acquire(blocking=False):
            return False

        def end(done: Future[None]) -> None:
            self._room.release()
            if done.cancelled():
                failed("the gateway ends")
            elif isinstance(error := done.exception(), SwarmError):
                failed(str(error))
            elif error is not None:
                log.error("%s failed", what, exc_info=error)
                failed(f"{what} failed: see the gateway's log")

        try:
            self._pool.submit(work).add_done_callback(end)
        except RuntimeError:  # it is closed
            failed("the gateway ends")
        return True

    def close(self) -> None:
        """Takes nothing more, and waits for nothing."""
        self._pool.shutdown(wait=False, cancel_futures=True)


class Input:
    """The newest message of a topic, taken at ticks and at most at this interval.

    row    its type, quality and rate
    take   is called with it, and the time by time.monotonic_ns. Raises SwarmError on a refused message
    queue  `take` may wait, and is called by its thread; None: it is called by `tick`
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        row: TopicRow,
        take: Callable[[Any, int], None],
        *,
        most_bytes: int = _MOST_BYTES,
        queue: WorkQueue | None = None,
    ) -> None:
        self.refused = 0
        self._node, self._take, self._most_bytes, self._queue = node, take, most_bytes, queue
        self._period_ns = int(NS_PER_S / row.hz) if row.hz else 0
        self._due_ns = 0
        self._waiting: deque[zenoh.Sample] = deque(maxlen=1)
        self._held: Any = None
        """Message for which the queue had no room."""
        self._logged: str | None = None
        self.endpoint = node.listen(topic, row, self._waiting.append)

    def tick(self, now_ns: int) -> None:
        """Processes received messages, if that is due."""
        if now_ns < self._due_ns:
            return
        message = self._held
        if self._waiting:  # only the newest is decoded
            message = self._node.read(self.endpoint, self._waiting.pop(), self._most_bytes) or self._held
        if message is None:
            return
        self._due_ns, self._held = now_ns + self._period_ns, None
        if self._queue is not None:
            work = f"a message of {self.endpoint.topic}", lambda: self._try(message, now_ns), self.refuse
            self._held = None if self._queue.give(*work) else message
            return
        try:
            self._try(message, now_ns)
        except SwarmError as error:
            self.refuse(str(error))

    def refuse(self, sentence: str) -> None:
        """Says why a message is refused; what begins in the same way is said once, until one is not refused."""
        self.refused += 1
        kind = sentence.partition(" is ")[0]
        if kind != self._logged:
            self._logged = kind
            log.warning("topic %s: %s", self.endpoint.topic, sentence)

    def _try(self, message: Any, now_ns: int) -> None:
        self._take(message, now_ns)
        self._logged = None


# --- the session --------------------------------------------------------------------------------------------------


def open_ros(endpoint: str, timeout_s: float = 10.0) -> zenoh.Session:
    """A session for a node, at an endpoint such as tcp/127.0.0.1:7447. Raises BusError if no router answers there.

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
