"""First use of a module or kernel in the loop of a process, where all others wait for it: counted, logged, in tests
an error.

Modules and kernels that a role can ever need are loaded before its loop or beside it, on another thread.
"""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.machinery import ModuleSpec

from swarm.runtime.stats import FIRST_USES, Counters

log = logging.getLogger(__name__)

refused = False
"""True in tests: a first use in a loop is an error."""
_this = threading.local()
"""`counters` of the service whose loop this thread runs; None in a simulation. Unset on other threads."""


class FirstUseError(AssertionError):
    """The loop of a process loads something."""


@contextmanager
def in_loop(counters: Counters | None) -> Iterator[None]:
    """Marks this thread as the loop of a process.

    counters  of its service; None in a simulation, whose counts must not depend on what is loaded already
    """
    if _watch not in sys.meta_path:
        sys.meta_path.insert(0, _watch)  # asked about each module that is not loaded
    _this.counters = counters
    try:
        yield
    finally:
        del _this.counters


class Modules:
    """Modules that a role may need, loaded on a thread beside its loop, once it asks for them."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._thread: threading.Thread | None = None

    def there(self) -> bool:
        """Returns True if they are loaded; the first call begins that."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._load, name="load-modules", daemon=True)
            self._thread.start()
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Waits for them: before the loop, or in a simulation. Raises what a module raises."""
        if not self.there() and self._thread is not None:
            self._thread.join()
        self._load()

    def _load(self) -> None:
        for name in self._names:
            import_module(name)


def note(what: str) -> None:
    """Records that the calling thread loads something now."""
    if not hasattr(_this, "counters"):
        return
    if refused:
        raise FirstUseError(f"{what} is loaded in the loop of a process")
    if _this.counters is not None:
        _this.counters.count(FIRST_USES)
        log.warning("%s is loaded in the loop of this process, which waits for it", what)


class _Watch:
    """A finder of modules that finds none."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        note(f"module {name}")
        return None


_watch = _Watch()
