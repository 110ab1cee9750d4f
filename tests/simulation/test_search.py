"""Targets that no vehicle sees are searched for: vehicles drive on, apart from each other, until one sees them, and
none stays where a target is not."""

from collections import Counter
from typing import Any

import numpy as np
from support.simulated import agents, vehicles

from launch_scripts.simulation.faults import Crash, FaultPlan
from launch_scripts.simulation.simulate import Node, Simulation
from planner_service.service import PlannerService
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.scenario_files import parse_scenario
from swarm.wire.messages.planning import Sighted
from swarm.wire.messages.vehicles import VehicleState
from vehicle_agent.service import AgentService

_SCENARIO = """
name = "search"
seed = 6
time_scale = 10
terrain = { source = "synthetic", rows = 60, cols = 60, resolution_m = 10 }
targets = [{ name = "h", count = 1, speed_m_per_s = 1, tracker = "sighted" }]
groups = [{ vehicles = 3, start = "cluster" }]
vehicles = { per_agent = 3, sense_range_m = 40, capture_range_m = 15 }
"""
_OPEN = terrain_of_pace(np.full((60, 60), 0.3, np.float32), 10.0)


def test_a_target_that_was_never_seen_is_searched_for_captured_and_searched_for_again() -> None:
    simulation = Simulation(parse_scenario(_SCENARIO), terrain=_OPEN)
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


def test_a_planner_that_begins_again_is_told_by_agents_where_its_target_was_last() -> None:
    blind = parse_scenario(_SCENARIO.replace("sense_range_m = 40", "sense_range_m = 0.5"))
    simulation = Simulation(blind, faults=FaultPlan(crashes=(Crash(8.0, "planner-h"),)), terrain=_OPEN)
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


_PARTLY_HIDDEN = """
name = "hidden"
seed = 4
time_scale = 10
terrain = { source = "synthetic", rows = 40, cols = 40, resolution_m = 10 }
targets = [
    { name = "t", count = 1, speed_m_per_s = 1 }, { name = "h", count = 2, speed_m_per_s = 1, tracker = "sighted" },
]
groups = [{ vehicles = 8 }]
vehicles = { per_agent = 4, sense_range_m = 60, capture_range_m = 15 }
"""
_STAYS_S = 6.0
"""It takes 2 s to find that a place is empty, half a second to ask, and a little for the answers."""


def test_no_one_stays_where_a_captured_target_was_that_no_one_sees_while_it_may_chase_another() -> None:
    scenario = parse_scenario(_PARTLY_HIDDEN)
    terrain = terrain_of_pace(np.full((40, 40), 0.3, np.float32), 10.0)
    simulation = Simulation(scenario, terrain=terrain)
    since_s: dict[str, float] = {}
    """Vehicle -> since when it stands within reach of where a target was that it does not see."""
    longest_s = 0.0
    found_empty = set()

    def look(node: Node) -> None:
        nonlocal longest_s
        if not isinstance(node.service, AgentService):
            return
        agent, now_s = node.service.agent, simulation.now_s
        for vehicle in agent.vehicles.values():
            target = vehicle.target
            tracking = None if target is None else agent._trackings.of(target)
            age_ns = None if tracking is None else tracking.age_ns(node.now_ns())
            if target in scenario.untracked and vehicle.in_reach and age_ns is not None and age_ns > NS_PER_S:
                found_empty.add(target)
                longest_s = max(longest_s, now_s - since_s.setdefault(vehicle.id, now_s))
            else:
                since_s.pop(vehicle.id, None)

    simulation.after_tick.append(look)
    simulation.run_until(20.0)
    captures = simulation.recorder.observed.counts_by("captures_of")
    assert found_empty.intersection(captures), "no hidden target was captured and left unseen: nothing is tried"
    assert longest_s < _STAYS_S
