"""Work in a process of its own: nothing else takes its time, and its memory is its own.

    python -m bench.isolated MODULE:FUNCTION ARGUMENTS      a JSON list of arguments; prints the result as JSON

Nothing is imported here but what the interpreter has loaded anyway, so that a peak of memory is that of the work.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

LONGEST_S = 600
TESTS = Path(__file__).parents[1]


def isolated(work: Callable[..., Any], *arguments: Any, environment: dict[str, str] | None = None) -> Any:
    """Returns the result of a function that runs in its own process. Arguments and result are such as JSON has.
    Raises SwarmError, with the last line that the process wrote, if it fails or hangs."""
    from swarm.errors import SwarmError

    name = f"{work.__module__}:{work.__name__}"
    command = [sys.executable, "-m", "bench.isolated", name, json.dumps(arguments)]
    paths = os.pathsep.join((str(TESTS.parent), str(TESTS)))
    environment = {**os.environ, "PYTHONPATH": paths, **(environment or {})}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, env=environment)
    except subprocess.TimeoutExpired as error:
        raise SwarmError(f"{name} took more than {LONGEST_S} s") from error
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing was said"])[-1]
        raise SwarmError(f"{name} failed with exit code {done.returncode}: {last}")
    return json.loads(done.stdout.splitlines()[-1])


class TimeLimit:
    """Seconds of CPU that this process may use from now on. By the clock it gets four times as long, for a machine
    which is shared."""

    def __init__(self, cpu_s: float) -> None:
        self._until_cpu_s = time.process_time() + cpu_s
        self._until_s = time.monotonic() + 4 * cpu_s

    @property
    def is_up(self) -> bool:
        return time.process_time() >= self._until_cpu_s or time.monotonic() >= self._until_s


def peak_bytes(work: Callable[[], object]) -> int:
    """By how much the resident memory of this process rises at most. Raises OSError where it is not known."""
    with suppress(OSError, AttributeError):  # only glibc has it: freed memory shall not be reused
        ctypes.CDLL(None).malloc_trim(0)
    # The kernel alone keeps the highest mark, and psutil does not read it. It starts again at the memory that is
    # resident now.
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before = status_bytes("VmRSS")
    kept = work()
    peak = status_bytes("VmHWM")
    del kept
    return peak - before


def status_bytes(key: str) -> int:
    """A size that Linux tells of this process; VmHWM is the highest resident one. It is not `ru_maxrss`, which
    starts at what the parent held at the fork. Raises OSError where it is not known."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) * 1024
    raise OSError(f"no {key} in /proc/self/status")


if __name__ == "__main__":
    module, function = sys.argv[1].split(":")
    print(json.dumps(getattr(import_module(module), function)(*json.loads(sys.argv[2]))))
