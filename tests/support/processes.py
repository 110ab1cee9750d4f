"""Live processes, by the session that a test started them in: names would match those of others, too."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable

import psutil
from support.process_usage import in_session


def session_of(leader: int) -> list[str]:
    """Command lines of the living processes of a session."""
    lines = []
    for pid in in_session(leader):
        with contextlib.suppress(psutil.Error):  # ended while we looked
            lines.append(" ".join(psutil.Process(pid).cmdline()))
    return lines


def words_of_python(code: str, *within: str, **environment: str) -> list[str]:
    """Runs code in a fresh Python, started by the command `within`; it must end well. Returns what it prints, by
    words."""
    command = [*within, sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.split()


def eventually(
    condition: Callable[[], object], within_s: float, what: str = "the condition", every_s: float = 0.05
) -> None:
    """Poll until the condition holds, at most so long.

    The bound is for a machine which has a core for each process that computes. Where more of them wait for a core,
    it grows with their number: a busy machine is slow, which is no fault of what is tested.
    """
    began_s = time.monotonic()
    while not condition():
        waited_s, a_core = time.monotonic() - began_s, os.getloadavg()[0] / (os.cpu_count() or 1)
        assert waited_s < within_s * max(1.0, a_core), f"{what} did not come true within {waited_s:.0f} s"
        time.sleep(every_s)
