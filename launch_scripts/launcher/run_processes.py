"""The processes of a run on this machine, as the operating system shows them: name, pid, CPU, memory, threads,
files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from launch_scripts.process_table import ROLES

_PROC = Path("/proc")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


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


def holding(file: Path) -> list[int]:
    """The processes of this user that have a file open."""
    found: list[int] = []
    if not _PROC.is_dir():
        return found
    for pid in filter(str.isdigit, os.listdir(_PROC)):
        try:
            opened = [os.readlink(entry.path) for entry in os.scandir(_PROC / pid / "fd")]
        except OSError:  # ended meanwhile, or somebody else's
            continue
        if str(file) in opened and not has_ended(int(pid)):
            found.append(int(pid))
    return found


def has_ended(pid: int) -> bool:
    """Whether a process is gone, or dead and not yet reaped."""
    fields = _stat(pid)
    return fields is None or fields[0] in "ZX"


def usage(pid: int) -> Usage | None:
    """What a process takes up now; None if it has ended."""
    place = _PROC / str(pid)
    try:
        pages = int((place / "statm").read_text().split()[1])
        return Usage(pages * _PAGE_BYTES, len(os.listdir(place / "task")), len(os.listdir(place / "fd")))
    except (OSError, IndexError, ValueError):
        return None


def in_session(session: int) -> list[int]:
    """The processes of a session, such as a launcher's with all that it started; none where there is no /proc."""
    found: list[int] = []
    if not _PROC.is_dir():
        return found
    for pid in filter(str.isdigit, os.listdir(_PROC)):
        fields = _stat(int(pid))
        if fields is not None and int(fields[3]) == session and fields[0] not in "ZX":
            found.append(int(pid))
    return found


def cpu_s(pid: int) -> float | None:
    """Seconds of CPU that a process has used, its own and the system's; None if it has ended."""
    fields = _stat(pid)
    return None if fields is None else (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def machine_cpu_s() -> float | None:
    """Seconds of CPU that all processes of the machine have used, and that its host took; None if not told."""
    try:
        fields = (_PROC / "stat").read_text(encoding="ascii").partition("\n")[0].split()[1:]
        user, nice, system, _, _, *interrupts_and_stolen = map(int, fields[:8])
    except (OSError, ValueError):
        return None
    return (user + nice + system + sum(interrupts_and_stolen)) / _TICKS_PER_S


def pss_bytes(pid: int) -> int | None:
    """Memory of a process, of which shared pages count for their share; None if it has ended or may not be seen."""
    try:
        for line in (_PROC / str(pid) / "smaps_rollup").read_text(encoding="ascii").splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return None


def _stat(pid: int) -> list[str] | None:
    """The fields of /proc/PID/stat from the state on; None if the process has ended."""
    try:
        return (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
