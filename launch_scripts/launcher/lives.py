"""Numbers of lives: which of two starts of one process came later, whatever the clock says."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import time
from pathlib import Path

from swarm.errors import StoreError

_HIGHEST = 1 << 61
_DIGITS = 20


def next_life(run_dir: Path, role: str, id: str) -> int:
    """The incarnation of a process that starts now: nanoseconds since 1970, and in any case higher than that of
    every earlier start in this run's folder. Raises StoreError if the folder cannot be written.

    So a restart is the later life although the clock was put back meanwhile.
    """
    path = run_dir / "lives" / f"{role}-{id}"
    try:
        path.parent.mkdir(exist_ok=True)
        file = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX)  # of two that start at once each gets a number of its own
            last = 0
            with contextlib.suppress(ValueError):  # cut short by a full disk
                last = min(int(os.pread(file, _DIGITS, 0) or b"0"), _HIGHEST)
            life = max(time.time_ns(), last + 1)
            # In place and always as long: so a full disk keeps nobody from a second life.
            if os.pwrite(file, b"%0*d" % (_DIGITS, life), 0) != _DIGITS:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(file)
        finally:
            os.close(file)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    return life
