"""Sub-commands for before a run: write a scenario, look what is wrong with it, look at this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.panels import PREPARE
from launch_scripts.commands.shared_options import (
    MOST_SECONDS,
    AsJson,
    PortOption,
    PresetOption,
    Runs,
    ScenarioArgument,
)

app = typer.Typer()


@app.command(rich_help_panel=PREPARE)
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The scenario to write, such as my.toml.")],
    terrain: Annotated[
        str | None,
        typer.Option(help="jacksboro, synthetic, or a file of elevation.", autocompletion=complete.terrains),
    ] = None,
    photo: Annotated[str | None, typer.Option(help="A GeoTIFF in colour on the same ground.")] = None,
    preset: PresetOption = None,
    vehicles: Annotated[int | None, typer.Option(min=1, max=100_000, help="How many vehicles.")] = None,
    targets: Annotated[int | None, typer.Option(min=1, max=1000, help="How many targets.")] = None,
    walk: Annotated[
        str | None,
        typer.Option(
            help="How targets move: still, random, waypoints or evade.",
            autocompletion=complete.words("swarm.config.values", "Walk"),
        ),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, max=MOST_SECONDS, help="How long the run lasts.")
    ] = None,
) -> None:
    """Write a scenario of your own, with a comment for every key. On a terminal it asks for what is not given.

    An existing file is never written over.

    swarm new my.toml

    swarm new ridge.toml --terrain dem.tif --photo photo.tif --preset hiker --vehicles 12 --targets 2
    """
    from launch_scripts.commands.new import Choices, write_new

    write_new(file, Choices(terrain, photo, preset, vehicles, targets, walk, seconds))


@app.command(rich_help_panel=PREPARE)
def check(
    scenario: ScenarioArgument,
    runs: Runs = Path("runs"),
    port: PortOption = None,
    as_json: AsJson = False,
) -> None:
    """Say all that is wrong with a scenario, before any process of it is started.

    Keys and values, files, the terrain and the places on it, certificates, ports, plug-ins, and whether this
    machine is large enough. Exit code 1 if it cannot run so. Runs the modules of its plug-ins.

    swarm check my.toml

    swarm check my.toml --json | jq .findings
    """
    from launch_scripts.commands.check import check_scenario

    check_scenario(scenario, runs, port, as_json)


@app.command(rich_help_panel=PREPARE)
def doctor(runs: Runs = Path("runs"), as_json: AsJson = False) -> None:
    """Look at this machine and this installation: is it fit for a swarm, and what is to be done?

    Python, packages, compiled planners, cores, memory, open files, Zenoh over loopback, ports, clock, browser and
    disk. Each line is ok, a warning or a failure. Exit code 1 if a swarm cannot run here.

    swarm doctor

    swarm doctor --json | jq .findings
    """
    from launch_scripts.commands.doctor import look_at_machine

    look_at_machine(runs, as_json)
