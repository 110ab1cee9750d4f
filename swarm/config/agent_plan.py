"""Agent processes of a scenario, and the vehicles that each of them hosts."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from swarm.config.scenario import GroupConfig, Scenario
from swarm.errors import ConfigError
from swarm.peers import ranked_id


class AgentPlan(msgspec.Struct, frozen=True):
    """The vehicles that one agent process hosts: `count` of a group, from its `first` on."""

    id: str
    group: GroupConfig
    first: int
    count: int

    @property
    def vehicle_ids(self) -> list[str]:
        return [f"{self.id}-{n:02d}" for n in range(self.count)]


class AddedAgent(msgspec.Struct, frozen=True):
    """An agent that the run's scenario does not name.

    at  place near which its vehicles enter, as a target's `start`; anywhere if None
    """

    plan: AgentPlan
    at: tuple[int, int] | str | None = None


def added_agent(
    scenario: Scenario, id: str, group: str, count: int, at: tuple[int, int] | str | None = None
) -> AddedAgent:
    """Vehicles of a group of the scenario, beside those that it has. Raises ConfigError if that is impossible."""
    groups = {each.name: each for each in scenario.groups}
    if group not in groups:
        raise ConfigError(f"scenario {scenario.name} has no group {group!r}; it has {', '.join(groups)}")
    if any(plan.id == id for plan in plan_agents(scenario)):
        raise ConfigError(f"scenario {scenario.name} has an agent {id!r} itself: choose another name")
    if not 1 <= count <= scenario.vehicles.per_agent:
        most = scenario.vehicles.per_agent
        raise ConfigError(f"an agent hosts 1 to {most} vehicles (vehicles.per_agent), not {count}")
    return AddedAgent(AgentPlan(id, groups[group], 0, count), at)


def crew_of(scenario: Scenario) -> list[tuple[str, str]]:
    """(role, id) of the processes that a complete run needs, with each keeper that `network.admit` names. A router
    belongs to no run, and nothing waits for a monitor."""
    standbys = scenario.standbys
    names = (name.partition(".") for name in ("keeper.0", *scenario.network.admit))
    return [
        *dict.fromkeys((role, id) for role, _, id in names if role == "keeper"),
        *(("targets", ranked_id("0", rank)) for rank in range(standbys.targets + 1)),
        *(("planner", ranked_id(id, rank)) for rank in range(standbys.planner + 1) for id in scenario.target_ids),
        *(("places", ranked_id(id, rank)) for rank in range(standbys.planner + 1) for id in places_of(scenario)),
        *(("agent", plan.id) for plan in plan_agents(scenario)),
    ]


PLACE_TREES_BYTES = 256 << 20
"""Trees to places, of all classes, that one process keeps. Beside them one of each class is in hand."""


def place_trees_bytes(budget_bytes: int, classes: int, cells: int) -> int:
    """Bytes of trees to places that are kept for each of some classes: its share, but at least two whole trees;
    otherwise two distant askers would evict each other's for ever. One takes 5 bytes a cell, with its parents."""
    return max(budget_bytes // classes, 2 * 5 * cells)


def places_of(scenario: Scenario) -> list[str]:
    """The processes that plan between any two places: one for all groups which read the marks of the same groups,
    named after the first of them."""
    served = dict.fromkeys(place_job(scenario, group.name) for group in scenario.groups)
    return list(served) if scenario.planner.places else []


def place_job(scenario: Scenario, group: str) -> str:
    """The one of these processes which serves a group: it has marks of no other groups than the group reads."""
    reads = readable_groups(scenario, group)
    return next(each.name for each in scenario.groups if readable_groups(scenario, each.name) == reads)


def readable_groups(scenario: Scenario, group: str) -> frozenset[str] | None:
    """The groups whose marks and positions a group takes in: its own, and those that it reads and that write to it.
    None if that is all groups."""
    groups = {each.name: each for each in scenario.groups}
    mine = groups[group]
    readable = {
        other.name
        for other in scenario.groups
        if other.name == group or (_names(mine.reads, other.name) and _names(other.writes, group))
    }
    return None if readable == groups.keys() else frozenset(readable)


def _names(listed: Sequence[str], group: str) -> bool:
    return "*" in listed or group in listed


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
