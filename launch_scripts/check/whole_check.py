"""The whole check of a scenario, as `swarm check` makes it: its file, its ports, its ground and this machine."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from launch_scripts.check import Finding, counted, failure, machine_check, scenario_check, warning
from launch_scripts.launcher.console import progress
from launch_scripts.launcher.run_options import with_port
from launch_scripts.ports import check_ports
from launch_scripts.process_table import ROLES
from shared_map.array_files import Floats
from shared_map.terrain.terrain import build_terrain, build_truth
from swarm.config.input_files import FileKind, read_text, size
from swarm.config.load import read_scenario
from swarm.config.plugin_names import plugins_of
from swarm.config.scenario import Scenario
from swarm.errors import BusError, SwarmError
from swarm.grid import GridSpec
from swarm.plugins.find import find_plugin


def check_scenario(path: Path, runs: Path, port: int | None) -> tuple[list[Finding], dict[str, Any], str]:
    """Returns the findings, failures first, and the facts of a scenario whose ground was built, also in words."""
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
    if not facts:
        return found, facts, ""
    summary = (
        f"{path} can run, {counted(found, 'warning')}: vehicles {facts['vehicles']:,},"
        f" targets {facts['targets']:,}, processes {facts['needs']['processes']}, {facts['seconds']:g} s;"
        f" {facts['rows']} x {facts['cols']} cells of {facts['resolution_m']:g} m,"
        f" {facts['passable_share']:.0%} passable; about {facts['needs']['cores']:.1f} of"
        f" {facts['machine']['cores']} cores and {size(facts['needs']['memory_bytes'])}"
    )
    return found, facts, summary


def _findings(scenario: Scenario, runs: Path, facts: dict[str, Any]) -> Iterator[Finding]:
    """facts  collects facts on the way"""
    yield from scenario_check.network(scenario)
    yield from scenario_check.meets(scenario)
    yield from scenario_check.plugins(scenario)
    try:
        check_ports(scenario, ROLES)
    except SwarmError as error:  # a port which is taken may be free when the run starts
        yield (warning if isinstance(error, BusError) else failure)("", str(error))
    broken = [*scenario_check.files_named(scenario), *scenario_check.places_counted(scenario)]
    yield from broken
    if broken:
        return
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
        yield from not_made(scenario, terrain.grid, truth)
    yield from scenario_check.one_way_ground(scenario, terrain, truth)
    wanted, here = machine_check.needs_of(scenario, terrain.grid.cells), machine_check.this_machine(runs)
    yield from machine_check.against(scenario, wanted, here, runs)
    facts |= {
        "targets": len(scenario.target_ids),
        "vehicles": scenario.vehicle_count,
        "seconds": scenario.seconds,
        "rows": terrain.grid.rows,
        "cols": terrain.grid.cols,
        "resolution_m": terrain.grid.resolution_m,
        "passable_share": round(1 - float(terrain.lethal.mean()), 4),
        "needs": wanted._asdict(),
        "machine": here._asdict(),
    }


def not_made(scenario: Scenario, grid: GridSpec, truth: Floats) -> Iterator[Finding]:
    """Yields plug-ins of a scenario that a run could not make, where they can be imported. Those of cost layers are
    made with the terrain."""
    # They load the planner, which only a scenario with plug-ins of its own needs here.
    from launch_scripts.simulation.world.walks import Budget, TrueTerrain, WalkWorld
    from planner_service.strategy import StrategyWorld
    from vehicle_agent.assignment import AssignmentWorld
    from vehicle_agent.driving.dynamics import DynamicsWorld
    from vehicle_agent.sensing.sensor import SensorWorld

    seed = scenario.seed
    worlds = {
        "sensor": SensorWorld(grid, truth, 35.0, "a0", seed),
        "walk": WalkWorld("t0", TrueTerrain(grid, truth), random.Random(seed), Budget()),
        "assignment": AssignmentWorld("a0", "all", ("t0",), seed),
        "strategy": StrategyWorld("t0", grid, scenario.planner),
        "dynamics": DynamicsWorld("a0", grid, seed),
    }
    for named in plugins_of(scenario):
        if named.kind.name not in worlds:
            continue
        try:
            plugin = find_plugin(named, scenario.plugin_folder)
        except SwarmError:
            continue  # reported with the plug-ins that cannot be imported
        if plugin.factory is not None:
            try:
                plugin.make(worlds[named.kind.name])
            except SwarmError as error:
                yield failure(named.key, str(error).removeprefix(f"{named.key}: "))
