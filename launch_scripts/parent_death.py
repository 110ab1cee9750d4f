"""Ends a process with the one that started it, even where that is killed.

As a script it replaces itself by another program, and imports no module of ours:

    python parent_death.py PARENT_PID PROGRAM ARGUMENT...
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
"""The number of this request in Linux's <sys/prctl.h>."""
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


def end_with_parent(number: signal.Signals) -> None:
    """Makes the kernel send this signal to the present process when its parent ends. Does nothing but on Linux."""
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, int(number))
    parent = multiprocessing.parent_process()
    if parent is not None and not parent.is_alive():  # it ended before the kernel knew
        os.kill(os.getpid(), number)


def main() -> None:
    """Becomes the program that the arguments name, which ends when process PARENT_PID does."""
    parent, program = int(sys.argv[1]), sys.argv[2:]
    end_with_parent(signal.SIGKILL)
    if _LIBC is not None and os.getppid() != parent:  # it ended before it could be watched
        sys.exit(0)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    os.execv(program[0], program)


if __name__ == "__main__":
    main()
