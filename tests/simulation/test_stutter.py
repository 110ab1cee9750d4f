"""Processes that are stopped anywhere within a call: no vehicles meet, and no report says that they did."""

from collections import defaultdict

import pytest

from launch_scripts.simulation.faults import FaultPlan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import crowd
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.simulated_process import Node
from vehicle_agent.service import AgentService

SECONDS = 12.0
DELAYS_MS = (0.2, 5.0, 20.0, 100.0)


def met(seed: int, delay_ms: float) -> tuple[int, int]:
    """Collisions in truth and by the referee's judgement, in a crowd whose processes are stopped."""
    scenario, terrain = crowd("open", seed, vehicles=24, per_agent=6, side=12)
    simulation = Simulation(scenario, faults=FaultPlan(delay_ms=delay_ms, stutter=0.02), terrain=terrain)
    book, ways = LawBook(simulation), defaultdict[str, set[int]](set)

    def look(node: Node) -> None:
        if isinstance(node.service, AgentService):
            for id, vehicle in node.service.agent.vehicles.items():
                ways[id].add(vehicle.cell)

    simulation.after_tick.append(look)
    simulation.run_until(SECONDS)
    assert sum(len(cells) > 1 for cells in ways.values()) > 12
    return len(book.collisions) + len(book.lethal), simulation.report(SECONDS)["collisions"]


@pytest.mark.seeds(8)
def test_no_vehicles_meet_and_none_are_said_to_wherever_processes_are_stopped(seed):
    assert met(seed + 1, DELAYS_MS[seed % len(DELAYS_MS)]) == (0, 0)
