"""Targets that no vehicle sees are searched for: vehicles drive on, apart from each other, until one sees them."""

from collections import Counter
from typing import Any

import numpy as np
from support.simulated import agents, vehicles

from launch_scripts.simulation.faults import Crash, FaultPlan
from launch_scripts.simulation.simulate import Simulation
from planner_service.service import PlannerService
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.load import parse_scenario
from swarm.wire.messages.planning import Sighted
from swarm.wire.messages.vehicles import VehicleState

_SCENARIO = """
name = "search"
seed = 6
time_scale = 10
terrain = { source = "synthetic", rows = 60, cols = 60, resolution_m = 10 }
targets = [{ name = "h", count = 1, speed_m_per_s = 1, tracker = "sighted" }]
groups = [{ vehicles = 3, start = "cluster" }]
vehicles = { per_agent = 3, sense_range_m = 40, capture_range_m = 15 }
"""


def test_a_target_that_was_never_seen_is_searched_for_captured_and_searched_for_again() -> None:
    scenario = parse_scenario(_SCENARIO)
    simulation = Simulation(scenario, terrain=terrain_of_pace(np.full((60, 60), 0.3, np.float32), 10.0))
    states: Counter[VehicleState] = Counter()
    apart = False
    searches = 0
    while simulation.now_s < 240.0 and searches < 2:
        simulation.run_until(simulation.now_s + 1.0)
        states.update(vehicle.state for vehicle in vehicles(simulation).values())
        planner: Any = simulation.nodes["planner-h"].service
        if planner is not None:
            target_search = planner._planner.target_search
            apart |= len(set(target_search.searcher.goals.values())) == 3
            searches = target_search.searches if simulation.recorder.observed.counts_by("captures_of") else 0
    assert searches >= 2, "it was not captured, or nobody searched for it after that"
    assert apart, "several vehicles look at one place"
    assert states[VehicleState.SEARCHING] > 10
    assert not states[VehicleState.STRANDED]


def test_a_planner_that_begins_anew_is_told_by_agents_where_its_target_was_last() -> None:
    blind = parse_scenario(_SCENARIO.replace("sense_range_m = 40", "sense_range_m = 0.5"))
    simulation = Simulation(
        blind,
        faults=FaultPlan(crashes=(Crash(8.0, "planner-h"),)),
        terrain=terrain_of_pace(np.full((60, 60), 0.3, np.float32), 10.0),
    )
    simulation.run_until(7.0)
    (agent,) = agents(simulation).values()
    now_ns = simulation.scheduler.clock.now_ns()
    seen = Sighted(
        author=agent._author, group=agent.agent.plan.group.name, target="h", seq=1,
        stamp_ns=now_ns - 40 * NS_PER_S, until_ns=now_ns - 10 * NS_PER_S,
        cell=1234, x_m=0.0, y_m=0.0, uncertainty_m=1.0,
    )  # fmt: skip
    agent._detector._last["h"] = seen
    before = simulation.nodes["planner-h"].service
    simulation.run_until(20.0)
    planner = simulation.nodes["planner-h"].service
    assert isinstance(planner, PlannerService)
    assert planner is not before
    search = planner._planner.target_search
    assert search.active
    assert search._remembered.cell == 1234
    assert search._begun_from is search._remembered
