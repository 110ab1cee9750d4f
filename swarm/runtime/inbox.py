"""The inbox of a process: events from any thread to the one thread that owns the state."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Hashable

from swarm.bus.bus import Event, Heard, HeardMany

_UNREAD_BATCHES = 2
"""Unread batches beyond which `post` blocks: one to be read while the next is decoded."""


class Inbox:
    """A queue of events from any thread to the one that owns the state.

    Of topics whose samples each carry the whole state of their key (`Topic.newest`) only the newest per key is
    kept, in the place of the oldest unread one: a slow reader is behind by at most one value per key. All other
    events are kept, in order. Batches (`HeardMany`) are bounded by blocking their poster.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        """Guards all below. Re-entrant, because `wake` may interrupt its holder as a signal handler."""
        self._bell = threading.Lock()
        """Held while there is nothing to wake for. `take` waits for it and a poster releases it, which wakes the
        owner in half the time that a Condition takes."""
        self._bell.acquire()
        self._asleep = False
        """Whether `take` waits for the bell; whoever sets it to false releases the bell."""
        self._batch_taken = threading.Event()
        """Set when a batch is taken, and when the inbox closes."""
        self._unread_batches = 0
        """`HeardMany` events posted and not yet taken."""
        self._closed = False
        """Set by `close`, for good."""
        self._order: deque[Hashable] = deque()
        """Keys of `_events` in the order of taking."""
        self._events: dict[Hashable, Event | BaseException] = {}
        """Unread events: by topic and fields where only the newest counts, else by number."""
        self._next = 0
        """Number of the event last posted without a key."""
        self.superseded = 0
        """Samples replaced unread by a newer one, since the start."""

    def post(self, event: Event) -> None:
        """Add an event, from any thread.

        With a `HeardMany` it blocks the caller while more than two batches are unread. The bus then drops its
        oldest samples instead of this inbox growing.
        """
        if isinstance(event, HeardMany):
            with self._lock:
                self._unread_batches += 1
                self._put(event, None)
            while True:
                self._batch_taken.clear()
                if self._unread_batches <= _UNREAD_BATCHES or self._closed:
                    break
                self._batch_taken.wait()
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
        """The oldest event; None if there is none within the timeout. Raises the error that `fail` was given, in
        its turn. Called by the owner only."""
        with self._lock:
            self._asleep = not self._order and timeout_s > 0
            asleep = self._asleep
        if asleep and not self._bell.acquire(timeout=timeout_s):
            with self._lock:
                if not self._asleep:  # a poster released the bell between the timeout and this line
                    self._bell.acquire()
                self._asleep = False
        with self._lock:
            if not self._order:
                return None
            event = self._events.pop(self._order.popleft())
        if isinstance(event, HeardMany):
            with self._lock:
                self._unread_batches -= 1
            self._batch_taken.set()
        if isinstance(event, BaseException):
            raise event
        return event

    def wake(self) -> None:
        """End a `take` that waits, from any thread and from a signal handler."""
        with self._lock:
            self._ring()

    def close(self) -> None:
        """There are no more takes: `post` does not block from now on."""
        self._closed = True
        self._batch_taken.set()

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
