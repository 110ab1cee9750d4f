"""Requests to end: of a command that runs until then, and of a launcher."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

SAME_S = 0.3
"""Signals so close together are one: wrappers and shells send a Ctrl-C on, which the terminal sends to all."""


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Tells whether SIGINT or SIGTERM has come. Both raise KeyboardInterrupt, too, so that waits end at once. But
    an exception may be lost, where the library that is just at work takes it for its own. Loops therefore poll it
    as well. Called on the main thread."""
    asked = threading.Event()

    def ask(number: int, frame: object) -> None:
        asked.set()
        raise KeyboardInterrupt

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class StopAsked:
    """Counts the signals that ask for the end. SIGINT and SIGTERM: the first ends the run in order, the second ends
    it within a second. SIGHUP (terminal closed) always ends it in order, unless `nohup` has disabled it."""

    def __init__(self) -> None:
        self.number: signal.Signals | None = None
        """The first signal; None as long as none has come."""
        self._times = 0
        """Number of SIGINT or SIGTERM, and the time of the last."""
        self._last_s = -math.inf
        self._leaves: Callable[[], bool] = lambda: False
        """True if a signal interrupts the current work."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._asked)

    def _asked(self, number: int, frame: object) -> None:
        self.number = self.number or signal.Signals(number)
        if number != signal.SIGHUP:
            now_s = time.monotonic()
            self._times += now_s - self._last_s > SAME_S
            self._last_s = now_s
        if self._leaves():
            raise KeyboardInterrupt

    def __bool__(self) -> bool:
        return self.number is not None

    def force(self) -> bool:
        """True if there was a second stop signal."""
        return self._times > 1

    @property
    def exit_code(self) -> int:
        """Exit code of a run that a signal ended, as shells have it: 128 and the signal's number."""
        return 128 + (self.number or 0)

    def interruptible(self, work: Callable[[], T], *, anew: bool = False) -> T | None:
        """The result of `work`, or None if a signal has left it, or came before: for what takes long while there is
        no process to be ended.

        anew  earlier signals do not count: only a further SIGINT or SIGTERM interrupts the work
        """
        most = max(self._times, 1)
        try:
            self._leaves = (lambda: self._times > most) if anew else self.__bool__
            return None if self._leaves() else work()
        except KeyboardInterrupt:
            return None
        finally:
            self._leaves = lambda: False
