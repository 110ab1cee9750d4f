"""The two means by which no flood from ROS is remembered: the newest message of a topic, and a bounded queue."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from launch_scripts.gateways.ros2.rmw import Qos
from launch_scripts.gateways.ros2.ros_node import Node
from swarm.clock import NS_PER_S
from swarm.errors import SwarmError

log = logging.getLogger(__name__)

_MOST_BYTES = 1 << 14
"""A pose, a goal or a polygon of 256 corners is smaller."""
Failed = Callable[[str], None]


class WorkQueue:
    """Does work that may wait, on threads of its own.

    most  the pieces that may wait, or are at work
    """

    def __init__(self, name: str, threads: int, most: int) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix=name)
        self._room = threading.Semaphore(most)

    def give(self, what: str, work: Callable[[], None], failed: Failed) -> bool:
        """Does it when its turn comes; `failed` is called with a sentence if it raises, or the queue is closed.
        Returns False, and does nothing, if too much waits already."""
        if not self._room.acquire(blocking=False):
            return False

        def end(done: Future[None]) -> None:
            self._room.release()
            if done.cancelled():
                failed("the gateway ends")
            elif isinstance(error := done.exception(), SwarmError):
                failed(str(error))
            elif error is not None:
                log.error("%s failed", what, exc_info=error)
                failed(f"{what} failed: see the gateway's log")

        try:
            self._pool.submit(work).add_done_callback(end)
        except RuntimeError:  # it is closed
            failed("the gateway ends")
        return True

    def close(self) -> None:
        """Takes nothing more, and waits for nothing."""
        self._pool.shutdown(wait=False, cancel_futures=True)


class Input:
    """The newest message of a topic, taken at ticks and at most at this interval.

    take   is called with it, and the time by time.monotonic_ns. Raises SwarmError on a refused message
    queue  `take` may wait, and is called by its thread; None: it is called by `tick`
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        type_name: str,
        hz: float,
        take: Callable[[Any, int], None],
        *,
        qos: Qos = Qos.DEFAULT,
        most_bytes: int = _MOST_BYTES,
        queue: WorkQueue | None = None,
    ) -> None:
        self.topic = topic
        self.newest = node.newest(topic, type_name, qos, most_bytes)
        self.refused = 0
        self._take, self._queue = take, queue
        self._period_ns = int(NS_PER_S / hz)
        self._due_ns = 0
        self._held: Any = None
        """Message for which the queue had no room."""
        self._said: str | None = None

    def tick(self, now_ns: int) -> None:
        """Processes received messages, if that is due."""
        if now_ns < self._due_ns:
            return
        message = self.newest.take() or self._held
        if message is None:
            return
        self._due_ns, self._held = now_ns + self._period_ns, None
        if self._queue is not None:
            work = f"a message of {self.topic}", lambda: self._try(message, now_ns), self.refuse
            self._held = None if self._queue.give(*work) else message
            return
        try:
            self._try(message, now_ns)
        except SwarmError as error:
            self.refuse(str(error))

    def refuse(self, sentence: str) -> None:
        """Says why a message is refused; what begins in the same way is said once, until one is not refused."""
        self.refused += 1
        kind = sentence.partition(" is ")[0]
        if kind != self._said:
            self._said = kind
            log.warning("topic %s: %s", self.topic, sentence)

    def close(self) -> None:
        self.newest.close()

    def _try(self, message: Any, now_ns: int) -> None:
        self._take(message, now_ns)
        self._said = None
