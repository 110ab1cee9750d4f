"""The table of processes: the roles of a scenario, in the order in which they start and stop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from swarm.config.scenario import Scenario, plan_agents

Restart = Literal["always", "never"]

ROLES = ("router", "keeper", "monitor", "planner", "targets", "agent")
"""In order of start: each role finds what it needs, and the slowest to import starts early."""

STOP_ORDER = ("agent", "targets", "planner", "monitor", "keeper", "router")
"""Each role stops after those which still talk to it."""

ENTRIES = {
    "router": "launch_scripts.launcher.router:run",
    "keeper": "shared_map.keeper.main:run",
    "monitor": "launch_scripts.monitor.main:run",
    "planner": "planner_service.main:run",
    "targets": "launch_scripts.world.main:run",
    "agent": "vehicle_agent.main:run",
}
"""`module:function` of each role's `run(setup, stop_when)`."""


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One row of the table.

    entry    `module:function`, called as function(setup, stop_when)
    restart  whether it is started again when it crashes
    """

    role: str
    id: str
    entry: str
    restart: Restart = "always"

    @property
    def name(self) -> str:
        return f"{self.role}-{self.id}"


def processes_of(scenario: Scenario, roles: tuple[str, ...] = ROLES) -> list[ProcessSpec]:
    """Processes of a scenario, restricted to `roles`, in order of start."""
    ids: dict[str, list[str]] = {
        "router": ["0"],
        "keeper": ["0"],
        "monitor": ["0"],
        "planner": scenario.target_ids,
        "targets": ["0"] if any(target.walk != "external" for target in scenario.targets) else [],
        "agent": [plan.id for plan in plan_agents(scenario)],
    }
    return [ProcessSpec(role, id, ENTRIES[role]) for role in ROLES if role in roles for id in ids[role]]
