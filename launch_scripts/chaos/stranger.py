"""A stranger on the router: hears everything that is said, and says anything at all."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import msgspec
import zenoh

from swarm.bus.zenoh_bus import open_bus
from swarm.config.scenario import NetworkConfig
from swarm.wire.topics import FLEET

_WAITING = 10_000
"""Most reports that wait to be looked at; the oldest are dropped."""
_KEYS = 5000


class Stranger:
    """A session of its own. What it says itself it does not hear, so what it hears is genuine."""

    def __init__(self, network: NetworkConfig) -> None:
        # The router may be dead for a while: a stranger waits longer than a process.
        self._bus = open_bus(msgspec.structs.replace(network, connect_timeout_s=60.0))
        self._waiting: deque[bytes] = deque(maxlen=_WAITING)
        self._there = threading.Event()
        self._last: dict[str, Any] = {}
        """Key -> the last sample under it."""
        session, namespace = self._bus.session, network.namespace
        self._ears = [
            session.declare_subscriber(key, hear, allowed_origin=zenoh.Locality.REMOTE)
            for key, hear in ((FLEET.expression(namespace), self._hear_fleet), (f"{namespace}/**", self._hear))
        ]

    def _hear_fleet(self, sample: Any) -> None:
        self._waiting.append(sample.payload.to_bytes())
        self._there.set()

    def _hear(self, sample: Any) -> None:
        # Two thousand a second: so nothing is done here but to keep it.
        key = str(sample.key_expr)
        if key in self._last or len(self._last) < _KEYS:
            self._last[key] = sample

    def reports(self, timeout_s: float) -> list[bytes]:
        """All reports about vehicles since the last time; waits for one."""
        if not self._waiting:
            self._there.clear()
            self._there.wait(timeout_s)
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def said(self) -> list[tuple[str, bytes]]:
        """The last payload of every key."""
        return [(key, sample.payload.to_bytes()) for key, sample in sorted(self._last.copy().items())]

    def say(self, key: str, payload: bytes) -> None:
        # As our own processes put: to block would wait for the slowest reader of the run.
        self._bus.session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def close(self) -> None:
        for ear in self._ears:
            ear.undeclare()  # type: ignore[no-untyped-call]
        self._bus.close()
