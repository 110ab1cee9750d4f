"""The inbox of a process: events from any thread to the one thread that owns the state."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Hashable

from swarm.bus.bus import Event, Heard, HeardMany

_UNREAD_BATCHES = 2


class Inbox:
    """Events from any thread to the one that owns the state.

    Of topics whose samples each say everything (`Topic.newest`) only the newest per key is kept, in the place of
    the oldest unread one; so a slow reader is late, but never behind by more than one value per key.
    """

    def __init__(self) -> None:
        # A lock that a poster lets go of wakes the owner in half the time that a Condition takes.
        self._lock = threading.RLock()  # re-entrant, because `wake` may interrupt its holder as a signal handler
        self._bell = threading.Lock()
        self._bell.acquire()
        self._asleep = False
        self._room = threading.Event()
        self._unread_batches = 0
        self._closed = False
        self._order: deque[Hashable] = deque()
        self._events: dict[Hashable, Event | BaseException] = {}
        self._next = 0
        self.superseded = 0

    def post(self, event: Event) -> None:
        """Leave an event. Who brings many samples waits here until the owner has kept up, so that what comes faster
        than it is read stays in the bus's own buffer, whose oldest go first."""
        if isinstance(event, HeardMany):
            with self._lock:
                self._unread_batches += 1
                self._put(event, None)
            while True:
                self._room.clear()
                if self._unread_batches <= _UNREAD_BATCHES or self._closed:
                    break
                self._room.wait()
        else:
            self._put(event, _newest_key(event))

    def fail(self, error: BaseException) -> None:
        """Make the owner raise: how a worker thread ends its process."""
        self._put(error, None)

    def _put(self, event: Event | BaseException, key: Hashable | None) -> None:
        with self._lock:
            if key is None:
                self._next += 1
                key = self._next
            elif key in self._events:
                self._events[key] = event
                self.superseded += 1
                return
            self._order.append(key)
            self._events[key] = event
            self._ring()

    def take(self, timeout_s: float) -> Event | None:
        """The oldest event; None if there is none within the timeout. Raises what `fail` was given."""
        with self._lock:
            self._asleep = not self._order and timeout_s > 0
            asleep = self._asleep
        if asleep and not self._bell.acquire(timeout=timeout_s):
            with self._lock:
                if not self._asleep:  # it rang just now
                    self._bell.acquire()
                self._asleep = False
        with self._lock:
            if not self._order:
                return None
            event = self._events.pop(self._order.popleft())
        if isinstance(event, HeardMany):
            with self._lock:
                self._unread_batches -= 1
            self._room.set()
        if isinstance(event, BaseException):
            raise event
        return event

    def wake(self) -> None:
        """Make the owner look up, from any thread and from a signal handler."""
        with self._lock:
            self._ring()

    def close(self) -> None:
        """Nobody takes any more: whoever waits for that goes on."""
        self._closed = True
        self._room.set()

    def _ring(self) -> None:
        if self._asleep:
            self._asleep = False
            self._bell.release()

    def __len__(self) -> int:
        return len(self._order)


def _newest_key(event: Event) -> Hashable | None:
    if isinstance(event, Heard) and event.topic.newest:
        return (event.topic.name, *event.fields.values())
    return None
