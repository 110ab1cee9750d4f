"""`swarm new`, `swarm check` and `swarm doctor`: before a run."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.declaring import PREPARE, command
from launch_scripts.commands.shared_options import (
    AsJson,
    PortOption,
    PresetOption,
    Runs,
    ScenarioArgument,
    Seconds,
    Walk,
)
from swarm.errors import BusError, ConfigError, SwarmError
from swarm.files import write_file

if TYPE_CHECKING:
    from launch_scripts.check.findings import Finding
    from launch_scripts.check.machine_check import Machine, Needs
    from shared_map.terrain.terrain import Terrain
    from swarm.config.scenario import Scenario

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
    """Choices for a new scenario; None is not chosen yet, and an empty text is none.

    terrain   jacksboro, synthetic, or a file of elevation.
    photo     A GeoTIFF in colour on the same ground.
    vehicles  How many vehicles.
    targets   How many targets.
    walk      Motion of targets: still, random, waypoints or evade.
    seconds   Duration of the run.
    """

    panel: ClassVar[str | None] = None
    terrain: Annotated[str | None, typer.Option(autocompletion=complete.terrains)] = None
    photo: str | None = None
    preset: PresetOption = None
    vehicles: Annotated[int | None, typer.Option(min=1, max=100_000)] = None
    targets: Annotated[int | None, typer.Option(min=1, max=1000)] = None
    walk: Walk = None
    seconds: Seconds = None


_DEFAULTS = Choices("synthetic", "", "", 20, 3, "waypoints", 60.0)
_ASKED = {
    "terrain": (
        "terrain.source",
        "Terrain: jacksboro (real mountains), synthetic (made up), or a file of elevation",
    ),
    "photo": ("terrain.photo", "Photo of the same ground, a GeoTIFF (Enter for none)"),
    "preset": (
        "cost.preset",
        "Class of vehicles: hiker, wheeled, tracked, quadruped (Enter for plain settings)",
    ),
    "vehicles": ("groups[0].vehicles", "How many vehicles"),
    "targets": ("targets[0].count", "How many targets"),
    "walk": ("targets[0].walk", "How targets move: still, random, waypoints, evade"),
    "seconds": ("seconds", "How many seconds the run lasts"),
}
"""Choice -> (key of the scenario, question)."""


@command(app, PREPARE)
def new(file: Annotated[Path, typer.Argument(metavar="FILE")], choices: Choices) -> None:
    """Write a scenario, with a comment for every key.

    On a terminal it asks for missing choices. An existing file is never overwritten.

    swarm new my.toml

    swarm new ridge.toml --terrain dem.tif --photo photo.tif --preset hiker --vehicles 12 --targets 2

    file  The scenario to write, such as my.toml.
    """
    if file.suffix != ".toml":
        raise ConfigError(f"{file}: the name of a scenario ends in .toml, such as {file.stem or 'my'}.toml")
    if file.exists():
        raise ConfigError(f"{file} is there already and stays as it is; choose another name, or remove it first")
    if not file.absolute().parent.is_dir():
        raise ConfigError(f"{file}: there is no folder {file.parent}; make it first")
    _check_choices(file, choices)
    if is_terminal():
        choices = _asked(file, choices)
    text = _text(file, choices)
    write_file(file, text.encode())
    typer.echo(f"{file} is written; `swarm check {file}` looks at it, `swarm up {file}` runs it")


def is_terminal() -> bool:
    """Returns True if there is a user to ask."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def _asked(path: Path, choices: Choices, ask: Callable[..., Any] = typer.prompt) -> Choices:
    """Returns the choices with answers for the missing ones; an impossible answer is explained and asked again."""
    from swarm.config.load import BUILT_IN_TERRAINS

    for name, (_, question) in _ASKED.items():
        default = getattr(_DEFAULTS, name)
        while getattr(choices, name) is None and not (name == "photo" and choices.terrain in BUILT_IN_TERRAINS):
            answer = ask(question, default=default, type=type(default), err=True, show_default=default != "")
            answered = replace(choices, **{name: answer})
            try:
                _check_choices(path, answered)
            except ConfigError as error:
                typer.echo(f"  {error}", err=True)
                continue
            choices = answered
    return choices


def _check_choices(path: Path, choices: Choices) -> None:
    """Raises ConfigError where something chosen is not possible, by the option's name."""
    from launch_scripts.check import scenario_check
    from swarm.config.load import read_scenario

    option_of = {key: f"--{name}" for name, (key, _) in _ASKED.items()}
    scenario, faults = read_scenario(_text(path, choices), str(path), path.parent)
    found = (
        faults if scenario is None else [*faults, *(each.sentence for each in scenario_check.files_named(scenario))]
    )
    for sentence in found:
        key, _, rest = sentence.removeprefix(f"{path}: ").partition(": ")
        raise ConfigError(f"{option_of.get(key, key)}: {rest}")


def _text(path: Path, choices: Choices) -> str:
    from swarm.config.write import commented

    given = {field.name: getattr(choices, field.name) for field in fields(choices)}
    chosen = replace(_DEFAULTS, **{name: value for name, value in given.items() if value is not None})
    return commented(_settings(path, chosen), _HEAD.format(name=path))


def _settings(path: Path, chosen: Choices) -> dict[str, Any]:
    """Returns the settings to write: enough to show the form of a scenario, and no more."""
    from swarm.config.setting_types import MOST_PER_AGENT

    terrain: dict[str, Any] = {"source": _from(path, chosen.terrain)}
    if chosen.photo:
        terrain["photo"] = _from(path, chosen.photo)
    if chosen.terrain == "synthetic":
        terrain |= {"rows": 256, "cols": 256, "relief_m": 400.0, "roads": 4}
    terrain["hidden"] = {"closed_roads": 1, "rubble_fields": 10}
    cost: dict[str, Any] = {"preset": chosen.preset} if chosen.preset else {"flat_speed_m_per_s": 10.0}
    name = "".join(letter if letter.isalnum() and letter.isascii() else "-" for letter in path.stem).strip("-")
    return {
        "name": name[:40] or "unnamed",
        "seed": 1,
        "seconds": chosen.seconds,
        "terrain": terrain,
        "cost": cost if chosen.preset else {**cost, "max_slope_deg": 35.0},
        "planner": {"places": True},
        "targets": [
            {
                "name": "t" if (chosen.targets or 0) > 1 else "t0",
                "count": chosen.targets,
                "walk": chosen.walk,
                "speed_m_per_s": 4.0,
            }
        ],
        "groups": [{"name": "all", "vehicles": chosen.vehicles, "start": "spread"}],
        "vehicles": {
            "per_agent": min(max(_LEAST_PER_AGENT, -(-(chosen.vehicles or 0) // _AGENTS)), MOST_PER_AGENT),
            "tick_hz": 10.0,
            "sense_range_m": 300.0,
            "capture_range_m": 150.0,
        },
    }


def _from(path: Path, name: str | None) -> str:
    """A file as it is named from the folder of the scenario."""
    from swarm.config.load import BUILT_IN_TERRAINS

    if name is None or name in BUILT_IN_TERRAINS or Path(name).is_absolute():
        return str(name)
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
    from launch_scripts.check import scenario_check
    from launch_scripts.check.findings import as_fields, failure
    from launch_scripts.launcher.options import scenario_path, with_port
    from swarm.config.input_files import FileKind, read_text
    from swarm.config.load import read_scenario

    path = scenario_path(scenario)
    read, faults = read_scenario(read_text(path, FileKind.SCENARIO), str(path), path.parent)
    found = [failure("", fault) for fault in faults]
    facts: dict[str, Any] = {}
    if read is not None:
        if port is not None:
            read = with_port(read, port)
        found += [
            finding._replace(about=f"{path}: {finding.about}" if finding.about else str(path))
            for finding in (_findings(read, runs, facts) if not faults else scenario_check.files_named(read))
        ]
    found.sort(key=lambda finding: finding.level != "failure")  # failures stand before warnings
    if as_json:
        told = {"scenario": str(path), **as_fields(found), **facts}
        typer.echo(json.dumps(told, indent=2))
        return int(not told["ok"])
    return _print(found, _summary(path, found, facts) if facts else "")


def _findings(scenario: Scenario, runs: Path, facts: dict[str, Any]) -> Iterator[Finding]:
    """facts  collects facts on the way, for the last line"""
    from launch_scripts.check import scenario_check
    from launch_scripts.check.findings import warning
    from launch_scripts.ports import check_ports
    from launch_scripts.process_table import ROLES

    yield from scenario_check.network(scenario)
    yield from scenario_check.meets(scenario)
    yield from scenario_check.plugins(scenario)
    try:
        check_ports(scenario, ROLES)
    except BusError as error:  # it may be free when the run starts
        yield warning("", str(error))
    broken = [*scenario_check.files_named(scenario), *scenario_check.places_counted(scenario)]
    yield from broken
    if not broken:
        yield from _of_ground(scenario, runs, facts)


def _of_ground(scenario: Scenario, runs: Path, facts: dict[str, Any]) -> Iterator[Finding]:
    from launch_scripts.check import machine_check as machine
    from launch_scripts.check import scenario_check
    from launch_scripts.check.findings import failure
    from launch_scripts.launcher.console import progress
    from shared_map.terrain.terrain import build_terrain, build_truth
    from swarm.config.plugin_names import plugins_of

    try:
        with progress() as tell:
            terrain = build_terrain(scenario, tell)
        truth = build_truth(scenario, terrain)
    except SwarmError as error:
        yield failure("", str(error))
        return
    yield from scenario_check.places(scenario, terrain, truth)
    yield from scenario_check.shards(scenario, terrain.grid)
    if any(each.name not in each.kind.built_in for each in plugins_of(scenario)):
        from launch_scripts.check.plugin_check import not_made

        yield from not_made(scenario, terrain.grid, truth)
    yield from scenario_check.one_way_ground(scenario, terrain, truth)
    wanted, here = machine.needs_of(scenario, terrain.grid.cells), machine.this_machine(runs)
    yield from machine.against(scenario, wanted, here, runs)
    facts |= _facts(scenario, terrain, wanted, here)


def _facts(scenario: Scenario, terrain: Terrain, wanted: Needs, here: Machine) -> dict[str, Any]:
    return {
        "targets": len(scenario.target_ids),
        "vehicles": scenario.vehicle_count,
        "agents": wanted.agents,
        "processes": wanted.processes,
        "seconds": scenario.seconds,
        "rows": terrain.grid.rows,
        "cols": terrain.grid.cols,
        "resolution_m": terrain.grid.resolution_m,
        "passable_share": round(1 - float(terrain.lethal.mean()), 4),
        "estimated_cores": round(wanted.cores, 2),
        "cores": here.cores,
        "estimated_memory_bytes": wanted.memory_bytes,
        "available_memory_bytes": here.free_bytes,
    }


def _print(found: list[Finding], summary: str = "") -> int:
    """Prints a line for each finding, and a last one: how many are wrong, or `summary` where none is a failure.
    Returns the exit code."""
    from rich.console import Console
    from rich.text import Text

    from launch_scripts.check.findings import STYLES, counted

    console = Console(soft_wrap=True, highlight=False)
    for finding in found:
        console.print(Text.assemble((f"{finding.level}: ", STYLES[finding.level]), finding.sentence))
    failed = any(finding.level == "failure" for finding in found)
    if summary and not failed:
        console.print(summary)
    elif len(found) > 1:
        console.print(f"{counted(found, 'failure')}, {counted(found, 'warning')}")
    return int(failed)


def _summary(path: Path, found: list[Finding], facts: dict[str, Any]) -> str:
    """Returns the summary of a scenario that can run."""
    from launch_scripts.check.findings import counted
    from swarm.config.input_files import size

    return (
        f"{path} can run, {counted(found, 'warning')}: vehicles {facts['vehicles']:,},"
        f" targets {facts['targets']:,}, processes {facts['processes']}, {facts['seconds']:g} s;"
        f" {facts['rows']} x {facts['cols']} cells of {facts['resolution_m']:g} m,"
        f" {facts['passable_share']:.0%} passable; about {facts['estimated_cores']:.1f} of {facts['cores']} cores"
        f" and {size(facts['estimated_memory_bytes'])}"
    )


@command(app, PREPARE)
def doctor(runs: Runs = Path("runs"), as_json: AsJson = False) -> int:
    """Check if this machine and installation can run a swarm.

    Python, packages, compiled planners, cores, memory, open files, Zenoh over loopback, ports, clock, browser and
    disk. Each line is ok, a warning or a failure. Exit code 1 if a swarm cannot run here.

    swarm doctor

    swarm doctor --json | jq .findings
    """
    from launch_scripts.check.findings import as_fields
    from launch_scripts.check.machine_check import examine

    found = list(examine(runs))
    if as_json:
        told = as_fields(found)
        typer.echo(json.dumps(told, indent=2))
        return int(not told["ok"])
    return _print(found)
