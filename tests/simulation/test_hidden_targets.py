"""Targets that only vehicles see: a vehicle which stands at a target's old place and sees none there goes for
another."""

import numpy as np

from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.simulated_process import Node
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.load import parse_scenario
from vehicle_agent.service import AgentService

_SCENARIO = """
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


def test_nobody_stays_where_a_captured_target_was_that_nobody_sees_while_it_may_chase_another() -> None:
    scenario = parse_scenario(_SCENARIO)
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
