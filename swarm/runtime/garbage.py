"""When Python looks for cyclic garbage."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

_OBJECTS = 50_000
"""New containers until a collection. At Python's 700 a message of a few hundred vehicles sets one off by itself; a
simulation of a thousand vehicles spent an eighth of its time on them."""


@contextmanager
def collected_rarely() -> Iterator[None]:
    """Leave what exists now out of collections, and collect rarely."""
    before = gc.get_threshold()
    gc.freeze()  # terrain and kernels live to the end: a collection in the middle of a tick need not scan them
    gc.set_threshold(_OBJECTS, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()
