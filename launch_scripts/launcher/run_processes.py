"""The processes of a run on this machine, as the operating system shows them: name, pid, CPU, memory, threads,
files."""

from __future__ import annotations

import os
from collections.abc import Collection
from contextlib import suppress
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


def processes(run_dir: Path, other_than: Collection[int] = ()) -> dict[str, int]:
    """Name -> pid of the processes that log into a run's folder; the launcher itself is not among them."""
    found: dict[str, int] = {}
    for pid in map(int, filter(str.isdigit, os.listdir(_PROC))):
        try:
            log = Path(os.readlink(_PROC / str(pid) / "fd" / "1"))
        except OSError:  # ended meanwhile, or somebody else's
            continue
        named = log.parent == run_dir and log.name.startswith(_ROLES)
        if named and pid not in other_than and not has_ended(pid):
            found[log.name.partition(".log")[0]] = pid
    return found


def writing(file: Path) -> list[int]:
    """The processes of this user that may write to a file; one who only reads it is not among them."""
    if not _PROC.is_dir():
        return []
    every = [int(pid) for pid in os.listdir(_PROC) if pid.isdigit()]
    return [pid for pid in every if _writes(_PROC / str(pid), str(file)) and not has_ended(pid)]


def _writes(process: Path, file: str) -> bool:
    """Whether a process, a folder of /proc, has a file open so that it may write to it."""
    with suppress(OSError):  # ended meanwhile, or somebody else's
        for name in os.listdir(process / "fd"):
            with suppress(OSError):  # closed meanwhile
                if os.readlink(process / "fd" / name) == file:
                    lines = (process / "fdinfo" / name).read_text().splitlines()
                    flags = next((line.split()[1] for line in lines if line.startswith("flags:")), "0")
                    if int(flags, 8) & os.O_ACCMODE != os.O_RDONLY:
                        return True
    return False


def has_ended(pid: int) -> bool:
    """Whether a process is gone, or dead and not yet reaped."""
    fields = _stat(pid)
    return fields is None or fields[0] in "ZX"


def threads_of(pid: int) -> str:
    """What the threads of a process do, as the kernel says: name, state, where each waits. Empty if it is gone."""
    found = []
    with suppress(OSError):
        for thread in (_PROC / str(pid) / "task").iterdir():
            with suppress(OSError):  # ended meanwhile
                name, _, rest = (thread / "stat").read_text().partition("(")[2].rpartition(")")
                found.append(f"{name} {rest.split()[0]} {(thread / 'wchan').read_text()}")
    return ", ".join(found)


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
