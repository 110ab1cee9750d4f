"""Resource use of processes of this machine, for benchmarks and tries of robustness."""

from __future__ import annotations

import os
from typing import NamedTuple

import psutil


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
