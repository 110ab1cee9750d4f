"""Runs a command, and ends whatever it leaves behind: `python contained.py COMMAND...`. It has the command's code.

Live tests start launchers in sessions of their own, which a Ctrl-C does not reach, and pytest's workers are ended
before their fixtures clean up. Orphans become children of this process, which asks them to stop and then ends them.
"""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys

import psutil

_SET_CHILD_SUBREAPER = 36
"""PR_SET_CHILD_SUBREAPER of <linux/prctl.h>."""
GRACE_S = 10.0
"""A launcher stops its processes within a few seconds."""


def run_contained(command: list[str]) -> int:
    """Returns the exit code of the command, once no process that it started is left."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    with subprocess.Popen(command) as process:
        # A Ctrl-C reaches the command, too, which decides what to do; other signals are passed on as one.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: process.send_signal(signal.SIGINT))
        code = process.wait()
    left = psutil.Process().children(recursive=True)
    for each in left:
        each.terminate()
    _, stubborn = psutil.wait_procs(left, GRACE_S)
    for each in [*stubborn, *psutil.Process().children(recursive=True)]:
        each.kill()
    return code


if __name__ == "__main__":
    sys.exit(run_contained(sys.argv[1:]))
