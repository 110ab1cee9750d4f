"""The folder of a run: its scenario, versions and machine from its first second on, its report at its end.

A `DiskWatch` says when the folder takes no more data.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import math
import os
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Any

from launch_scripts.observe.local_runs import register, registered
from swarm.config.input_files import FileKind, read_text
from swarm.config.scenario import Scenario
from swarm.config.write import scenario_text
from swarm.errors import ConfigError, StoreError, SwarmError
from swarm.files import check_writable, write_file

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
    said = []
    for name, text in texts.items():
        try:
            write_file(folder / name, text.encode())
        except StoreError as error:
            said.append(str(error))
    said += filter(None, (point_last(folder), register(folder, is_whole=simulated)))
    return said


def ended(folder: Path) -> dict[str, Any]:
    """The facts of `run.json` with the time of now as the run's end, for the report. Empty if there are none."""
    facts = run_facts(folder)
    kept: dict[str, Any] = {name: facts[name] for name in ("versions", "machine") if name in facts}
    return {"began": facts.get("began"), "ended": _now(), **kept} if facts else {}


def run_facts(folder: Path) -> dict[str, Any]:
    """Returns the content of `run.json`; empty if it cannot be read."""
    try:
        facts = json.loads(read_text(folder / RUN_FILE, FileKind.RUN))
    except (SwarmError, OSError, ValueError, RecursionError):
        return {}
    return facts if isinstance(facts, dict) else {}


def point_last(folder: Path) -> str | None:
    """Makes `LAST` beside a run's folder a link to that run, at one instant. Returns a sentence if that is
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
        said = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
    root = Path(__file__).parents[2]
    if package != OURS or not (root / ".git").exists() or not shutil.which("git"):
        return said
    # The editable installation of a checkout outlives the commit that it was made from (hatch_build.py).
    asked = ["git", "-C", str(root), "rev-parse", "--short=12", "HEAD"]
    commit = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return "+g".join(filter(None, (said.partition("+")[0], commit)))


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def processor() -> str:
    """Name of the processor, as far as the system says it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


LOOK_EVERY_S = 5.0
"""A full disk is reported within seconds, and a try is 64 kB, which no disk feels at this rate."""
SAY_EVERY_S = 60.0
"""A full disk is named once a minute (docs/operate/failures.md): often enough to be seen, and the log stays
readable."""


class DiskWatch:
    """Tries now and then to write to a folder: the processes that write there cannot say so in their logs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._due_s = 0.0
        self._said_s: float | None = None
        """Time when it was last said that there is no space; None while there is."""

    def check_room(self, now_s: float) -> str | None:
        """A sentence for the user; None if there is nothing new to say. Call it often."""
        if now_s < self._due_s:
            return None
        self._due_s = now_s + LOOK_EVERY_S
        try:
            check_writable(self._folder)
        except StoreError as error:
            if self._said_s is not None and now_s - self._said_s < SAY_EVERY_S:
                return None
            self._said_s = now_s
            return f"{error}; all goes on but logs and recording"
        if self._said_s is None:
            return None
        self._said_s = None
        return f"{self._folder} can be written again"
