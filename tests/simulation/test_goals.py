"""A whole swarm whose vehicles are sent to places: by the real planner of places, with crashes of all processes."""

import random

import numpy as np
import pytest
from msgspec.structs import replace
from support.simulated import OrderedSimulation, cells, vehicles

from launch_scripts.simulation.faults import Crash, FaultPlan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import SMALL, seeded
from planner_service.route_finder import RouteFinder
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.scenario import Scenario
from swarm.wire.messages.orders import SendVehicle


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return build_terrain(SMALL)


def scenario(seed: int) -> Scenario:
    small = seeded(seed)
    return replace(small, planner=replace(small.planner, places=True))


def open_cells(terrain: Terrain, seed: int, count: int) -> list[int]:
    """Passable cells from which there is a way to the first of them."""
    passable = np.flatnonzero(np.isfinite(terrain.pace_s_per_m)).tolist()
    chance, cols = random.Random(seed), terrain.grid.cols
    first, *others = chance.sample(passable, 4 * count)
    finder = RouteFinder(terrain.pace_s_per_m, divmod(first, cols))
    reached = [cell for cell in others if finder.route(*divmod(cell, cols)).status == "ok"]
    return reached[:count]


def sent(terrain: Terrain, vehicle: str, *goals: int, **fields: str) -> SendVehicle:
    named = ["cell:{},{}".format(*divmod(cell, terrain.grid.cols)) for cell in goals]
    return SendVehicle(vehicle=vehicle, places=named, **fields)  # type: ignore[arg-type]


@pytest.mark.seeds(3)
def test_every_vehicle_gets_to_its_place_despite_any_crash(seed: int, terrain: Terrain) -> None:
    chance = random.Random(seed)
    names = ("agent-a0", "agent-a1", "keeper-0", "places-all")
    crashes = [Crash(6.0 + 10.0 * chance.random(), chance.choice(names)) for _ in range(5)]
    simulation = OrderedSimulation(
        scenario(seed), faults=FaultPlan(jitter_ms=10, crashes=tuple(crashes)), terrain=terrain
    )
    laws = LawBook(simulation)
    simulation.run_until(4.0)
    ids = sorted(vehicles(simulation))
    goals = dict(zip(ids, open_cells(terrain, seed, len(ids)), strict=True))
    for id, goal in goals.items():
        simulation.give(sent(terrain, id, goal))
    simulation.run_until(60.0)
    assert simulation.refused == []
    # Hidden obstacles make some places lethal in truth.
    open_now = {id for id, goal in goals.items() if np.isfinite(simulation.truth.reshape(-1)[goal])}
    there = cells(simulation)
    assert {id for id, goal in goals.items() if there[id] == goal} == open_now
    found = {each.name: (each.state, each.reason) for each in simulation.recorder.observed.goals()}
    lethal = "the place is lethal; the nearest open cell is cell:"
    assert {id: state for id, (state, _) in found.items()} == {
        id: "completed" if id in open_now else "blocked" for id in ids
    }
    assert all(reason.startswith(lethal) if state == "blocked" else not reason for state, reason in found.values())
    assert len(open_now) > len(ids) // 2
    assert laws.collisions == laws.lethal == []
