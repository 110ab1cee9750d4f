"""Says when the run's folder takes no more data, and when it does again."""

from __future__ import annotations

import contextlib
from pathlib import Path

LOOK_EVERY_S = 5.0
SAY_EVERY_S = 60.0
_PROBE_BYTES = 1 << 16


class DiskWatch:
    """Tries now and then to write to a folder: the processes that write there cannot say so in their logs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._due_s = 0.0
        self._said_s: float | None = None
        """When it was last said that there is no space; None while there is."""

    def look(self, now_s: float) -> str | None:
        """A sentence for the user; None if there is nothing new to say. Call it often."""
        if now_s < self._due_s:
            return None
        self._due_s = now_s + LOOK_EVERY_S
        try:
            can_write(self._folder)
        except OSError as error:
            if self._said_s is not None and now_s - self._said_s < SAY_EVERY_S:
                return None
            self._said_s = now_s
            return f"cannot write to {self._folder}: {error.strerror or error}; all goes on but logs and recording"
        if self._said_s is None:
            return None
        self._said_s = None
        return f"{self._folder} can be written again"


def can_write(folder: Path, size: int = _PROBE_BYTES) -> None:
    """Write a file of some bytes and remove it. Raises OSError."""
    probe = folder / ".space"
    try:
        probe.write_bytes(bytes(size))
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
