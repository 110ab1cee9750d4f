"""Which agent processes a scenario has, and which vehicles each of them hosts."""

from __future__ import annotations

import msgspec

from swarm.config.scenario import GroupConfig, Scenario


class AgentPlan(msgspec.Struct, frozen=True):
    """The vehicles that one agent process hosts: `count` of a group, from its `first` on."""

    id: str
    group: GroupConfig
    first: int
    count: int

    @property
    def vehicle_ids(self) -> list[str]:
        return [f"{self.id}-{n:02d}" for n in range(self.count)]


def agent_of(vehicle: str) -> str:
    """The agent that hosts a vehicle, by the vehicle's id; one whose id names no agent is its own."""
    return vehicle.rpartition("-")[0] or vehicle


def plan_agents(scenario: Scenario) -> list[AgentPlan]:
    """The agent processes of a scenario. An agent serves one group."""
    agents: list[AgentPlan] = []
    for group in scenario.groups:
        for first in range(0, group.vehicles, scenario.vehicles.per_agent):
            count = min(scenario.vehicles.per_agent, group.vehicles - first)
            agents.append(AgentPlan(f"a{len(agents)}", group, first, count))
    return agents
