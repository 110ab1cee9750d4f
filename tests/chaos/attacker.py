"""An attacker on the router, which hears everything that is said and says anything at all."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, cast

import msgspec
import zenoh

from swarm.bus.zenoh_bus import open_bus
from swarm.config.scenario import NetworkConfig
from swarm.errors import ProtocolError
from swarm.wire.codec import decode
from swarm.wire.messages.planning import TargetPose
from swarm.wire.topics import FLEET, POSE

_WAITING = 10_000
"""Most reports that wait to be looked at; the oldest are dropped."""
_KEYS = 5000


class Attacker:
    """A session of its own. It does not hear its own messages, so everything it hears is genuine."""

    def __init__(self, network: NetworkConfig) -> None:
        # The router may be dead for a while: an attacker waits longer than a process.
        self._bus = open_bus(msgspec.structs.replace(network, connect_timeout_s=60.0))
        self._waiting: deque[bytes] = deque(maxlen=_WAITING)
        self._there = threading.Event()
        self._last: dict[str, Any] = {}
        """Key -> the last sample under it."""
        self._namespace = network.namespace
        self._captures: dict[str, int] = {}
        """Target -> how often it was captured, by its last pose. A tracker that starts again counts from 0."""
        self._captured = 0
        self._heard = (
            self._subscribe(FLEET.expression(network.namespace), self._hear_fleet),
            self._subscribe(POSE.expression(network.namespace), self._hear_pose),
        )

    def _subscribe(self, key: str, hear: Callable[[Any], None]) -> Any:
        return self._bus.session.declare_subscriber(key, hear, allowed_origin=zenoh.Locality.REMOTE)

    def _hear_fleet(self, sample: Any) -> None:
        self._waiting.append(sample.payload.to_bytes())
        self._there.set()

    def _hear_pose(self, sample: Any) -> None:
        with contextlib.suppress(ProtocolError):
            pose = cast(TargetPose, decode(sample.payload.to_bytes(), POSE.message))
            self._captured += max(pose.captures - self._captures.get(pose.target, 0), 0)
            self._captures[pose.target] = pose.captures

    def captures(self) -> int:
        """Captures of all targets until now."""
        return self._captured

    def _hear(self, sample: Any) -> None:
        key = str(sample.key_expr)
        if key in self._last or len(self._last) < _KEYS:
            self._last[key] = sample

    def reports(self, timeout_s: float) -> list[bytes]:
        """All reports about vehicles since the last time; waits for one."""
        if not self._waiting:
            self._there.clear()
            self._there.wait(timeout_s)
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    @contextlib.contextmanager
    def listening_to_all(self) -> Iterator[dict[str, Any]]:
        """Key -> the last sample under it, filled while the block lasts: thousands of messages a second, for which
        a busy machine has no time all along."""
        self._last = {}
        ear = self._subscribe(f"{self._namespace}/**", self._hear)
        try:
            yield self._last
        finally:
            ear.undeclare()

    def say(self, key: str, payload: bytes, code: bytes | None) -> None:
        # Like the puts of our own processes: to block would wait for the slowest reader of the run.
        dropping = zenoh.CongestionControl.DROP
        self._bus.session.put(key, payload, congestion_control=dropping, attachment=code)

    def close(self) -> None:
        for ear in self._heard:
            ear.undeclare()
        self._bus.close()
