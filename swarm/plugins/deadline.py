"""Breaks off a call that does not come back."""

from __future__ import annotations

import faulthandler
import functools
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import TypeVar

T = TypeVar("T")

KILLED_BY = signal.SIGVTALRM
"""Signal that ends a process whose call cannot be interrupted."""
_KILL_FACTOR = 5
"""A call that exceeds its limit by this factor, or swallows this number of alarms, ends its process."""


class Hangs(BaseException):
    """A call has taken longer than it may. No `Exception`, so that code which catches those does not swallow it."""


def call_within(seconds: float, call: Callable[[], T]) -> T:
    """Returns the result of `call`. Raises `Hangs` in it after this time (s), and again at the same interval.

    An alarm of the operating system ends loops, sleeps and waits alike. It does not reach native code that never
    comes back to the interpreter, nor end a call that swallows it, as a bare `except` does. Once the first has used
    five times as much processor time, or the other has swallowed it five times, the process is killed, and the line
    that it hangs in is on its standard error. On another thread than the main one there is neither.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    _tell_line()
    before = signal.signal(signal.SIGALRM, _Alarm().ring)
    began_s = time.monotonic()
    left_s, every_s = signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
    signal.setitimer(signal.ITIMER_VIRTUAL, _KILL_FACTOR * seconds)
    try:
        try:
            return call()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    finally:
        # Again: the alarm may have come after the call, before it was put off.
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGALRM, before)
        if left_s:  # an alarm of another user, such as a test's
            signal.setitimer(signal.ITIMER_REAL, max(left_s - (time.monotonic() - began_s), 1e-3), every_s)


class _Alarm:
    """Rings for one call."""

    def __init__(self) -> None:
        self._rung = 0

    def ring(self, signum: int, frame: FrameType | None) -> None:
        self._rung += 1
        if self._rung >= _KILL_FACTOR:
            signal.raise_signal(KILLED_BY)
        raise Hangs


@functools.cache
def _tell_line() -> None:
    # Written by the signal's handler itself, which needs no interpreter; then the signal kills.
    faulthandler.register(KILLED_BY, file=2, all_threads=False, chain=True)
