"""Processes of this machine, by the session that a test started them in: names would match those of others, too."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

import psutil


class Child:
    """A process under way, of which all that it says is in a file. It is killed at the end of its context.

    options  of Popen
    """

    def __init__(self, output: Path, *command: object, **options: Any) -> None:
        self.output = output
        with output.open("w") as file:
            self.process = subprocess.Popen(list(map(str, command)), stdout=file, stderr=file, **options)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def text(self) -> str:
        """All that it has said until now."""
        return self.output.read_text()

    def wait_for(self, pattern: str, within_s: float = 60.0) -> None:
        found = re.compile(pattern, re.MULTILINE)
        eventually(lambda: found.search(self.text), within_s, f"{pattern!r} in {self.output}")

    def kill(self) -> None:
        """Kills it, and whatever is in a session of its own."""
        for pid in in_session(self.process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.kill()
        self.process.wait(10)


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


class Usage(NamedTuple):
    """Resource use of one process."""

    rss_bytes: int
    threads: int
    files: int


def usage(pid: int) -> Usage | None:
    """Current resource use of a process; None if it has ended."""
    try:
        process = psutil.Process(pid)
        return Usage(process.memory_info().rss, process.num_threads(), process.num_fds())
    except psutil.Error:
        return None


def in_session(session: int) -> list[int]:
    """The living processes of a session, such as a launcher's with all that it started."""
    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
        except (psutil.Error, OSError):  # ended meanwhile
            continue
    return found


def cpu_s(pid: int) -> float | None:
    """Seconds of CPU that a process has used, its own and the system's; None if it has ended."""
    try:
        times = psutil.Process(pid).cpu_times()
    except psutil.Error:
        return None
    return float(times.user + times.system)


def machine_cpu_s() -> float:
    """Seconds of CPU that all processes of the machine have used, and that its host took."""
    times = psutil.cpu_times()
    return float(sum(times) - times.idle - times.iowait - times.guest - times.guest_nice)


def pss_bytes(pid: int) -> int | None:
    """Memory of a process, of which shared pages count for their share; None if it has ended or may not be seen."""
    try:
        return int(psutil.Process(pid).memory_full_info().pss)
    except psutil.Error:
        return None
