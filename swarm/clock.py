"""Time as an argument: whoever needs the time is handed a clock."""

from __future__ import annotations

import time
from typing import Protocol

NS_PER_S = 1_000_000_000


class Clock(Protocol):
    def now_ns(self) -> int:
        """Nanoseconds since 1970, never running backwards."""
        ...


class MonotonicClock:
    """The machine's time at the start, carried on by its monotonic counter.

    Comparable across machines as well as their clocks are set, and safe to subtract within one process.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        return self._offset_ns + time.monotonic_ns()


class ManualClock:
    """A clock that stands still until it is told to move: for tests and the simulation."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        return self._now_ns

    def advance_to(self, now_ns: int) -> None:
        if now_ns < self._now_ns:
            raise ValueError(f"time does not run backwards: {now_ns} < {self._now_ns}")
        self._now_ns = now_ns
