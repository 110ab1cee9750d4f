"""Simulated swarms of several classes: their ground, made once, and who captured what."""

from __future__ import annotations

from collections import Counter
from functools import cache

from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.world.service import TargetsService
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.agents import agent_of, plan_agents
from swarm.config.load import parse_scenario
from swarm.config.scenario import Scenario
from swarm.runtime.stats import CAPTURES_BY


@cache
def made(text: str) -> tuple[Scenario, Terrain]:
    """A scenario of this text, and its terrain."""
    scenario = parse_scenario(text)
    return scenario, build_terrain(scenario)


def captures_by_class(simulation: Simulation) -> Counter[str]:
    """Class of vehicles -> how many targets they have captured; 0 of a class that has captured none."""
    targets = simulation.nodes["targets-0"].service
    assert isinstance(targets, TargetsService)
    classes = {plan.id: plan.group.vehicle_class for plan in plan_agents(simulation.scenario)}
    counts: Counter[str] = Counter(dict.fromkeys(classes.values(), 0))
    for vehicle, captures in targets.counters.counts_by[CAPTURES_BY].items():
        counts[classes[agent_of(vehicle)]] += captures
    return counts
