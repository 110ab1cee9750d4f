"""A stranger on the router: hears everything that is said, and says anything at all."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import msgspec
import zenoh

from swarm.bus.zenoh_bus import open_bus
from swarm.config.scenario import NetworkConfig

_WAITING = 100_000
"""Most messages that wait to be looked at; the oldest are dropped."""


class Stranger:
    """A session of its own. What it says itself it does not hear, so what it hears is genuine."""

    def __init__(self, network: NetworkConfig) -> None:
        # The router may be dead for a while: a stranger waits longer than a process.
        self._bus = open_bus(msgspec.structs.replace(network, connect_timeout_s=60.0))
        self._waiting: deque[tuple[str, bytes]] = deque(maxlen=_WAITING)
        self._there = threading.Event()
        self._ear = self._bus.session.declare_subscriber(
            f"{network.namespace}/**", self._hear, allowed_origin=zenoh.Locality.REMOTE
        )

    def _hear(self, sample: Any) -> None:
        self._waiting.append((str(sample.key_expr), sample.payload.to_bytes()))
        self._there.set()

    def take(self, timeout_s: float) -> list[tuple[str, bytes]]:
        """All keys and payloads that were heard since the last time; waits for one."""
        if not self._waiting:
            self._there.clear()
            self._there.wait(timeout_s)
        taken = []
        while self._waiting:
            taken.append(self._waiting.popleft())
        return taken

    def say(self, key: str, payload: bytes) -> None:
        self._bus.session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def close(self) -> None:
        self._ear.undeclare()  # type: ignore[no-untyped-call]
        self._bus.close()
