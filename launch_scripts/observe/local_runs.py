"""The registry of this user's runs, by which commands find a run from any folder.

Each launcher writes one small file, which names the folder of its run and the launcher's process. A file outlives
its launcher: it goes when the folder of the run does.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import psutil

from swarm.config.input_files import FileKind, read_text
from swarm.errors import StoreError, SwarmError
from swarm.files import make_folder, write_file
from swarm.runtime.run_secret import state_folder

LAUNCHER_LOG = "launcher.log"
_SAME_START_S = 0.005
"""Starts of processes are known to a hundredth of a second."""


class _Entry(msgspec.Struct, frozen=True, kw_only=True):
    """File of one launcher.

    started_s  when it started, in seconds since the machine did: a clock that is set changes nothing
    """

    folder: str
    pid: Annotated[int, msgspec.Meta(ge=2, lt=1 << 31)]
    started_s: float
    web_port: Annotated[int, msgspec.Meta(ge=0, lt=1 << 16)] = 0
    is_whole: bool = False


@dataclass(frozen=True)
class KnownRun:
    """A run of this user.

    launchers  pids of its launchers that run on this machine, the newest first
    web_port   of the live page; 0 as long as it has none
    is_whole   the swarm has been whole
    """

    folder: Path
    launchers: tuple[int, ...]
    web_port: int
    is_whole: bool

    @property
    def name(self) -> str:
        return self.folder.name

    def processes(self) -> dict[str, int]:
        """Name -> pid of the processes of this run that are there now, also if its launchers have ended."""
        return {name: pid for name, pid in logging_into(self.folder).items() if is_of_a_swarm(pid)}

    @property
    def is_stopped(self) -> bool:
        """Returns True if a launcher is stopped, as by Ctrl-Z or SIGSTOP."""
        with suppress(psutil.Error):
            return any(psutil.Process(pid).status() == psutil.STATUS_STOPPED for pid in self.launchers)
        return False


def registry() -> Path:
    """The folder of the registry. Raises RuntimeError without a home folder."""
    return Path(os.environ.get("SWARM_STATE") or state_folder()) / "runs"


def register(folder: Path, *, web_port: int = 0, is_whole: bool = False) -> str | None:
    """Registers this process as a launcher of the run in a folder, or changes its entry. Returns a sentence if that
    is impossible."""
    try:
        entry = _Entry(
            folder=str(folder.resolve()),
            pid=os.getpid(),
            started_s=_started_s(os.getpid()),
            web_port=web_port,
            is_whole=is_whole,
        )
        file = registry() / f"{folder.name}.{os.getpid()}.json"
        make_folder(file.parent)
        write_file(file, msgspec.json.encode(entry))
    except (OSError, RuntimeError, ValueError, StoreError) as error:  # ValueError: a name that is no UTF-8
        return f"commands find this run in its folder only, as it cannot be registered: {error}"
    return None


def registered() -> list[KnownRun]:
    """The runs that run, then those whose folders are there, each the newest first. Removes the entry of a launcher
    that has ended, if its folder was removed or another entry names it."""
    found: dict[Path, list[tuple[_Entry, bool]]] = {}
    for file, entry in _entries():
        folder, is_running = Path(entry.folder), _runs(entry)
        with suppress(OSError, ValueError):  # a folder that cannot be looked at
            if not is_running and (folder in found or not folder.is_dir()):
                file.unlink()
            elif folder.is_absolute():
                found.setdefault(folder, []).append((entry, is_running))
    runs = []
    for folder, entries in found.items():
        launchers = tuple(entry.pid for entry, is_running in entries if is_running)
        web_port, is_whole = (
            max(entry.web_port for entry, _ in entries),
            any(entry.is_whole for entry, _ in entries),
        )
        runs.append(KnownRun(folder, launchers, web_port, is_whole))
    return sorted(runs, key=lambda run: not run.launchers)


def pids_of(run_id: str) -> dict[str, int]:
    """Name -> pid of the processes of a run on this machine, wherever its folders are."""
    runs = (run for run in registered() if run.name == run_id)
    return {name: pid for run in runs for name, pid in run.processes().items()}


def _entries() -> Iterator[tuple[Path, _Entry]]:
    """Yields the entries that can be read, the newest first."""
    files: list[tuple[int, Path]] = []
    with suppress(OSError, RuntimeError):
        for file in registry().glob("*.json"):
            with suppress(OSError):  # one that is written at this moment has another name by now
                files += [(file.lstat().st_mtime_ns, file)] if not file.name.endswith(".part.json") else []
    for _, file in sorted(files, reverse=True):
        with suppress(OSError, SwarmError, msgspec.MsgspecError, RecursionError):
            yield file, msgspec.json.decode(read_text(file, FileKind.RUN), type=_Entry)


def _started_s(pid: int) -> float:
    """Start of a process, in seconds since the machine was started."""
    boot_s = psutil.boot_time()  # first: releases of psutil keep it for the next line
    return float(psutil.Process(pid).create_time() - boot_s)


def _runs(entry: _Entry) -> bool:
    """Returns True if the launcher still runs: another process may have its pid by now."""
    with suppress(psutil.Error):
        process = psutil.Process(entry.pid)
        mine = process.uids().real == os.getuid() and process.status() != psutil.STATUS_ZOMBIE
        return mine and abs(_started_s(entry.pid) - entry.started_s) < _SAME_START_S
    return False


def is_of_a_swarm(pid: int) -> bool:
    """Returns True if a process may be sent a signal: another program can log into the folder of a run, and an
    entry of the registry can name any process."""
    with suppress(psutil.Error):
        return re.search("swarm|launch_scripts", " ".join(psutil.Process(pid).cmdline())) is not None
    return False


def logging_into(folder: Path, logs: Iterable[tuple[int, Path]] | None = None) -> dict[str, int]:
    """Name -> pid of the processes that log into a run's folder; no launcher is among them.

    logs  what `open_logs` has found; None: it searches now
    """
    found = (each for each in (open_logs() if logs is None else logs) if each[1].parent == folder)
    return {path.name.partition(".log")[0]: pid for pid, path in found if not path.name.startswith(LAUNCHER_LOG)}


def open_logs() -> Iterator[tuple[int, Path]]:
    """Yields (pid, file) for each log file that a process of this user has open for writing."""
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):  # ended meanwhile, or of another user
            for path in {file.path for file in process.open_files() if file.mode != "r" and ".log" in file.path}:
                yield process.pid, Path(path)
