"""The folder of a run: its scenario, versions and machine from its first second on, its report at its end.

A `DiskWatch` says when the folder takes no more data.

Commands find a run from any folder by the registry of this user's runs. Each launcher writes one small file, which
names the folder of its run and the launcher's process. A file outlives its launcher: it goes when the folder of the
run does.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import math
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import psutil

from swarm.config.input_files import FileKind, read_bytes, read_text
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import scenario_text
from swarm.errors import ConfigError, StoreError, SwarmError
from swarm.files import check_writable, make_folder, write_file
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
    is_ending: bool = False


@dataclass(frozen=True)
class KnownRun:
    """A run of this user.

    launchers  pids of its launchers that run on this machine, the newest first
    web_port   of the live page; 0 as long as it has none
    is_whole   the swarm has been whole
    is_ending  its launchers end their processes, or write the report
    """

    folder: Path
    launchers: tuple[int, ...]
    web_port: int
    is_whole: bool
    is_ending: bool = False

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


def register(folder: Path, **progress: Any) -> str | None:
    """Registers this process as a launcher of the run in a folder, or changes its entry. Returns a sentence if that
    is impossible.

    progress  web_port, is_whole and is_ending of its entry
    """
    try:
        pid = os.getpid()
        entry = _Entry(folder=str(folder.resolve()), pid=pid, started_s=_started_s(pid), **progress)
        file = registry() / f"{folder.name}.{pid}.json"
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
        running = [entry for entry, is_running in entries if is_running]
        launchers = tuple(entry.pid for entry in running)
        web_port = max(entry.web_port for entry, _ in entries)
        is_whole = any(entry.is_whole for entry, _ in entries)
        runs.append(KnownRun(folder, launchers, web_port, is_whole, all(entry.is_ending for entry in running)))
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
            yield file, msgspec.json.decode(read_bytes(file, FileKind.RUN), type=_Entry)


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


SCENARIO_FILE, RUN_FILE, REPORT_FILE = "scenario.toml", "run.json", "report.json"
RUNS = Path("runs")
"""The folder of all runs, if no other is given. Commands look there beside the registry: runs of earlier versions
are not registered."""
LAST = "LAST"
"""In the folder of all runs: a link to the newest."""
OURS = "terrain-swarm"
_PACKAGES = {"terrain_swarm": OURS, "zenoh": "eclipse-zenoh", "numba": "numba", "numpy": "numpy"}


def begin_run(
    folder: Path, scenario: Scenario, run_id: str, *, recorded: bool = True, simulated: bool = False
) -> list[str]:
    """Writes `scenario.toml` and `run.json`, makes `LAST` point here and registers the run. Returns a warning for
    the user if a file cannot be written; the run goes on.

    recorded   whether a report follows; else another launcher of the run makes it
    simulated  the run has no router: no command can ask it
    """
    began = _now()
    head = f"# Run {run_id}, {began}: every setting that it ran with. `swarm up` runs it again.\n"
    facts = {
        "run_id": run_id,
        "scenario": scenario.name,
        "seed": scenario.seed,
        "began": began,
        "recorded": recorded,
        "simulated": simulated,
        "versions": {
            "python": platform.python_version(),
            **{name: version_of(package) for name, package in _PACKAGES.items()},
        },
        "machine": {
            "system": f"{platform.system()} {platform.release()}",
            "processor": processor(),
            "cores": os.cpu_count(),
        },
    }
    texts = {
        SCENARIO_FILE: head + scenario_text(scenario, Path.cwd()),
        RUN_FILE: json.dumps(facts, indent=1) + "\n",
    }
    warnings = []
    for name, text in texts.items():
        try:
            write_file(folder / name, text.encode())
        except StoreError as error:
            warnings.append(str(error))
    warnings += filter(None, (point_last(folder), register(folder, is_whole=simulated)))
    return warnings


def ended(folder: Path) -> dict[str, Any]:
    """Returns those facts of `run.json` which a report needs, with the current time as the end of the run; empty if
    there is no such file."""
    facts = run_facts(folder)
    kept: dict[str, Any] = {name: facts[name] for name in ("versions", "machine") if name in facts}
    return {"began": facts.get("began"), "ended": _now(), **kept} if facts else {}


def run_facts(folder: Path) -> dict[str, Any]:
    """Returns the content of `run.json`; empty if it cannot be read."""
    with suppress(SwarmError, OSError, msgspec.MsgspecError, RecursionError):
        return msgspec.json.decode(read_bytes(folder / RUN_FILE, FileKind.RUN), type=dict[str, Any])
    return {}


def point_last(folder: Path) -> str | None:
    """Makes `LAST` beside a run's folder a link to that run, in one step. Returns a sentence if that is
    impossible."""
    last, partial = folder.parent / LAST, folder.parent / f".{LAST}.{os.getpid()}"
    try:
        partial.unlink(missing_ok=True)
        partial.symlink_to(folder.name, target_is_directory=True)
        partial.replace(last)
    except OSError as error:
        return f"{last} cannot be made a link to this run: {error.strerror or error}"
    return None


def find_run(name: str, runs: Path) -> Path:
    """The folder of a run: a path, or its name in `runs`. In the usual folder also the name of a registered run, of
    which `LAST` is the newest. Raises ConfigError."""
    for path in (Path(name), runs / name):
        if os.path.isdir(path):  # unlike `Path.is_dir` also of a name that is too long
            return path
    known = [run.folder for run in registered() if name in (run.name, LAST)] if runs == RUNS else []
    if name != LAST and len(known) > 1:
        folders = ", ".join(map(str, known))
        raise ConfigError(f"found {len(known)} runs called {name!r}, expected the folder of one: {folders}")
    if known:
        return known[0]
    raise ConfigError(f"there is no run {name!r}: neither a folder nor in {runs}; `swarm ps -a` lists your runs")


def find_parts(name: str, runs: Path) -> list[Path]:
    """The folders of a run on this machine, one of each of its launchers that has its own, as where two machines
    are rehearsed on one; only those where a launcher runs, if there are such. A path is that one folder; so is the
    name of runs with unlike scenarios or seeds. Raises ConfigError as `find_run`."""
    known = [run for run in registered() if run.name == name] if runs == RUNS else []
    parts = [run.folder for run in known if run.launchers] or [run.folder for run in known]
    kinds = {(facts.get("scenario"), facts.get("seed")) for facts in map(run_facts, parts)}
    return parts if len(kinds) == 1 else [find_run(name, runs)]


def lacks(folder: Path, file: str) -> ConfigError:
    """The error where a run's folder lacks a file that a run leaves at its end, and why it does."""
    why = "the run has not ended yet, or its launcher was killed"
    if run_facts(folder).get("recorded") is False:
        why = "the launcher of another machine records the run, and leaves it in its own folder"
    return ConfigError(f"{folder} has no {file}: {why}")


def read_report(folder: Path) -> dict[str, Any]:
    """`report.json` of a run. Raises ConfigError or StoreError in one sentence."""
    path = folder / REPORT_FILE
    if not path.exists():
        raise lacks(folder, REPORT_FILE)
    try:
        text, number = read_text(path, FileKind.RUN), _number
        report = json.loads(text, parse_int=number, parse_float=number, parse_constant=number)
        if not isinstance(report, dict):
            raise ValueError("found no object, expected the figures of a run")
        return report
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path} is damaged: {error}") from error


def _number(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"found {text[:30]}, expected a number")
    return int(text) if text.lstrip("-").isdecimal() else value


def version_of(package: str) -> str | None:
    """The version of an installed package, with the commit if it is ours in a checkout; None where it is not
    installed."""
    try:
        version = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
    root = Path(__file__).parents[2]
    if package != OURS or not (root / ".git").exists() or not shutil.which("git"):
        return version
    # The editable installation of a checkout outlives the commit that it was made from (hatch_build.py).
    asked = ["git", "-C", str(root), "rev-parse", "--short=12", "HEAD"]
    commit = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return "+g".join(filter(None, (version.partition("+")[0], commit)))


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def processor() -> str:
    """Name of the processor, as far as the system says it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


CHECK_EVERY_S = 5.0
"""A full disk is reported within seconds, and a try is 64 kB, which no disk feels at this rate."""
SAY_EVERY_S = 60.0
"""A full disk is named once a minute (docs/operate/failures.md): often enough to be seen, and the log stays
readable."""


class DiskWatch:
    """Tries now and then to write to a folder: the processes that write there cannot say so in their logs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._due_s = 0.0
        self._warned_s: float | None = None
        """Time when it was last said that there is no space; None while there is."""

    def check_room(self, now_s: float) -> str | None:
        """A sentence for the user; None if there is nothing new to say. Call it often."""
        if now_s < self._due_s:
            return None
        self._due_s = now_s + CHECK_EVERY_S
        try:
            check_writable(self._folder)
        except StoreError as error:
            if self._warned_s is not None and now_s - self._warned_s < SAY_EVERY_S:
                return None
            self._warned_s = now_s
            return f"{error}; all goes on but logs and recording"
        if self._warned_s is None:
            return None
        self._warned_s = None
        return f"{self._folder} can be written again"
