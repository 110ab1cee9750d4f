"""A swarm that starts waits for no process that is there already."""

import pytest

from launch_scripts.simulation.sample_worlds import SMALL, seeded
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.simulated_process import Node
from vehicle_agent.service import AgentService

WITHIN_S = 1.3
"""Seats, a leader, a table on file, costs and routes are a tick of an agent each, and a claim may come to nothing
once."""


@pytest.mark.seeds(6)
def test_every_vehicle_has_a_route_soon_after_the_last_process_has_started_whatever_their_order(seed):
    simulation = Simulation(seeded(seed, SMALL))
    begun_s: list[float] = []
    simulation.after_boot.append(lambda node: begun_s.append(simulation.now_s))
    routed_s: dict[str, float] = {}

    def look(node: Node) -> None:
        if isinstance(node.service, AgentService) and node.name not in routed_s:
            agent = node.service.agent
            routed = [id for id, each in agent.vehicles.items() if each.route.left or each.in_reach]
            if set(routed) == set(agent.plan.vehicle_ids):
                routed_s[node.name] = simulation.now_s

    simulation.after_tick.append(look)
    simulation.run_until(3.0)
    agents = [name for name in simulation.nodes if name.startswith("agent-")]
    assert len(agents) >= 3
    assert routed_s.keys() == set(agents)
    assert max(routed_s.values()) - max(begun_s) < WITHIN_S
