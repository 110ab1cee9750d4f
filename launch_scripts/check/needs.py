"""What a run needs of this machine, by a rule of thumb, beside what the machine has."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from launch_scripts.check.findings import Finding, failure, warning
from launch_scripts.process_table import processes_of
from swarm.config.agents import plan_agents
from swarm.config.input_files import size
from swarm.config.scenario import Scenario

# docs/scale-figures.md: 300 to 3,000 vehicles of five or six agents on two cores at 5 Hz. That agents, vehicles and
# trees cost in proportion to ticks and numbers is the thumb in the rule.
_AGENT_CORES_AT_5_HZ = 0.022
_VEHICLE_CORES_AT_5_HZ = 0.31 / 1000
_PLANNER_CORES = 0.011
_OTHERS_CORES = 0.135
_BUSY_SHARE = 3 / 4
"""Beyond this share of the cores ticks are late: none of them at 1.4 cores of 2, 10 % at 1.9."""
_FEW_AGENTS = 5
_PROCESS_BYTES = 31 << 20
_VEHICLE_BYTES = 100 << 10
_CELL_BYTES = 30
"""Of the terrain, which all processes share."""
_TREE_CELL_BYTES = 24
_RECORDING_BYTES_PER_MINUTE = 20 << 20
_MOST_BYTES = 1 << 60


@dataclass(frozen=True, slots=True)
class Machine:
    """What there is here; None where that is not known."""

    cores: int
    free_bytes: int | None
    disk_bytes: int | None


@dataclass(frozen=True, slots=True)
class Needs:
    """What a scenario is estimated to take.

    cores       that are busy all the time
    disk_bytes  in the folder of the run
    recording_bytes  of these, what is written while the run lasts
    """

    processes: int
    agents: int
    cores: float
    memory_bytes: int
    disk_bytes: int
    recording_bytes: int


def this_machine(runs: Path) -> Machine:
    there = next((path for path in (runs.absolute(), *runs.absolute().parents) if path.is_dir()), None)
    try:
        disk = None if there is None else shutil.disk_usage(there).free
    except OSError:
        disk = None
    return Machine(len(os.sched_getaffinity(0)), available_bytes(), disk)


def available_bytes() -> int | None:
    """Memory that new processes can have."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) << 10
    except (OSError, ValueError, IndexError):
        pass
    return None


def needs_of(scenario: Scenario, cells: int) -> Needs:
    """cells  of the terrain"""
    vehicles, ticks = scenario.vehicle_count, scenario.vehicles.tick_hz / 5
    agents = len(plan_agents(scenario))
    trees = len(scenario.target_ids) * (1 + scenario.standbys.planner)
    processes = len(processes_of(scenario))
    memory = (
        processes * _PROCESS_BYTES + vehicles * _VEHICLE_BYTES + cells * (_CELL_BYTES + trees * _TREE_CELL_BYTES)
    )
    recording = int(min(scenario.seconds / 60 * _RECORDING_BYTES_PER_MINUTE, _MOST_BYTES))
    return Needs(
        processes=processes,
        agents=agents,
        cores=ticks * (agents * _AGENT_CORES_AT_5_HZ + vehicles * _VEHICLE_CORES_AT_5_HZ)
        + trees * _PLANNER_CORES
        + _OTHERS_CORES,
        memory_bytes=memory,
        disk_bytes=cells * _CELL_BYTES + recording,
        recording_bytes=recording,
    )


def against(scenario: Scenario, needs: Needs, here: Machine, runs: Path) -> Iterator[Finding]:
    """Where the machine has less than a run needs."""
    if needs.cores > _BUSY_SHARE * here.cores:
        hz = scenario.vehicles.tick_hz
        fewer = " a larger vehicles.per_agent," if needs.agents > max(_FEW_AGENTS, 2 * here.cores) else ""
        yield warning(
            "vehicles",
            f"{scenario.vehicle_count:,} vehicles of {needs.agents} agents and {len(scenario.target_ids):,} targets"
            f" at {hz:g} Hz keep about {needs.cores:.1f} cores busy, and there are {here.cores}: ticks will be"
            f" late;{fewer} fewer of them, a lower vehicles.tick_hz, or more machines (docs/scale-figures.md)",
        )
    if here.free_bytes is not None and needs.memory_bytes > here.free_bytes:
        yield warning(
            "memory",
            f"about {size(needs.memory_bytes)} are needed and {size(here.free_bytes)} are free: a larger"
            " terrain.resolution_m, or fewer targets",
        )
    if here.disk_bytes is not None and needs.disk_bytes > here.disk_bytes:
        # One that is meant to be ended by Ctrl-C names a time that never comes.
        starts = needs.disk_bytes - needs.recording_bytes <= here.disk_bytes
        yield (warning if starts else failure)(
            "disk",
            f"about {size(needs.disk_bytes)} are written to {runs} and {size(here.disk_bytes)} are free: another"
            " --runs, or a shorter run",
        )
    yield from _writable(runs)


def _writable(runs: Path) -> Iterator[Finding]:
    for path in (runs.absolute(), *runs.absolute().parents):
        if path.is_dir():
            if not os.access(path, os.W_OK | os.X_OK):
                yield failure("runs", f"{path} cannot be written by this user; choose another --runs")
            return
        if path.exists():
            yield failure("runs", f"{path} is not a folder; choose another --runs")
            return
