"""Cores, memory and traffic of a swarm, and how many machines it needs, from a table of measured swarms
(`measured_runs.toml`). Pure.

This is the only estimate of what processes take: `swarm check`, plans of machines and launchers ask it, too.

Each figure of one process, such as the CPU of a planner, is interpolated between the measured runs: linear radial
functions over the logarithms of vehicles, targets, agents, side of the map and tick rate (scipy's RBFInterpolator).
They meet every measured run, and go on as a power law beyond the largest. A measured run that is left out of the
table is foretold to within 7 to 17 % at the median, by figure.

Agents and planners are placed in equal blocks; keeper, targets and monitor run on the first machine, whose launcher
records. Every router is linked with every other one. A message crosses once to each machine with a subscriber, so
the traffic into a machine is at most that of its processes, and at most that of all others.
"""

from __future__ import annotations

import math
import tomllib
from collections import defaultdict
from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from launch_scripts.process_table import LAUNCHER
from swarm.config.scenario import Scenario, plan_agents
from swarm.errors import ConfigError

USED_SHARE = 0.6
"""Usable share of the cores and the memory of a machine, and of one core by a process: beyond it work waits."""
LINK_SHARE = 0.5
"""Usable share of a link's capacity."""
OVERHEAD_BYTES = 100
"""Overhead of a message on a link: key, Zenoh's and TCP/IP's headers. Assumed, not measured."""
MOST_MACHINES = 2000
"""Machines that are tried one after another: bounds the time. Chosen, not measured."""
MOST_SESSIONS = 8192
"""`transport/unicast/max_sessions` of a router (swarm/bus/zenoh_config.py)."""
LEAST_SIDE = 32
"""Cells of a side: one tile of marks (`TILE_CELLS`)."""
_CELLS_PER_VEHICLE = 262.144
"""Same density as in the scenario `thousand`: 512 x 512 cells for 1,000 vehicles."""

_SINGLE = ("targets", "keeper", "monitor")
"""Roles of one process, all on the first machine."""
_SPREAD = ("agent", "planner")
"""Roles whose processes are shared out over all machines."""
_SMOOTHING = 0.1
"""Smoothing of the interpolation: two runs of nearly one size differ by other load of the machine."""
_FIGURES = ("cpu_ms_per_s", "memory_mb", "messages_in", "messages_out", "bytes_in", "bytes_out")
_RUNS = Path(__file__).with_name("measured_runs.toml")


class Swarm(msgspec.Struct, frozen=True, kw_only=True):
    """Size of a swarm: `side` of its square map (cells), `tick_hz` of agents and planners (ticks a second)."""

    vehicles: int
    targets: int
    agents: int
    side: int
    tick_hz: float


class Machine(msgspec.Struct, frozen=True):
    """A kind of machine."""

    cores: int
    memory_gb: float
    link_mbit_per_s: float


class Needs(msgspec.Struct, frozen=True, kw_only=True):
    """Needs of a swarm on a number of machines.

    cpu_cores        role -> cores of all its processes, all machines together
    process          role -> share of a core that one process takes; of launchers the one that records
    machine_cores    cores that work on each machine
    first_cores      on the first
    memory_gb, first_memory_gb  of each machine, of the first
    link_mbit_per_s, first_link_mbit_per_s  into each machine, and as much out of it; into the first
    sessions         of a machine's router
    """

    size: Swarm
    machines: int
    cpu_cores: dict[str, float]
    process: dict[str, float]
    machine_cores: float
    first_cores: float
    memory_gb: float
    first_memory_gb: float
    link_mbit_per_s: float
    first_link_mbit_per_s: float
    sessions: int


@cache
def measured_runs() -> dict[Swarm, dict[str, dict[str, float]]]:
    """The table of measured swarms: figure -> role -> what all its processes together took, as the head of the file
    says."""
    runs = tomllib.loads(_RUNS.read_text())["runs"]
    return {msgspec.convert(run, Swarm): {figure: run[figure] for figure in _FIGURES} for run in runs}


def reaches(swarm: Swarm) -> bool:
    """Returns True if no dimension of a swarm is larger than in all measured runs."""
    sides = ("vehicles", "targets", "agents", "side")
    return all(getattr(swarm, side) <= max(getattr(run, side) for run in measured_runs()) for side in sides)


def side_of(vehicles: int, cells: int | None) -> int:
    """Returns the side of a square map of `cells` cells; None: of the density of the measured ones."""
    if cells is not None:
        return math.isqrt(cells - 1) + 1
    return max(round(math.sqrt(_CELLS_PER_VEHICLE * vehicles)), LEAST_SIDE)


def swarm_of(scenario: Scenario, cells: int | None = None) -> Swarm:
    """Returns the size of a scenario's swarm, on a terrain of `cells` cells if that is known."""
    vehicles = max(scenario.vehicle_count, 1)
    targets, agents = max(len(scenario.target_ids), 1), max(len(plan_agents(scenario)), 1)
    side, tick_hz = side_of(vehicles, cells), scenario.vehicles.tick_hz
    return Swarm(vehicles=vehicles, targets=targets, agents=agents, side=side, tick_hz=tick_hz)


def processes_of_each(swarm: Swarm, standbys: int = 0) -> dict[str, int]:
    """Role -> number of its processes, with these standbys of each planner."""
    count = dict.fromkeys((*_SINGLE, *_SPREAD, "router", LAUNCHER), 1)
    return {**count, "agent": swarm.agents, "planner": swarm.targets * (1 + standbys)}


@cache
def one_process(swarm: Swarm) -> dict[str, dict[str, float]]:
    """Figure -> role -> what one process takes in a swarm of this size."""
    from scipy.interpolate import RBFInterpolator  # a launcher imports this module, and seldom asks

    runs = measured_runs()
    columns = [(figure, role) for figure, taken in next(iter(runs.values())).items() for role in taken]
    each = [
        [taken[figure][role] / processes_of_each(run)[role] for figure, role in columns]
        for run, taken in runs.items()
    ]
    places = np.array([msgspec.structs.astuple(size) for size in (*runs, swarm)], np.float64)
    *measured, here = np.log(places)
    between = RBFInterpolator(measured, np.log(each), kernel="linear", degree=1, smoothing=_SMOOTHING)
    found: dict[str, dict[str, float]] = defaultdict(dict)
    for (figure, role), value in zip(columns, np.exp(between([here])[0]).tolist(), strict=True):
        found[figure][role] = value
    return found


def needs_on(machines: int, swarm: Swarm, standbys: int = 0) -> Needs:
    """Returns the needs of a swarm on a number of machines, with these standbys of each planner."""
    spread, count, one = 1 / machines, processes_of_each(swarm, standbys), one_process(swarm)
    share = {role: one["cpu_ms_per_s"][role] / 1000 for role in count}

    def here(figure: str, *whole: str) -> float:
        """Sum over a machine's part of the processes that are shared out, and one process of each of `whole`."""
        shared = sum(one[figure][role] * count[role] * spread for role in _SPREAD)
        return shared + sum(one[figure][role] for role in whole)

    def enters(*whole: str) -> float:
        """Traffic into a machine from all others, Mbit/s."""
        messages, size = (
            (1 - spread)
            * min(here(f"{what}_in", *whole), sum(each * count[role] for role, each in one[f"{what}_out"].items()))
            for what in ("messages", "bytes")
        )
        return 8e-6 * (size + OVERHEAD_BYTES * messages)

    shared = here("cpu_ms_per_s") / 1000 + spread * share["router"]
    return Needs(
        size=swarm,
        machines=machines,
        cpu_cores={role: share[role] * count[role] for role in count},
        process={**share, "router": share["router"] * spread},
        machine_cores=shared + (share[LAUNCHER] if machines == 1 else 0.0),
        # A process takes one core at most, and falls behind.
        first_cores=shared + sum(min(share[role], 1.0) for role in (*_SINGLE, LAUNCHER)),
        memory_gb=here("memory_mb", "router", LAUNCHER) / 1000,
        first_memory_gb=here("memory_mb", "router", LAUNCHER, *_SINGLE) / 1000,
        link_mbit_per_s=enters(),
        # The launcher that records hears what the monitor hears.
        first_link_mbit_per_s=enters(*_SINGLE, "monitor"),
        sessions=math.ceil((count["agent"] + count["planner"]) * spread) + len(_SINGLE) + machines,
    )


def fewest_machines(machine: Machine, swarm: Swarm, standbys: int = 0) -> Needs:
    """The fewest machines of a kind that carry a swarm. Raises ConfigError if none suffice; it names the full
    resource."""
    machines = 1
    while machines <= MOST_MACHINES:
        found = needs_on(machines, swarm, standbys)
        full = [each for each in too_much(found, machine) if not each.startswith("one ")]
        if not full:
            return found
        machines += max(1, machines // 50)
    raise ConfigError(f"no number of machines up to {MOST_MACHINES} carries this swarm: {'; '.join(full)}")


def too_much(found: Needs, machine: Machine) -> list[str]:
    """Returns a sentence per resource beyond its limit. No further machine helps those that begin with "one"."""
    sentences = [
        f"one {role} process takes {share:.2f} of a core"
        for role, share in sorted(found.process.items(), key=lambda each: -each[1])
        if share > USED_SHARE and role != "router"
    ]
    limits = (
        ("cores", found.first_cores, USED_SHARE, machine.cores, ""),
        ("memory", found.first_memory_gb, USED_SHARE, machine.memory_gb, " GB"),
        ("link", found.first_link_mbit_per_s, LINK_SHARE, machine.link_mbit_per_s, " Mbit/s"),
        ("sessions of a router", found.sessions, 1.0, MOST_SESSIONS, ""),
    )
    return sentences + [
        f"{what}: {taken:,.1f} of {there:,g}{unit}"
        for what, taken, share, there, unit in limits
        if taken > share * there
    ]
