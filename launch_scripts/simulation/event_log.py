"""The event log of a simulation: one line per delivery and per fault.

    0.301200000 agent-a0 > planner-t3 route 5f3a9c01
    4.000000000 crash planner-t3

Seconds since the start, source, destination, topic, digest of the payload. Two runs are the same if their logs are.
"""

from __future__ import annotations

from hashlib import blake2s
from typing import TextIO

from swarm.clock import NS_PER_S


class EventLog:
    """Counts deliveries, and writes them if there is a file."""

    def __init__(self, began_ns: int, out: TextIO | None) -> None:
        self.deliveries = 0
        self._began_ns = began_ns
        self._out = out

    def delivery(self, now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
        self.deliveries += 1
        if self._out is not None:
            digest = blake2s(payload, digest_size=4).hexdigest()
            self._out.write(f"{self._seconds(now_ns)} {source} > {destination} {topic} {digest}\n")

    def event(self, now_ns: int, what: str, whom: str) -> None:
        if self._out is not None:
            self._out.write(f"{self._seconds(now_ns)} {what} {whom}\n")

    def _seconds(self, now_ns: int) -> str:
        whole, rest = divmod(now_ns - self._began_ns, NS_PER_S)
        return f"{whole}.{rest:09d}"
