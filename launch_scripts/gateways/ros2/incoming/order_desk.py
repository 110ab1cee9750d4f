"""Orders to the swarm, one after the other, on a thread of their own: each waits until it is obeyed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from swarm.errors import SwarmError

log = logging.getLogger(__name__)

MOST_WAITING = 8
Done = Callable[[bool, str], None]


class OrderDesk:
    """Takes work that may wait; a few pieces at a time, so that no flood of requests is remembered."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="ros2-orders")
        self._lock = threading.Lock()
        self._waiting = 0

    def give(self, what: str, work: Callable[[], str], done: Done) -> bool:
        """Do it when its turn comes, and tell what became of it: done(whether it is done, a sentence). False, and
        nothing is told, if too much waits already."""
        with self._lock:
            if self._waiting >= MOST_WAITING:
                return False
            self._waiting += 1

        def run() -> None:
            try:
                said = True, work()
            except SwarmError as error:
                said = False, str(error)
            except Exception:
                log.exception("%s failed", what)
                said = False, f"{what} failed: see the gateway's log"
            finally:
                with self._lock:
                    self._waiting -= 1
            done(*said)

        try:
            self._pool.submit(run)
        except RuntimeError:  # closed meanwhile
            with self._lock:
                self._waiting -= 1
            return False
        return True

    def close(self) -> None:
        """Take nothing more, and wait for nothing."""
        self._pool.shutdown(wait=False, cancel_futures=True)
