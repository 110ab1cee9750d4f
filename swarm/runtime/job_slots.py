"""Long jobs of a machine's processes in turn: as many at once as it has processors.

Ten planners that begin together on 4096 x 4096 cells, on two processors on which others wake up all the time, take
five times the processor time: whenever one job gives way to the next, its caches are gone.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

log = logging.getLogger(__name__)

LONG_NS = 200_000_000
"""Jobs that are expected to take less do not queue."""
_LOOK_AGAIN_S = 0.02
"""Time between two looks for a free slot: a tenth of the shortest job that queues."""
_LONGEST_S = 20.0
"""Longest wait (s): the process whose turn it is may be stopped for ever. Turns make jobs quick, not right."""


class JobSlots:
    """Lock files in a folder which all processes of a run on one machine see; the holder of a lock has a turn. The
    system ends the turn of a process that dies.

    folder     None, or one that cannot be written: no process queues
    most       turns at once; the processors that this process may use if not given
    longest_s  the longest wait
    """

    def __init__(self, folder: Path | None, most: int | None = None, longest_s: float = _LONGEST_S) -> None:
        most = most or len(os.sched_getaffinity(0))
        self._paths = [] if folder is None else [folder / f"turn-{index}.lock" for index in range(most)]
        self._longest_s = longest_s

    @contextlib.contextmanager
    def one(self, expected_ns: int = LONG_NS) -> Iterator[None]:
        """Have a turn, for a job that is expected to take so long."""
        with contextlib.ExitStack() as held:
            if expected_ns >= LONG_NS:
                try:
                    self._queue(held)
                except OSError as error:
                    log.warning("cannot take turns with others on this machine: %s", error.strerror or error)
            yield

    def _queue(self, held: contextlib.ExitStack) -> None:
        until_s = time.monotonic() + self._longest_s
        while self._paths and time.monotonic() < until_s:
            for path in self._paths:
                file = path.open("ab")
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    file.close()
                else:
                    held.enter_context(file)
                    return
            time.sleep(_LOOK_AGAIN_S)
