"""Breaks off a call that does not come back."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import TypeVar

T = TypeVar("T")


class Hangs(BaseException):
    """A call has taken longer than it may. No `Exception`, so that code which catches those does not swallow it."""


def call_within(seconds: float, call: Callable[[], T]) -> T:
    """What `call` returns. Raises `Hangs` in it once so many seconds have passed, and again as often.

    An alarm of the operating system ends loops, sleeps and waits alike. Native code that never comes back to the
    interpreter cannot be ended so. On another thread than the main one there is no alarm.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    before = signal.signal(signal.SIGALRM, _ring)
    began_s = time.monotonic()
    left_s, every_s = signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
    try:
        try:
            return call()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    finally:
        # Again: the alarm may have rung after the call, before it was put off.
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        if left_s:  # somebody else's alarm, such as a test's
            signal.setitimer(signal.ITIMER_REAL, max(left_s - (time.monotonic() - began_s), 1e-3), every_s)


def _ring(signum: int, frame: FrameType | None) -> None:
    raise Hangs
