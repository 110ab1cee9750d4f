"""The table of processes: the roles of a scenario, in the order in which they start and stop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import msgspec

from swarm.config.agents import plan_agents
from swarm.config.scenario import Scenario, ids_of
from swarm.liveness import ranked_id

Restart = Literal["always", "never"]

ROLES = ("router", "keeper", "monitor", "planner", "targets", "agent")
"""In order of start: each role finds what it needs, and the slowest to import starts early."""

STOP_ORDER = ("agent", "targets", "planner", "monitor", "keeper", "router")
"""Each role stops after those which still talk to it."""

EXPENDABLE = frozenset({"monitor"})
"""Roles without which a run goes on, whatever keeps them from starting."""

ENTRIES = {
    "router": "launch_scripts.launcher.router:run",
    "keeper": "shared_map.keeper.main:run",
    "monitor": "launch_scripts.monitor.main:run",
    "planner": "planner_service.main:run",
    "targets": "launch_scripts.simulation.world.main:run",
    "agent": "vehicle_agent.main:run",
}
"""`module:function` of each role's `run(setup, stop_when)`."""


NICENESS: Mapping[str, int] = {"router": 0, "agent": 0, "targets": 0, "planner": 5, "keeper": 10, "monitor": 10}
"""By how much less urgent each role is than the launcher, where the processor is short. A vehicle that is driven
late stands, and a target jumps; a route may come a little later, what is kept or shown much."""

RECORDED_BESIDE = "keeper-0"
"""The launcher that starts this process records and reports the run, and all others look after their own processes
only. Every plan of machines has one, and keeps it on the machine of its store."""


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One row of the table.

    entry    `module:function`, called as function(setup, stop_when)
    restart  whether it is started again when it crashes
    added    an operator's order started it: the run goes on without it, whatever keeps it from starting
    """

    role: str
    id: str
    entry: str
    restart: Restart = "always"
    added: bool = False

    @property
    def name(self) -> str:
        return f"{self.role}-{self.id}"


def processes_of(scenario: Scenario, roles: tuple[str, ...] = ROLES, rank: int | None = None) -> list[ProcessSpec]:
    """Processes of a scenario, restricted to `roles`, in order of start.

    rank  of planners and the targets process: only those of this rank; if None all, with those of rank 0 first
    """
    jobs: dict[str, list[str]] = {
        "router": ["0"],
        "keeper": ["0"],
        "monitor": ["0"],
        "planner": scenario.target_ids,
        "targets": ["0"],  # the referee also where all targets are external
        "agent": [plan.id for plan in plan_agents(scenario)],
    }
    standbys = {"planner": scenario.standbys.planner, "targets": scenario.standbys.targets}
    return [
        ProcessSpec(role, ranked_id(job, each), ENTRIES[role])
        for role in ROLES
        if role in roles
        for each in (range(standbys[role] + 1) if role in standbys else (0,))
        if rank in (None, each) or role not in standbys
        for job in jobs[role]
    ]


def planner_spec(id: str) -> ProcessSpec:
    """The planner of a target that was added while the swarm runs, or one of its standbys."""
    return ProcessSpec("planner", id, ENTRIES["planner"], added=True)


LAUNCHER = "launcher"
OPERATOR = "operator.0"
"""The name in the certificate of a launcher, and of the tools beside it."""


def certificate_name(scenario: Scenario, role: str, id: str) -> str:
    """The name in a process's certificate, by which a router knows it. An agent's contains its group, as what it
    writes does."""
    if role == LAUNCHER:
        return OPERATOR
    groups = {plan.id: plan.group.name for plan in plan_agents(scenario)} if role == "agent" else {}
    return f"{role}.{groups[id]}.{id}" if id in groups else f"{role}.{id}"


def certificate_names(scenario: Scenario) -> list[str]:
    """Every name that may take part in a run: its processes, the trackers of external targets, an operator, and
    those that the scenario admits beside them."""
    names = [certificate_name(scenario, spec.role, spec.id) for spec in processes_of(scenario)]
    external = [target for target in scenario.targets if target.walk == "external"]
    trackers = [f"tracker.{id}" for target in external for id in ids_of(target)]
    return list(dict.fromkeys([*names, *trackers, OPERATOR, *scenario.network.admit]))


def admitting_all(scenario: Scenario) -> Scenario:
    """The scenario whose router admits every name that may take part."""
    network = msgspec.structs.replace(scenario.network, admit=tuple(certificate_names(scenario)))
    return msgspec.structs.replace(scenario, network=network)
