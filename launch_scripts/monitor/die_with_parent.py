"""Become another program, one that ends with its parent, however that ends. Run as a script, alone: nothing of
ours is imported.

    python tied.py PARENT_PID PROGRAM ARGUMENT...
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
