"""A stream of values from the swarm, read by `for` in a thread or by `async for` in asyncio."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    import asyncio

T = TypeVar("T")
MOST_WAITING = 1024
"""Values that wait to be read; the oldest are dropped first."""


class Stream(Generic[T]):
    """Values in the order of their arrival. One reader takes each value; a slow one misses the oldest.

    It ends when it is closed, or the connection is: loops over it end then.
    """

    def __init__(self, most: int = MOST_WAITING, on_close: Callable[[], None] = lambda: None) -> None:
        self._waiting: deque[T] = deque(maxlen=most)
        self._changed = threading.Condition()
        self._sleepers: list[tuple[asyncio.AbstractEventLoop, asyncio.Future[None]]] = []
        """Readers in asyncio that wait for a value; each is woken once."""
        self._on_close = on_close
        self.closed = False
        self.newest: T | None = None
        """The value that came last, whether it was read or not; None before the first."""

    def put(self, value: T) -> None:
        """Add a value, from any thread. Dropped once the stream is closed."""
        with self._changed:
            if not self.closed:
                self._waiting.append(value)
                self.newest = value
            self._wake()

    def close(self) -> None:
        """End it: readers take what waits, and then stop."""
        with self._changed:
            if self.closed:
                return
            self.closed = True
            self._wake()
        self._on_close()

    def next(self, timeout_s: float | None = None) -> T | None:
        """The next value; None if there is none within the timeout, or it has ended."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self.closed, timeout_s)
            return self._waiting.popleft() if self._waiting else None

    def __iter__(self) -> Iterator[T]:
        while (value := self.next()) is not None:
            yield value

    async def __aiter__(self) -> AsyncIterator[T]:
        from asyncio import get_running_loop  # whose import takes as long as all of ours

        loop = get_running_loop()
        while True:
            with self._changed:
                value = self._waiting.popleft() if self._waiting else None
                if value is None and self.closed:
                    return
                if value is None:
                    sleeper = loop.create_future()
                    self._sleepers.append((loop, sleeper))
            if value is not None:
                yield value
                continue
            try:
                await sleeper
            finally:
                with self._changed, contextlib.suppress(ValueError):
                    self._sleepers.remove((loop, sleeper))

    def _wake(self) -> None:
        self._changed.notify_all()
        for loop, sleeper in self._sleepers:
            with contextlib.suppress(RuntimeError):  # its loop was closed meanwhile
                loop.call_soon_threadsafe(_release, sleeper)
        self._sleepers.clear()


def _release(sleeper: asyncio.Future[None]) -> None:
    if not sleeper.done():
        sleeper.set_result(None)
