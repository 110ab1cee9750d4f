"""`swarm new`, `swarm check` and `swarm doctor`: before a run."""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import typer

from launch_scripts.commands.shared_options import AsJson, PortOption, PresetOption, Runs, ScenarioArgument, Seconds
from launch_scripts.typer_commands import PREPARE, command
from swarm.errors import ConfigError
from swarm.files import write_file

app = typer.Typer()
_HEAD = """A scenario of terrain-swarm, written by `swarm new`. Every setting that is not here has its default; all
settings: docs/reference/scenario.md.

    swarm check {name}      reports all mistakes before it runs
    swarm up {name}         run it; Ctrl-C ends it and leaves runs/LAST/
"""
_AGENTS, _LEAST_PER_AGENT = 8, 25
"""An agent costs by itself, in every tick: few of many vehicles cost a machine less than many of few."""


@dataclass(frozen=True)
class Choices:
    """Choices for a new scenario.

    terrain   jacksboro, synthetic, or a file of elevation.
    photo     A GeoTIFF in colour on the same ground.
    vehicles  How many vehicles.
    targets   How many targets.
    walk      Motion of targets: still, random, waypoints or evade.
    seconds   Duration of the run.
    """

    panel: ClassVar[str | None] = None
    terrain: str = "synthetic"
    photo: str | None = None
    preset: PresetOption = None
    vehicles: Annotated[int, typer.Option(min=1, max=100_000)] = 20
    targets: Annotated[int, typer.Option(min=1, max=1000)] = 3
    walk: str = "waypoints"
    seconds: Seconds = 60.0


_OPTIONS = {
    "terrain.source": "--terrain",
    "terrain.photo": "--photo",
    "cost.preset": "--preset",
    "groups[0].vehicles": "--vehicles",
    "targets[0].count": "--targets",
    "targets[0].walk": "--walk",
}
"""Key of the scenario -> the option that sets it."""


@command(app, PREPARE)
def new(file: Annotated[Path, typer.Argument(metavar="FILE")], choices: Choices) -> None:
    """Write a scenario, with a comment for every key.

    An existing file is never overwritten.

    swarm new my.toml

    swarm new ridge.toml --terrain dem.tif --photo photo.tif --preset hiker --vehicles 12 --targets 2

    file  The scenario to write.
    """
    if file.suffix != ".toml":
        raise ConfigError(f"{file}: the name of a scenario ends in .toml, such as {file.stem or 'my'}.toml")
    if file.exists():
        raise ConfigError(f"{file} is there already and stays as it is; choose another name, or remove it first")
    if not file.absolute().parent.is_dir():
        raise ConfigError(f"{file}: there is no folder {file.parent}; make it first")
    from swarm.config.scenario_files import commented

    text = commented(_settings(file, choices), _HEAD.format(name=file))
    _check(file, text)
    write_file(file, text.encode())
    typer.echo(f"{file} is written; `swarm check {file}` looks at it, `swarm up {file}` runs it")


def _check(path: Path, text: str) -> None:
    """Raises ConfigError where something chosen is not possible, by the option's name."""
    from launch_scripts.check import scenario_check
    from swarm.config.scenario_files import read_scenario

    scenario, faults, _ = read_scenario(text, str(path), path.parent)
    if scenario is not None:
        faults += [each.sentence for each in scenario_check.files_named(scenario)]
    for sentence in faults:
        key, _, rest = sentence.removeprefix(f"{path}: ").partition(": ")
        raise ConfigError(f"{_OPTIONS.get(key, key)}: {rest}")


def _settings(path: Path, chosen: Choices) -> dict[str, Any]:
    """Returns the settings to write; those which are None are left out."""
    from swarm.config.scenario_files import with_settings
    from swarm.config.setting_types import MOST_PER_AGENT

    name = "".join(letter if letter.isalnum() and letter.isascii() else "-" for letter in path.stem).strip("-")
    settings: dict[str, Any] = {
        "name": name[:40] or "unnamed",
        "seconds": chosen.seconds,
        "terrain.source": _from(path, chosen.terrain),
        "terrain.photo": _from(path, chosen.photo) if chosen.photo else None,
        "cost.preset": chosen.preset,
        "targets.0.name": "t" if chosen.targets > 1 else "t0",
        "targets.0.count": chosen.targets,
        "targets.0.walk": chosen.walk,
        "groups.0.vehicles": chosen.vehicles,
        "vehicles.per_agent": min(max(_LEAST_PER_AGENT, -(-chosen.vehicles // _AGENTS)), MOST_PER_AGENT),
    }
    if chosen.terrain != "synthetic":
        settings |= dict.fromkeys(("terrain.rows", "terrain.cols", "terrain.relief_m", "terrain.roads"))
    if chosen.preset:
        settings |= dict.fromkeys(("cost.flat_speed_m_per_s", "cost.max_slope_deg"))
    usual = tomllib.loads(Path(__file__).with_name("new_scenario.toml").read_text(encoding="utf-8"))
    return with_settings(usual, settings, str(path))


def _from(path: Path, name: str) -> str:
    """A file as it is named from the folder of the scenario."""
    from swarm.config.scenario_files import BUILT_IN_TERRAINS

    if name in BUILT_IN_TERRAINS or Path(name).is_absolute():
        return name
    return os.path.relpath(name, path.parent)


@command(app, PREPARE)
def check(
    scenario: ScenarioArgument, runs: Runs = Path("runs"), port: PortOption = None, as_json: AsJson = False
) -> int:
    """Check a scenario before a run: files, terrain, ports and this machine.

    Exit code 1 if the scenario cannot run. Runs the modules of its plug-ins.

    swarm check my.toml

    swarm check my.toml --json | jq .findings
    """
    from launch_scripts.check import answer
    from launch_scripts.check.scenario_check import check_scenario
    from launch_scripts.launcher.run_options import scenario_path

    path = scenario_path(scenario)
    found, facts, summary = check_scenario(path, runs, port)
    return answer(found, as_json, {"scenario": str(path), **facts}, summary)


@command(app, PREPARE)
def doctor(runs: Runs = Path("runs"), as_json: AsJson = False) -> int:
    """Check if this machine and installation can run a swarm.

    Python, packages, compiled planners, cores, memory, open files, Zenoh over loopback, clock and disk. Exit code 1
    if a swarm cannot run here.

    swarm doctor

    swarm doctor --json | jq .findings
    """
    from launch_scripts.check import answer
    from launch_scripts.check.machine_check import examine

    return answer(list(examine(runs)), as_json, {})
