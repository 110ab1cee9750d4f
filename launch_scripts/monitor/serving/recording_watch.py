"""Notices that a recording has ended for want of space, says so, and begins another when there is some."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

from launch_scripts.monitor.serving.sinks import new_recording_path
from launch_scripts.observe.run_folder import SAY_EVERY_S, can_write
from swarm.clock import NS_PER_S
from swarm.errors import StoreError

STILL_LOOKS = 5
"""Looks in a row, one a second, that find the file as long as before: something is drawn every second."""
RETRY_S = 10.0
SPACE_BYTES = 8 << 20
"""Space from which on a new recording is begun."""


class RecordingWatch:
    """Watches the file of a recording. Rerun's file sink ends at the first error, with a line in its own log only.

    begin  lets what is drawn from now on go to this file as well; raises StoreError where it cannot
    """

    def __init__(self, path: Path, begin: Callable[[Path], None]) -> None:
        self._path = path
        self._begin = begin
        self._size = -1
        self._still = 0
        """Looks that found this size, without a break."""
        self._ended_ns: int | None = None
        """When it was last said that the recording has ended; None while it goes on."""
        self._retry_ns = 0
        self._due_ns = 0

    def look(self, now_ns: int) -> tuple[str | None, bool]:
        """What is to be told, if anything, and whether a new file has begun, in which nothing is drawn yet."""
        if now_ns < self._due_ns:
            return None, False
        self._due_ns = now_ns + NS_PER_S
        if self._ended_ns is None:
            return (self._tell(now_ns), False) if self._has_ended() else (None, False)
        if now_ns >= self._retry_ns:
            self._retry_ns = now_ns + int(RETRY_S * NS_PER_S)
            try:
                check_space(self._path.parent)
                self._path = new_recording_path(self._path.parent)
                self._begin(self._path)
            except (OSError, StoreError):
                pass
            else:
                self._size, self._still, self._ended_ns = -1, 0, None
                return f"the recording goes on in {self._path}", True
        if now_ns - self._ended_ns >= SAY_EVERY_S * NS_PER_S:
            return self._tell(now_ns), False
        return None, False

    def _has_ended(self) -> bool:
        try:
            size = self._path.stat().st_size
        except OSError:
            size = self._size
        self._still = self._still + 1 if size == self._size else 0
        self._size = size
        return self._still >= STILL_LOOKS

    def _tell(self, now_ns: int) -> str:
        self._ended_ns = now_ns
        why = "it does not grow"
        try:
            check_space(self._path.parent)
        except OSError as error:
            why = error.strerror or str(error)
        return f"the recording {self._path} has ended: {why}; another begins when there is space"


def check_space(folder: Path) -> None:
    """Raises OSError if there is no space for a recording. It is tried by writing, as there are quotas and limits
    that nothing else shows; but only where that does not fill the disk for everybody else meanwhile."""
    left = os.statvfs(folder)
    if left.f_bavail * left.f_frsize < 2 * SPACE_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    can_write(folder, SPACE_BYTES)
