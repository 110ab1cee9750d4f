"""Vehicles of several classes in one swarm: each drives by its own map, and all share what they find."""

from typing import Any

import msgspec
import numpy as np
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from support.effort import few
from support.simulated import WALKER, OrderedSimulation, agents, captures_by_class, cells, made, vehicles

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.simulate import Node
from shared_map.array_files import Bools
from shared_map.keeper.zone_orders import zones_of
from shared_map.vehicle_class_grounds import ClassGround, class_grounds
from swarm.config.scenario import added_agent
from swarm.config.scenario_files import parse_scenario
from swarm.config.vehicle_classes import ClassConfig, class_numbers
from swarm.errors import ConfigError
from swarm.wire.messages.orders import ZoneOrder

SECONDS = 12.0
LONG_S = 20.0
"""Long enough that a walker has captured a target, too: rovers are there first."""
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
[vehicles]
per_agent = 4
sense_range_m = 60.0
capture_range_m = 30.0
"""
_TEXT += WALKER


def driven_by(simulation: OrderedSimulation) -> dict[str, set[int]]:
    """Class -> the cells on which its vehicles are, from now on."""
    driven: dict[str, set[int]] = {"ground": set(), "walker": set()}

    def look(node: Node) -> None:
        for name, found in driven.items():
            found.update(cells(simulation, name).values())

    simulation.after_tick.append(look)
    return driven


def grounds_of(simulation: OrderedSimulation) -> dict[str, ClassGround]:
    return class_grounds(simulation.scenario, simulation.terrain, simulation.truth)


def test_vehicles_of_two_classes_capture_and_none_enters_what_is_lethal_to_its_own() -> None:
    scenario, terrain = made(_TEXT)
    simulation = OrderedSimulation(scenario, terrain=terrain)
    trial, driven = LawBook(simulation), driven_by(simulation)
    assert trial.run(LONG_S) == []
    report = simulation.report(LONG_S)
    assert report["lethal_entries"] == report["collisions"] == 0
    assert report["by_group"]["walkers"]["class"] == "walker"
    assert report["by_vehicle"]["a2-00"]["class"] == "walker"
    captures = captures_by_class(simulation)
    assert min(captures["ground"], captures["walker"]) > 0
    grounds = grounds_of(simulation)
    for name, found in driven.items():
        assert np.isfinite(grounds[name].truth.ravel()[sorted(found)]).all()
    closed_to_rovers = np.isinf(grounds["ground"].terrain.ground_s_per_m).ravel()
    assert closed_to_rovers[sorted(driven["walker"])].any(), "a walker goes where no rover could"


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
    simulation = OrderedSimulation(scenario, faults=random_plan(scenario, seed, 6.0))
    try:
        laws, driven = LawBook(simulation), driven_by(simulation)
    except ConfigError:  # there are too few cells that so poor a class can drive
        reject()
    simulation.run_until(6.0)
    assert (laws.lethal, laws.collisions) == ([], [])
    grounds = grounds_of(simulation)
    for name, found in driven.items():
        own = grounds[name]
        assert np.isfinite(own.truth.ravel()[sorted(found)]).all()
        assert np.isfinite(own.terrain.pace_s_per_m.ravel()[sorted(found)]).all()


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
        simulation.after_tick.append(
            lambda node, simulation=simulation, places=places: places.extend(  # type: ignore[misc]
                (id, each.cell, each.motion.done_m) for id, each in vehicles(simulation).items()
            )
        )
        simulation.run_until(6.0)
        tracks.append(places)
        following.append(sum(each.following for each in simulation.recorder.observed.status.values()))
        told = simulation.report(6.0)["classes"]
        assert told == ({"ground": 16} if name == "ground" else {"ground": 8, "same": 8})
    assert tracks[0] == tracks[1]
    assert following[0] == following[1] > 8, "planners tell of the vehicles of all classes"
    assert len({cell for _, cell, _ in tracks[0]}) > 100


def test_walkers_leave_zones_of_all_and_of_their_own_and_more_of_them_join() -> None:
    """One lies over ground that no rover could drive; a zone for walkers does not concern rovers."""
    scenario, terrain = made(_TEXT)
    simulation = OrderedSimulation(scenario, terrain=terrain)
    laws = LawBook(simulation)
    steep = np.isinf(terrain.ground_s_per_m).ravel()
    simulation.run_until(1.0)
    high = next(cell for cell in cells(simulation, "walker").values() if steep[cell])
    first = around(simulation, high)
    simulation.order(1.0, ZoneOrder(action="add", name="all", polygon=corners_of(first)))
    simulation.run_until(2.0)
    added = simulation.add(added_agent(scenario, "more", "walkers", 3))
    second = around(simulation, cells(simulation, "walker")["a3-00"])
    simulation.order(3.0, ZoneOrder(action="add", name="z", polygon=corners_of(second), vehicle_class="walker"))
    simulation.order(3.1, ZoneOrder(action="add", name="y", polygon=corners_of(second), vehicle_class="boat"))
    simulation.run_until(4.0)
    only_second = second & ~first
    for id, open in (("a0", True), ("a1", True), ("a2", False), ("a3", False)):
        own = agents(simulation)[f"agent-{id}"]._maps.own.pace_s_per_m
        assert np.isfinite(own[only_second]).any() == open
        assert np.isinf(own.item(high))
    simulation.run_until(20.0)
    assert len(cells(simulation)) == 19
    assert not first.ravel()[list(cells(simulation).values())].any()
    assert not second.ravel()[list(cells(simulation, "walker").values())].any()
    assert (laws.lethal, laws.collisions) == ([], [])
    assert added.service.agent.plan.group.vehicle_class == "walker"  # type: ignore[union-attr]
    keeper: Any = simulation.nodes["keeper-0"].service
    zones = zones_of(keeper.replica, 0, class_numbers(scenario))
    assert {(each.name, each.vehicle_class) for each in zones} == {("all", None), ("z", "walker")}


def around(simulation: OrderedSimulation, cell: int) -> Bools:
    """The cells at most five rows or columns from one."""
    found = np.zeros((64, 64), bool)
    row, col = divmod(cell, 64)
    found[max(row - 5, 0) : row + 5, max(col - 5, 0) : col + 5] = True
    return found


def corners_of(zone: Bools) -> Any:
    rows, cols = np.nonzero(zone)
    north, south, west, east = rows.min(), rows.max() + 1, cols.min(), cols.max() + 1
    return [(int(row), int(col)) for row, col in ((north, west), (north, east), (south, east), (south, west))]
