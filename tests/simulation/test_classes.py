"""Vehicles of several classes in one swarm: each drives by its own map, and all share what they find."""

from __future__ import annotations

import msgspec
import numpy as np
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from support.class_world import captures_by_class, made
from support.effort import few
from support.ordered_simulation import OrderedSimulation

from launch_scripts.simulation.campaign import nodes_of
from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.laws import LawBook
from shared_map.class_grounds import ClassGround, class_grounds
from shared_map.keeper.zone_orders import zones_of
from shared_map.terrain.terrain import build_truth
from swarm.config.agents import added_agent
from swarm.config.classes import ClassConfig, class_numbers
from swarm.config.load import parse_scenario
from swarm.errors import ConfigError
from swarm.wire.messages.orders import ZoneOrder
from vehicle_agent.placement import spawn_cells
from vehicle_agent.service import AgentService

SECONDS = 12.0
LONG_S = 20.0
"""Until somebody on foot has captured a target, too: rovers are there first."""
_TEXT = """
name = "mixed"
seed = 3
time_scale = 60.0
terrain = { source = "synthetic", rows = 64, cols = 64, relief_m = 500.0, hidden = { rubble_fields = 6 } }
cost = { max_slope_deg = 22.0 }
[[targets]]
count = 2
[[groups]]
name = "rovers"
vehicles = 8
[[groups]]
name = "walkers"
class = "walker"
vehicles = 8
[[classes]]
name = "walker"
max_speed_m_per_s = 2.0
sense_range_m = 40.0
accel_m_per_s2 = 1.0
turn_rate_deg_per_s = 120.0
cost = { slope_rule = "tobler", flat_speed_m_per_s = 1.8, road_speed_m_per_s = 2.0, max_slope_deg = 38.0 }
[vehicles]
per_agent = 4
sense_range_m = 60.0
capture_range_m = 30.0
"""


class Driven:
    """Where vehicles were, by class."""

    def __init__(self, simulation: OrderedSimulation) -> None:
        self.cells: dict[str, set[int]] = {}
        simulation.after_tick.append(lambda node: self._look(node.service))

    def _look(self, service: object) -> None:
        if isinstance(service, AgentService):
            cells = self.cells.setdefault(service.agent.plan.group.vehicle_class, set())
            cells.update(vehicle.cell for vehicle in service.agent.vehicles.values())


def grounds_of(simulation: OrderedSimulation) -> dict[str, ClassGround]:
    return class_grounds(simulation.scenario, simulation.terrain, simulation.truth)


def test_vehicles_of_two_classes_capture_and_none_enters_what_is_lethal_to_its_own() -> None:
    scenario, terrain = made(_TEXT)
    simulation = OrderedSimulation(scenario, terrain=terrain)
    trial, driven = LawBook(simulation), Driven(simulation)
    assert trial.run(LONG_S) == []
    report = simulation.report(LONG_S)
    assert report["lethal_entries"] == report["collisions"] == 0
    assert report["by_group"]["walkers"]["class"] == "walker"
    assert report["by_vehicle"]["a2-00"]["class"] == "walker"
    captures = captures_by_class(simulation)
    assert min(captures["ground"], captures["walker"]) > 0
    grounds = grounds_of(simulation)
    for name, cells in driven.cells.items():
        assert np.isfinite(grounds[name].truth.ravel()[sorted(cells)]).all()
    closed_to_rovers = np.isinf(grounds["ground"].terrain.ground_s_per_m).ravel()
    assert closed_to_rovers[sorted(driven.cells["walker"])].any(), "a walker goes where no rover could"


@settings(max_examples=few(6), deadline=None)
@given(
    seed=st.integers(0, 10**6),
    steepest=st.tuples(st.sampled_from([12.0, 22.0]), st.sampled_from([8.0, 17.0, 38.0])),
    radius_m=st.sampled_from([0.0, 20.0]),
    learning=st.booleans(),
    directional=st.booleans(),
)
def test_whatever_a_class_may_drive_and_whatever_goes_wrong_it_enters_nothing_else(
    seed: int, steepest: tuple[float, float], radius_m: float, learning: bool, directional: bool
) -> None:
    rules = {
        "500.0": "250.0",
        "22.0": f"{steepest[0]}, directional = {str(directional).lower()}",
        "38.0": f"{steepest[1]}, vehicle_radius_m = {radius_m}",
    }
    text = _TEXT
    for was, now in rules.items():
        text = text.replace(was, now)
    scenario = parse_scenario(f"{text}\n[map]\nlearning = {str(learning).lower()}")
    scenario = msgspec.structs.replace(scenario, seed=seed)
    simulation = OrderedSimulation(scenario, faults=random_plan(seed, nodes_of(scenario), 6.0))
    try:
        laws, driven = LawBook(simulation), Driven(simulation)
    except ConfigError:  # there are too few cells that so poor a class can drive
        reject()
    simulation.run_until(6.0)
    assert (laws.lethal, laws.collisions) == ([], [])
    grounds = grounds_of(simulation)
    for name, cells in driven.cells.items():
        own = grounds[name]
        assert np.isfinite(own.truth.ravel()[sorted(cells)]).all()
        assert np.isfinite(own.terrain.pace_s_per_m.ravel()[sorted(cells)]).all()


def test_a_class_with_the_values_of_ground_drives_as_ground_to_the_bit() -> None:
    scenario, terrain = made(_TEXT)
    rovers, walkers = scenario.groups
    tracks, following = [], []
    for name in ("ground", "same"):
        same = ClassConfig(name="same", cost=scenario.cost)
        own = msgspec.structs.replace(walkers, vehicle_class=name)
        given = msgspec.structs.replace(scenario, classes=(same,), groups=(rovers, own))
        simulation = OrderedSimulation(given, terrain=terrain)
        places: list[tuple[str, int, float]] = []
        simulation.after_tick.append(lambda node, places=places: places.extend(places_of(node.service)))  # type: ignore[misc]
        simulation.run_until(6.0)
        tracks.append(places)
        following.append(sum(each.following for each in simulation.recorder.observed.status.values()))
        told = simulation.report(6.0)["classes"]
        assert told == ({"ground": 16} if name == "ground" else {"ground": 8, "same": 8})
    assert tracks[0] == tracks[1]
    assert following[0] == following[1] > 8, "planners tell of the vehicles of all classes"
    assert len({cell for _, cell, _ in tracks[0]}) > 100


def places_of(service: object) -> list[tuple[str, int, float]]:
    if not isinstance(service, AgentService):
        return []
    return [(id, each.cell, each.motion.done_m) for id, each in service.agent.vehicles.items()]


def test_walkers_leave_a_zone_over_ground_that_no_rover_could_drive_and_more_of_them_join() -> None:
    scenario, terrain = made(_TEXT)
    spawns = spawn_cells(scenario, terrain.grid, class_grounds(scenario, terrain, build_truth(scenario, terrain)))
    steep = np.isinf(terrain.ground_s_per_m).ravel()
    stands = next(cell for agent in ("a2", "a3") for cell in spawns[agent].values() if steep[cell])
    row, col = terrain.grid.row_col(stands)
    corners = [(row + south, col + east) for south, east in ((-5, -5), (-5, 5), (5, 5), (5, -5))]
    zone = [(min(max(r, 0), 63), min(max(c, 0), 63)) for r, c in corners]
    simulation = OrderedSimulation(scenario, terrain=terrain)
    laws = LawBook(simulation)
    simulation.order(1.0, ZoneOrder(action="add", name="z", polygon=zone))
    simulation.run_until(2.0)
    walkers = [simulation.nodes[f"agent-{id}"].service for id in ("a2", "a3")]
    assert all(np.isinf(each._maps.own.pace_s_per_m.item(stands)) for each in walkers)  # type: ignore[union-attr]
    added = simulation.add(added_agent(scenario, "more", "walkers", 3))
    simulation.run_until(14.0)
    in_zone = np.zeros((64, 64), bool)
    in_zone[zone[0][0] + 1 : zone[2][0] - 1, zone[0][1] + 1 : zone[2][1] - 1] = True
    services = [node.service for node in simulation.nodes.values() if isinstance(node.service, AgentService)]
    places = {id: each.cell for service in services for id, each in service.agent.vehicles.items()}
    assert len(places) == 19
    assert not in_zone.ravel()[list(places.values())].any()
    assert (laws.lethal, laws.collisions) == ([], [])
    assert added.service.agent.plan.group.vehicle_class == "walker"  # type: ignore[union-attr]


def test_a_zone_for_walkers_is_left_by_walkers_and_says_nothing_to_rovers() -> None:
    scenario, terrain = made(_TEXT)
    simulation = OrderedSimulation(scenario, terrain=terrain)
    laws = LawBook(simulation)
    simulation.run_until(3.0)
    by_class = {"ground": ("a0", "a1"), "walker": ("a2", "a3")}

    def cells(name: str) -> list[int]:
        agents = [simulation.nodes[f"agent-{id}"].service for id in by_class[name]]
        return [each.cell for agent in agents for each in agent.agent.vehicles.values()]  # type: ignore[union-attr]

    row, col = terrain.grid.row_col(cells("walker")[0])
    corners = [(row + south, col + east) for south, east in ((-6, -6), (-6, 6), (6, 6), (6, -6))]
    zone = [(min(max(r, 0), 63), min(max(c, 0), 63)) for r, c in corners]
    order = ZoneOrder(action="add", name="z", polygon=zone, vehicle_class="walker")
    simulation.order(3.0, order)
    simulation.order(3.1, ZoneOrder(action="add", name="y", polygon=zone, vehicle_class="boat"))
    inside = np.zeros((64, 64), bool)
    inside[zone[0][0] + 1 : zone[2][0] - 1, zone[0][1] + 1 : zone[2][1] - 1] = True
    simulation.run_until(4.0)
    for name, agents in by_class.items():
        for id in agents:
            own = simulation.nodes[f"agent-{id}"].service._maps.own.pace_s_per_m  # type: ignore[union-attr]
            passable = np.isfinite(own[inside])
            assert not passable.any() if name == "walker" else passable.any()
    simulation.run_until(20.0)
    assert not inside.ravel()[cells("walker")].any()
    assert (laws.lethal, laws.collisions) == ([], [])
    keeper = next(each.service for id, each in simulation.nodes.items() if id.startswith("keeper"))
    zones = zones_of(keeper.replica, 0, class_numbers(scenario))  # type: ignore[union-attr]
    assert [(each.name, each.vehicle_class) for each in zones] == [("z", "walker")]
