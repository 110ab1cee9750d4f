"""The event log of a simulation: one line per delivery and per fault.

    0.301200000 agent-a0 > planner-t3 route 5f3a9c01
    4.000000000 crash planner-t3

Seconds since the start, source, destination, topic, digest of the payload. Two runs are the same if their logs are.
"""

from __future__ import annotations

import contextlib
from hashlib import blake2s
from typing import TextIO

from swarm.clock import NS_PER_S


class EventLog:
    """Counts deliveries, and writes them if there is a file. A full disk cuts the log, not the simulation."""

    def __init__(self, began_ns: int, out: TextIO | None) -> None:
        self.deliveries = 0
        self._began_ns = began_ns
        self._out = out
        self.cut: str | None = None
        """Why the log has no end; None if it is whole."""

    def delivery(self, now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
        self.deliveries += 1
        if self._out is not None:
            digest = blake2s(payload, digest_size=4).hexdigest()
            self._write(f"{self._seconds(now_ns)} {source} > {destination} {topic} {digest}\n")

    def event(self, now_ns: int, what: str, whom: str) -> None:
        if self._out is not None:
            self._write(f"{self._seconds(now_ns)} {what} {whom}\n")

    def flush(self) -> None:
        """Write what waits."""
        self._write("")

    def _write(self, line: str) -> None:
        if self._out is None:
            return
        try:
            self._out.write(line)
            if not line:
                self._out.flush()
        except OSError as error:
            out, self._out = self._out, None
            self.cut = error.strerror or str(error)
            with contextlib.suppress(OSError):  # with what it could not write
                out.close()

    def _seconds(self, now_ns: int) -> str:
        whole, rest = divmod(now_ns - self._began_ns, NS_PER_S)
        return f"{whole}.{rest:09d}"
