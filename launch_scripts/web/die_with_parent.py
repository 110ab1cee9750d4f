"""Replaces itself by another program, which ends when its parent ends, for whatever reason.

It runs as a script and imports nothing of ours.

    python die_with_parent.py PARENT_PID PROGRAM ARGUMENT...
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    parent, program = int(sys.argv[1]), sys.argv[2:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before it could be watched
            sys.exit(0)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    os.execv(program[0], program)


if __name__ == "__main__":
    main()
