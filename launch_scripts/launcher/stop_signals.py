"""The signals that ask a launcher to end, and the exit code of a run that one of them cut short."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

SAME_S = 0.3
"""Signals so close together are one: wrappers and shells send a Ctrl-C on, which the terminal sends to all."""


class StopAsked:
    """Counts the signals that ask for the end. SIGINT and SIGTERM: the first ends the run in order, the second ends
    it within a second. SIGHUP, by which a terminal says that it is closed, ends it in order however often it comes;
    it stays ignored where `nohup` has said so."""

    def __init__(self) -> None:
        self.number: signal.Signals | None = None
        """The first signal; None as long as none has come."""
        self._times = 0
        """How often the end was asked for by SIGINT or SIGTERM, and when last."""
        self._last_s = -math.inf
        self._leaves: Callable[[], bool] = lambda: False
        """Whether a signal leaves what is being done."""
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
        """Whether the end is asked for a second time."""
        return self._times > 1

    @property
    def exit_code(self) -> int:
        """Of a run that a signal cut short, as shells have it: 128 and the signal's number."""
        return 128 + (self.number or 0)

    def interruptible(self, work: Callable[[], T]) -> T | None:
        """The result of `work`, or None if a signal has left it, or came before: for what takes long while there is
        no process to be ended."""
        return self._until(work, self.__bool__)

    def interruptible_once_more(self, work: Callable[[], T]) -> T | None:
        """The same, but what has been asked before is done with: only a further SIGINT or SIGTERM leaves this work,
        and none that is the first."""
        most = max(self._times, 1)
        return self._until(work, lambda: self._times > most)

    def _until(self, work: Callable[[], T], leaves: Callable[[], bool]) -> T | None:
        try:
            self._leaves = leaves
            return None if leaves() else work()
        except KeyboardInterrupt:
            return None
        finally:
            self._leaves = lambda: False
