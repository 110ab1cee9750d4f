"""The processes of a run on this machine, as the operating system shows them: name, pid, memory, threads, files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from launch_scripts.process_table import ROLES

_PROC = Path("/proc")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Usage:
    """What one process takes up."""

    rss_bytes: int
    threads: int
    files: int


_ROLES = tuple(f"{role}-" for role in ROLES)


def processes(run_dir: Path) -> dict[str, int]:
    """Name -> pid of the processes that log into a run's folder; the launcher itself is not among them."""
    found: dict[str, int] = {}
    for pid in os.listdir(_PROC):
        if not pid.isdigit():
            continue
        try:
            log = Path(os.readlink(_PROC / pid / "fd" / "1"))
        except OSError:  # ended meanwhile, or somebody else's
            continue
        if log.parent == run_dir and log.name.startswith(_ROLES) and not has_ended(int(pid)):
            found[log.name.partition(".log")[0]] = int(pid)
    return found


def has_ended(pid: int) -> bool:
    """Whether a process is gone, or dead and not yet reaped."""
    try:
        return (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


def usage(pid: int) -> Usage | None:
    """What a process takes up now; None if it has ended."""
    place = _PROC / str(pid)
    try:
        pages = int((place / "statm").read_text().split()[1])
        return Usage(pages * _PAGE_BYTES, len(os.listdir(place / "task")), len(os.listdir(place / "fd")))
    except (OSError, IndexError, ValueError):
        return None
