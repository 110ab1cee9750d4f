"""What Zenoh hands over: threads of its own and those that read its channels, timeouts, attachments, encodings."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

from swarm.bus.bus import LONGEST_TIMEOUT_S, TIMEOUT_PARAMETER, USUAL_TIMEOUT_S
from swarm.errors import ProtocolError
from swarm.wire.codec import JSON_ENCODING, may_be_json

MOST_TOGETHER = 1024
"""Most samples in one `HeardMany`, so that a tick does not wait for long."""


class Arrivals:
    """What comes in on one entity, in its order.

    `recv` of a channel of Zenoh's wakes its thread ten times a second, to look for signals, and asks for the
    interpreter's lock each time (decision 95). A thread that waits here sleeps until something comes.
    Zenoh's own thread needs the interpreter's lock to leave an item here, so this is for what comes seldom: a flood
    of samples belongs into a channel.

    most  items that wait; those that come then are dropped
    """

    def __init__(self, most: int) -> None:
        self._items: SimpleQueue[Any] = SimpleQueue()
        """What has come; None ends it."""
        self._most = most

    def put(self, item: Any) -> None:
        if self._items.qsize() < self._most:
            self._items.put(item)

    def end(self) -> None:
        """The entity is undeclared."""
        self._items.put(None)

    def take(self) -> Any:
        """The next item, once there is one; None after the last."""
        return self._items.get()


def waiting_in(channel: Any) -> list[Any]:
    """All items that wait in a channel; blocks until there is one.

    `try_recv` keeps the interpreter's lock, `recv` releases it: taking it back for each item costs hundreds of
    times more while another thread is busy.
    """
    return [channel.recv(), *taken_from(channel, MOST_TOGETHER - 1)]


def taken_from(channel: Any, most: int) -> list[Any]:
    """The items that wait in a channel, at most so many; none if none does."""
    items: list[Any] = []
    while len(items) < most and (item := channel.try_recv()) is not None:
        items.append(item)
    return items


def taken_after(channel: Any, closing: threading.Event, wait_s: float) -> list[Any]:
    """The items in a channel, `wait_s` after the first that came; none once it is closing."""
    first = channel.recv()
    return [] if closing.wait(wait_s) else [first, *taken_from(channel, MOST_TOGETHER)]


_own = threading.local()
"""`kept` is set where the state of a thread of Zenoh's is kept: in that state, so that it ends with it."""


def _keep_state() -> None:
    """Keep what the interpreter knows of this thread of Zenoh's until the interpreter ends.

    Python makes a state when such a thread calls it and clears it away when the call is over, with the memory of
    its frames, which takes longer than most calls (decision 99). A state counts who needs it, and this is one more.
    Zenoh's threads are few and live as long as the process.
    """
    if not hasattr(_own, "kept"):
        _own.kept = True
        ctypes.pythonapi.PyGILState_Ensure()


def guarded(callback: Callable[..., None]) -> Callable[..., None]:
    """A callback for Zenoh's own threads, which swallow an error: it ends like one of a thread of ours."""

    def guard(*arguments: Any) -> None:
        _keep_state()
        try:
            callback(*arguments)
        except Exception as error:
            what = (type(error), error, error.__traceback__, threading.current_thread())
            threading.excepthook(threading.ExceptHookArgs(what))

    return guard


def attached(carrier: Any) -> bytes | None:
    """What was sent beside the payload of a sample or a query."""
    attachment: bytes | None = None if carrier.attachment is None else carrier.attachment.to_bytes()
    return attachment


def says_json(carrier: Any, payload: bytes) -> bool:
    """Whether a sample or query carries JSON, by its encoding: that costs more to look up than the first byte."""
    return may_be_json(payload) and str(carrier.encoding).partition(";")[0] == JSON_ENCODING


def timeout_of(said: str) -> float:
    """The timeout that a query states, within bounds. Raises ProtocolError on what is no positive number."""
    if not said:
        return USUAL_TIMEOUT_S
    try:
        timeout_s = float(said)
    except ValueError:
        timeout_s = 0.0
    if not timeout_s > 0:  # neither is NaN
        raise ProtocolError(f"{TIMEOUT_PARAMETER} {said[:40]!r} is not a positive number of seconds")
    return min(timeout_s, LONGEST_TIMEOUT_S)
