"""The processes of a run on this machine, as the operating system shows them: name, pid, memory, threads, files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

_PROC = Path("/proc")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Usage:
    """What one process takes up."""

    rss_bytes: int
    threads: int
    files: int


def processes(run_dir: Path) -> dict[str, int]:
    """Name -> pid of the processes that log into a run's folder; the launcher itself is not among them."""
    found: dict[str, int] = {}
    for pid in _pids():
        try:
            log = os.readlink(_PROC / str(pid) / "fd" / "1")
            state = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:  # ended meanwhile, or somebody else's
            continue
        path = Path(log)
        if path.parent == run_dir and path.name.startswith(_ROLES) and state != "Z":
            found[path.name.partition(".log")[0]] = pid
    return found


_ROLES = ("router-", "keeper-", "monitor-", "planner-", "targets-", "agent-")


def _pids() -> list[int]:
    return [int(each) for each in os.listdir(_PROC) if each.isdigit()]


def usage(pid: int) -> Usage | None:
    """What a process takes up now; None if it has ended."""
    place = _PROC / str(pid)
    try:
        pages = int((place / "statm").read_text().split()[1])
        return Usage(pages * _PAGE_BYTES, len(os.listdir(place / "task")), len(os.listdir(place / "fd")))
    except (OSError, IndexError, ValueError):
        return None
