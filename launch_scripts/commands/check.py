"""`swarm check`: everything that can be known of a scenario before it is started, all at once."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.text import Text

from launch_scripts.check import ground, machine, settings
from launch_scripts.check.findings import STYLES, Finding, as_fields, counted, failure, warning
from launch_scripts.launcher.console import progress
from launch_scripts.launcher.options import scenario_path, with_port
from launch_scripts.ports import check_ports
from launch_scripts.process_table import ROLES
from swarm.config.input_files import FileKind, read_text, size
from swarm.config.load import read_scenario
from swarm.config.scenario import Scenario
from swarm.errors import BusError, SwarmError

if TYPE_CHECKING:
    from shared_map.terrain.terrain import Terrain


def check_scenario(name: str, runs: Path, port: int | None, as_json: bool) -> None:
    """Print what is found; exit code 1 if it cannot run so. Raises SwarmError where there is nothing to check."""
    path = scenario_path(name)
    scenario, faults = read_scenario(read_text(path, FileKind.SCENARIO), str(path), path.parent)
    found = [failure("", fault) for fault in faults]
    facts: dict[str, Any] = {}
    if scenario is not None:
        if port is not None:
            scenario = with_port(scenario, port)
        found += [
            finding._replace(about=f"{path}: {finding.about}" if finding.about else str(path))
            for finding in (_findings(scenario, runs, facts) if not faults else settings.files_named(scenario))
        ]
    found.sort(key=lambda finding: finding.level != "failure")  # failures stand before warnings
    if as_json:
        typer.echo(json.dumps({"scenario": str(path), **as_fields(found), **facts}, indent=2))
    else:
        _print(str(path), found, facts)
    if any(finding.level == "failure" for finding in found):
        raise typer.Exit(1)


def _findings(scenario: Scenario, runs: Path, facts: dict[str, Any]) -> Iterator[Finding]:
    """facts  what is learnt on the way, for the last line"""
    yield from settings.network(scenario)
    yield from settings.meets(scenario)
    yield from settings.plugins(scenario)
    try:
        check_ports(scenario, ROLES)
    except BusError as error:  # it may be free when the run starts
        yield warning("", str(error))
    broken = [*settings.files_named(scenario), *settings.places_counted(scenario)]
    yield from broken
    if not broken:
        yield from _of_ground(scenario, runs, facts)


def _of_ground(scenario: Scenario, runs: Path, facts: dict[str, Any]) -> Iterator[Finding]:
    from shared_map.terrain.terrain import build_terrain, build_truth

    try:
        with progress() as tell:
            terrain = build_terrain(scenario, tell)
        truth = build_truth(scenario, terrain)
    except SwarmError as error:
        yield failure("", str(error))
        return
    yield from ground.places(scenario, terrain, truth)
    yield from ground.plots(scenario, terrain.grid)
    wanted, here = machine.needs_of(scenario, terrain.grid.cells), machine.this_machine(runs)
    yield from machine.against(scenario, wanted, here, runs)
    facts |= _facts(scenario, terrain, wanted, here)


def _facts(scenario: Scenario, terrain: Terrain, wanted: machine.Needs, here: machine.Machine) -> dict[str, Any]:
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


def _print(path: str, found: list[Finding], facts: dict[str, Any]) -> None:
    console = Console(soft_wrap=True)
    for finding in found:
        console.print(Text.assemble((f"{finding.level}: ", STYLES[finding.level]), finding.sentence))
    if any(finding.level == "failure" for finding in found):
        if len(found) > 1:
            console.print(f"{counted(found, 'failure')}, {counted(found, 'warning')}", highlight=False)
        return
    console.print(
        f"{path} can run, {counted(found, 'warning')}: vehicles {facts['vehicles']:,},"
        f" targets {facts['targets']:,}, processes {facts['processes']}, {facts['seconds']:g} s;"
        f" {facts['rows']} x {facts['cols']} cells of {facts['resolution_m']:g} m,"
        f" {facts['passable_share']:.0%} passable; about {facts['estimated_cores']:.1f} of {facts['cores']} cores"
        f" and {size(facts['estimated_memory_bytes'])}",
        highlight=False,
    )
