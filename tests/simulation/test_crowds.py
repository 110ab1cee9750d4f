"""The whole swarm in dense traffic: no two vehicles meet, nobody waits for long, whoever crashes, is cut off or is
started twice."""

from __future__ import annotations

import pytest
from support.crowds import KINDS, crowd, rough_plan
from support.simulated_swarm import Laws, seeded

from launch_scripts.simulation.faults import Crash, FaultPlan, Partition
from launch_scripts.simulation.simulate import Node, Simulation
from swarm.wire.messages.vehicles import VehicleState
from vehicle_agent.service import AgentService

SECONDS = 16.0
LONGEST_WAIT_S = 10.0


class Waits:
    """The longest time that any vehicle stood on one cell while it had somewhere to go."""

    def __init__(self, simulation: Simulation) -> None:
        self.longest_s = 0.0
        self._simulation = simulation
        self._since: dict[str, tuple[int, float]] = {}
        simulation.after_tick.append(self._look)

    def _look(self, node: Node) -> None:
        now_s = self._simulation.now_s
        for vehicle in node.service.agent.vehicles.values() if isinstance(node.service, AgentService) else ():
            cell, since_s = self._since.get(vehicle.id, (-1, now_s))
            waits = vehicle.state in (VehicleState.FOLLOWING, VehicleState.WAITING)
            if cell != vehicle.cell or not waits:
                since_s = now_s
            self._since[vehicle.id] = (vehicle.cell, since_s)
            self.longest_s = max(self.longest_s, now_s - since_s)


@pytest.mark.parametrize("kind", KINDS)
def test_eight_agents_in_a_crowd_with_every_fault_at_once(kind):
    scenario, terrain = crowd(kind, 1, vehicles=100, per_agent=13, side=30)
    simulation = Simulation(scenario, faults=rough_plan(1, 8, 12.0), terrain=terrain)
    laws, waits = Laws(simulation), Waits(simulation)
    simulation.run_until(SECONDS)
    assert laws.collisions == laws.lethal == []
    assert waits.longest_s < LONGEST_WAIT_S
    services = [node.service for node in simulation.nodes.values() if isinstance(node.service, AgentService)]
    assert sum(len(service.agent.vehicles) for service in services) == 100
    assert simulation.report(SECONDS)["captures"] > 5


@pytest.mark.parametrize("seed", range(3))
def test_agents_of_three_vehicles_that_crash_all_the_time(seed):
    """As the dense runs did in which two vehicles met."""
    scenario, terrain = crowd("open", seed, vehicles=24, per_agent=3, side=16)
    crashes = tuple(Crash(3 + 0.9 * n, f"agent-a{(5 * n + seed) % 8}") for n in range(10))
    simulation = Simulation(scenario, faults=FaultPlan(jitter_ms=20, crashes=crashes), terrain=terrain)
    laws = Laws(simulation)
    simulation.run_until(14.0)
    assert laws.collisions == laws.lethal == []


@pytest.mark.parametrize("seed", range(4))
def test_of_two_lives_of_one_agent_the_older_stops_until_the_younger_is_gone_and_nobody_is_met(seed):
    """An agent is cut off, and started again on another machine; then the cut heals. Later that machine dies."""
    plan = FaultPlan(partitions=(Partition(5, 9, ("agent-a1",)),))
    simulation = Simulation(seeded(seed), faults=plan)
    meetings = []
    twins: list[Node] = []

    def look(node: Node) -> None:
        on: dict[int, str] = {}
        for each in (*simulation.nodes.values(), *twins):
            if isinstance(each.service, AgentService):
                for id, vehicle in each.service.agent.vehicles.items():
                    if on.setdefault(vehicle.cell, id) != id:
                        meetings.append((simulation.now_s, on[vehicle.cell], id))

    simulation.after_tick.append(look)
    simulation.run_until(8)
    twin = Node(simulation, simulation.nodes["agent-a1"].spec, 12345678, 0)
    twin.name = "replacement-a1"  # it runs on another machine, so it is not cut off, and finds no file
    twins.append(twin)
    twin.boot()
    simulation.run_until(22)
    older, younger = (node.service for node in (simulation.nodes["agent-a1"], twin))
    assert isinstance(older, AgentService)
    assert isinstance(younger, AgentService)
    assert meetings == []
    assert older.agent.vehicles == {}
    assert len(younger.agent.vehicles) == 4
    assert any(vehicle.state is not VehicleState.IDLE for vehicle in younger.agent.vehicles.values())
    twin.crash()  # for good: the older one takes over again
    simulation.run_until(25)
    before = {id: vehicle.cell for id, vehicle in older.agent.vehicles.items()}
    simulation.run_until(30)
    assert len(before) == 4
    assert sum(older.agent.vehicles[id].cell != cell for id, cell in before.items()) >= 2
    assert meetings == []


@pytest.mark.parametrize("skew_s", [-3600.0, 3600.0, -1_799_999_000.0])
def test_an_agent_that_starts_again_with_another_clock_is_like_any_other(skew_s):
    """An hour back, an hour forward, and in 1970."""
    simulation = Simulation(seeded(3), faults=FaultPlan(crashes=(Crash(6, "agent-a1"),)))
    laws = Laws(simulation)
    simulation.run_until(6.1)
    simulation.nodes["agent-a1"].skew_ns = int(skew_s * 1e9)
    simulation.run_until(8)
    service = simulation.nodes["agent-a1"].service
    assert isinstance(service, AgentService)
    before = {id: vehicle.cell for id, vehicle in service.agent.vehicles.items()}
    assert len(before) == 4
    simulation.run_until(12)
    assert all(vehicle.cell != before[id] for id, vehicle in service.agent.vehicles.items())
    assert laws.collisions == []
