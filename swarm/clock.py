"""Time as an argument: code that needs the time is given a clock, so that a simulation can decide it."""

from __future__ import annotations

import time
from typing import Protocol

NS_PER_S = 1_000_000_000
"""Nanoseconds of a second."""
_APART_NS, _TRIES = 100_000, 1000
"""Two readings that are further apart are taken again: the process was stopped between them."""


class Clock(Protocol):
    """Source of time."""

    def now_ns(self) -> int:
        """Nanoseconds since 1970, never running backwards."""
        ...


_LATEST_NS = 4_000_000_000 * NS_PER_S
"""A clock beyond the year 2096 is wrong. Times in messages stay below 2^62, which is 19 years later."""


def date_ns() -> int:
    """Nanoseconds since 1970 by the machine's clock, in any case a time that a message can carry."""
    return min(max(time.time_ns(), 0), _LATEST_NS)


class MonotonicClock:
    """The machine's time at the start of the process, continued by its monotonic counter.

    Two readings in one process may be subtracted. Readings of two machines differ as their clocks did at the start.
    The offset is wrong by at most `_APART_NS`, even if the process is stopped while it reads the two counters.
    """

    def __init__(self) -> None:
        for _ in range(_TRIES):
            before_ns, now_ns, after_ns = time.monotonic_ns(), date_ns(), time.monotonic_ns()
            self._offset_ns = now_ns - after_ns
            if after_ns - before_ns <= _APART_NS:
                break

    def now_ns(self) -> int:
        return self._offset_ns + time.monotonic_ns()


class ManualClock:
    """A clock that only `advance_to` moves: for tests and simulations."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        return self._now_ns

    def advance_to(self, now_ns: int) -> None:
        """Sets the time. Raises ValueError on a time before the present one."""
        if now_ns < self._now_ns:
            raise ValueError(f"time does not run backwards: {now_ns} < {self._now_ns}")
        self._now_ns = now_ns
