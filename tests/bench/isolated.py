"""Measurements in a process of their own, which prints one JSON object, and the memory that a process takes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swarm.errors import SwarmError

LONGEST_S = 600
TESTS = Path(__file__).parents[1]


def measure(module: str, *words: str, environment: dict[str, str] | None = None) -> dict[str, Any]:
    """The JSON object that `python -m module words...` prints last. Raises SwarmError, with the last line that the
    process wrote, if it fails or hangs."""
    command = [sys.executable, "-m", module, *words]
    paths = os.pathsep.join((str(TESTS.parent), str(TESTS)))
    environment = {**os.environ, "PYTHONPATH": paths, **(environment or {})}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, env=environment)
    except subprocess.TimeoutExpired as error:
        raise SwarmError(f"measuring {' '.join(words)} took more than {LONGEST_S} s") from error
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing was said"])[-1]
        raise SwarmError(f"measuring {' '.join(words)} failed with exit code {done.returncode}: {last}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


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
    # Linux: the highest mark starts again at what is resident now.
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before = _status_bytes("VmRSS")
    kept = work()
    peak = _status_bytes("VmHWM")
    del kept
    return peak - before


def _status_bytes(key: str) -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) * 1024
    raise OSError(f"no {key} in /proc/self/status")
