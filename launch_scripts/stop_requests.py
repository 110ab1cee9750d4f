"""Request to end a command that runs until then."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


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
