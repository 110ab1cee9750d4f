"""The guard through which a plug-in is called: whatever it does there, its caller gets a checked value.

One that raises, hangs or returns what breaks its contract is out for the rest of the process's life: its fault is
said once, with its name, its kind and the place, and its caller does what `PluginKind.failing` says.
"""

from __future__ import annotations

import faulthandler
import functools
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TypeVar

from swarm.errors import SwarmError

if TYPE_CHECKING:
    from swarm.plugins.find import Plugin


T = TypeVar("T")
Tell = Callable[[str], None]
"""Takes a fault in one sentence."""


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


def error_text(error: BaseException) -> str:
    """An error of a plug-in in words, with the line that raised it."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = ""
    if trace is not None:
        where = f" ({Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno})"
    text = " ".join(str(error).split())
    return f"{type(error).__name__}{f': {text}' if text else ''}"[:200] + where


class Nonsense(SwarmError):  # noqa: N818
    """A result of a plug-in breaks its contract: the value found, and the value expected."""


class Guard:
    """The single place where one plug-in is called.

    tell   takes its fault
    works  false once it has failed: then it is not called any more
    """

    def __init__(self, plugin: Plugin, tell: Tell) -> None:
        self.works = True
        self._plugin = plugin
        self._tell = tell

    def ask(self, call: Callable[[], object], check: Callable[[object], T], otherwise: Callable[[], T]) -> T:
        """Returns the result of `call` after `check`, or of `otherwise` if the plug-in fails or has failed.

        check  raises `Nonsense` on what breaks the contract; what else it raises counts as the plug-in's fault, too
        """
        if not self.works:
            return otherwise()
        kind = self._plugin.named.kind
        try:
            return check(call_within(kind.call_s, call))
        except Nonsense as nonsense:
            self._fail(f"returned {nonsense}")
        except Hangs:
            self._fail(f"took more than {kind.call_s:g} s")
        except (Exception, SystemExit) as error:
            self._fail(f"raised {error_text(error)}")
        return otherwise()

    def _fail(self, what: str) -> None:
        self.works = False
        kind = self._plugin.named.kind
        self._tell(f"{self._plugin} of {self._plugin.named.key}: {kind.method} {what}; {kind.failing}")
