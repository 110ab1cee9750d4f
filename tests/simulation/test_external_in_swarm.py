"""A vehicle that is not in the scenario, among the services of a whole swarm."""

import random
from typing import Any

from support.simulated import ExternalVehicle, OrderedSimulation, cells

from launch_scripts.simulation.sample_worlds import crowd, seeded
from launch_scripts.simulation.simulate import Node
from swarm.bus.bus import Event, Replied
from swarm.config.scenario import added_agent
from swarm.wire.messages.orders import ZoneOrder
from swarm.wire.messages.vehicles import Obstacle, Removed, RemoveVehicles
from swarm.wire.topics import LEAVE, OBSTACLE
from vehicle_agent.agent import Agent
from vehicle_agent.service import AgentService


def drive(simulation: OrderedSimulation, seconds: float) -> None:
    """Drives on, and looks that all vehicles are on cells of their own."""
    end_s = simulation.now_s + seconds
    while simulation.now_s < end_s:
        simulation.run_until(simulation.now_s + 0.1)
        assert len(places(simulation)) == len(set(places(simulation)))


def places(simulation: OrderedSimulation) -> list[int]:
    return list(cells(simulation).values())


def test_an_external_vehicle_must_not_have_the_name_of_an_agent() -> None:
    simulation = OrderedSimulation(seeded(3))
    simulation.run_until(2)
    rover = ExternalVehicle(simulation, "a0", 5, random.Random(1), [])
    rover.boot()
    simulation.run_until(4)
    assert rover.service.external is None
    assert rover.warnings == ["a0 is an agent of this run's scenario: an external vehicle needs another name"]


def test_vehicles_are_added_killed_found_again_and_removed_and_no_one_meets_anybody() -> None:
    simulation = OrderedSimulation(seeded(4))
    simulation.run_until(3)
    group = simulation.scenario.groups[0].name
    here = simulation.terrain.grid.row_col(places(simulation)[0])
    node = simulation.add(added_agent(simulation.scenario, "extra", group, 3, here))
    drive(simulation, 8)
    agent = agent_of_node(node)
    assert sorted(agent.vehicles) == ["extra-00", "extra-01", "extra-02"]
    assert any(vehicle.target for vehicle in agent.vehicles.values())
    before = {id: vehicle.cell for id, vehicle in agent.vehicles.items()}
    drive(simulation, 5)
    assert any(vehicle.cell != before[id] for id, vehicle in agent.vehicles.items())
    assert set(before) <= set(simulation.recorder.observed.vehicles().ids)  # observers see them

    simulation.crash(node.name)
    drive(simulation, 5)
    agent = agent_of_node(node)
    assert sorted(agent.vehicles) == sorted(before)
    asked: list[Removed] = []

    def hear(event: Event) -> None:
        if isinstance(event, Replied) and isinstance(event.message, Removed):
            asked.append(event.message)

    bus = simulation.network.bus("operator", simulation.scenario.network.namespace, simulation.authenticator)
    one, other = "extra-01", next(iter(agent_of_node(simulation.nodes["agent-a0"]).vehicles))
    bus.ask(LEAVE, RemoveVehicles(vehicles=[one]), hear, tag="x", agent="extra")
    bus.ask(LEAVE, RemoveVehicles(vehicles=[other, "nobody"]), hear, tag="x", agent="a0")
    drive(simulation, 2)
    assert [each.left for each in asked] == [[one], [other]]
    assert asked[1].unknown == ["nobody"]
    assert one not in agent.vehicles
    simulation.crash("agent-a0")
    drive(simulation, 5)
    restarted = simulation.nodes["agent-a0"]
    assert other not in agent_of_node(restarted).vehicles
    assert restarted.service.lacks() == []
    bus.ask(LEAVE, RemoveVehicles(), hear, tag="x", agent="extra")
    drive(simulation, 2)
    assert node.service.over  # type: ignore[attr-defined]
    bus.ask(LEAVE, RemoveVehicles(), hear, tag="x", agent="extra")
    drive(simulation, 0.5)
    assert asked[-1].held == 0


def test_vehicles_are_added_beside_an_obstacle_and_outside_of_a_zone_where_their_place_is_closed() -> None:
    scenario, terrain = crowd("open", 1, vehicles=8, per_agent=4, side=20)
    simulation = OrderedSimulation(scenario, terrain=terrain)
    zone: Any = [(6, 6), (6, 14), (14, 14), (14, 6)]
    simulation.order(2.0, ZoneOrder(action="add", name="z", polygon=zone))
    bus = simulation.network.bus("walker", scenario.network.namespace, simulation.authenticator)
    group = scenario.groups[0].name
    for tick in range(80):
        # In the middle of cell [17, 17].
        report = Obstacle(id="walker", incarnation=1, seq=tick, x_m=175.0, y_m=-175.0, radius_m=3.0)
        bus.publish(OBSTACLE, report, id="walker")
        if tick == 20:
            nodes = [
                simulation.add(added_agent(scenario, f"extra{n}", group, 1, place))
                for n, place in enumerate([(17, 17), (10, 10)])
            ]
        drive(simulation, 0.1)
        if tick > 20:
            for node in nodes:
                for vehicle in agent_of_node(node).vehicles.values():
                    row, col = terrain.grid.row_col(vehicle.cell)
                    assert (row, col) != (17, 17)
                    assert not (6 <= row < 14 and 6 <= col < 14)
    assert all(agent_of_node(node).vehicles for node in nodes)


def agent_of_node(node: Node) -> Agent:
    assert isinstance(node.service, AgentService)
    return node.service.agent
