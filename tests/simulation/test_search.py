"""Targets that nobody sees are searched for: vehicles drive on, apart from each other, until one sees them."""

from __future__ import annotations

from collections import Counter

import numpy as np

from launch_scripts.simulation.simulate import Simulation
from planner_service.service import PlannerService
from shared_map.terrain.terrain import terrain_of_pace
from swarm.config.load import parse_scenario
from swarm.wire.messages.vehicles import VehicleState
from vehicle_agent.service import AgentService

_SCENARIO = """
name = "search"
seed = 6
time_scale = 10
[terrain]
source = "synthetic"
rows = 60
cols = 60
resolution_m = 10
[[targets]]
name = "h"
count = 1
speed_m_per_s = 1
tracker = "sighted"
[[groups]]
vehicles = 3
start = "cluster"
[vehicles]
per_agent = 3
sense_range_m = 40
capture_range_m = 15
"""


def test_a_target_that_was_never_seen_is_searched_for_captured_and_searched_for_again() -> None:
    scenario = parse_scenario(_SCENARIO)
    simulation = Simulation(scenario, terrain=terrain_of_pace(np.full((60, 60), 0.3, np.float32), 10.0))
    states: Counter[VehicleState] = Counter()
    apart = False
    searches = 0
    while simulation.now_s < 240.0 and searches < 2:
        simulation.run_until(simulation.now_s + 1.0)
        for node in simulation.nodes.values():
            if isinstance(node.service, AgentService):
                states.update(vehicle.state for vehicle in node.service.agent.vehicles.values())
            if isinstance(node.service, PlannerService):
                target_search = node.service._planner.target_search
                assert target_search is not None
                apart |= len(set(target_search.searcher.goals.values())) == 3
                searches = target_search.searches if simulation.recorder.observed.counts_by("captures_of") else 0
    assert searches >= 2, "it was not captured, or nobody searched for it after that"
    assert apart, "several vehicles look at one place"
    assert states[VehicleState.SEARCHING] > 10
    assert not states[VehicleState.STRANDED]
