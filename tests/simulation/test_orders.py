"""Orders: what a keeper has acknowledged is obeyed by every process that starts later, until it is taken back."""

import random
from typing import Any

import numpy as np
import pytest
from support.simulated import OrderedSimulation, agents, cells, vehicles

from launch_scripts.simulation.faults import Crash, FaultPlan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import SMALL, seeded
from launch_scripts.simulation.simulate import Node
from launch_scripts.simulation.world.service import TargetsService
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.wire.messages.orders import GiveOrder, Obey, ZoneOrder
from swarm.wire.messages.vehicles import VehicleState
from vehicle_agent.service import AgentService

PAUSE, RESUME = GiveOrder(subject="pause"), GiveOrder(subject="pause", off=True)


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return build_terrain(SMALL)


def simulated(terrain: Terrain, faults: FaultPlan | None = None, seed: int = 1) -> OrderedSimulation:
    return OrderedSimulation(seeded(seed), faults=faults, terrain=terrain)


def target_cells(simulation: OrderedSimulation) -> dict[str, int]:
    (service,) = [n.service for n in simulation.nodes.values() if isinstance(n.service, TargetsService)]
    return {id: target.walker.cell for id, target in service._world._targets.items()}


@pytest.mark.parametrize(
    ("halt", "go_on"),
    [
        (PAUSE, RESUME),
        (
            GiveOrder(subject="set", name="time_scale", value=0.001),
            GiveOrder(subject="set", name="time_scale", off=True),
        ),
    ],
)
def test_a_pause_or_a_time_that_hardly_passes_stops_everything_until_it_is_taken_back(
    halt: GiveOrder, go_on: GiveOrder, terrain: Terrain
) -> None:
    simulation = simulated(terrain)
    simulation.order(6.0, halt)
    simulation.order(12.0, go_on)
    simulation.run_until(9.0)  # a step over slow ground, once begun, takes two seconds
    stood, targets = cells(simulation), target_cells(simulation)
    simulation.run_until(11.9)
    assert cells(simulation) == stood
    assert target_cells(simulation) == targets
    assert len(stood) == 10
    simulation.run_until(18.0)
    assert cells(simulation) != stood
    assert target_cells(simulation) != targets
    assert simulation.refused == []


def test_a_stopped_vehicle_stands_and_the_others_drive_on(terrain: Terrain) -> None:
    simulation = simulated(terrain)
    laws = LawBook(simulation)
    simulation.order(4.0, GiveOrder(subject="vehicle", name="a0-01"))
    simulation.run_until(7.0)
    before = cells(simulation)
    simulation.run_until(12.0)
    assert cells(simulation)["a0-01"] == before["a0-01"]
    assert sum(cells(simulation)[id] != cell for id, cell in before.items()) >= 5
    simulation.order(12.0, GiveOrder(subject="vehicle", name="a0-01", off=True))
    simulation.run_until(20.0)
    assert cells(simulation)["a0-01"] != before["a0-01"]
    assert laws.collisions == []


def test_an_added_target_is_chased_and_a_removed_one_leaves_no_one_lost(terrain: Terrain) -> None:
    simulation = simulated(terrain)
    laws = LawBook(simulation)
    row, col = divmod(_open(terrain), terrain.grid.cols)
    simulation.order(4.0, GiveOrder(subject="target", name="x", row=row, col=col, walk="still", new=True))
    simulation.run_until(12.0)
    assert simulation.refused == []
    assert "x" in {vehicle.target for vehicle in vehicles(simulation).values()}
    simulation.order(12.0, GiveOrder(subject="target", name="t0", off=True))
    simulation.run_until(20.0)
    assert {vehicle.target for vehicle in vehicles(simulation).values()} <= {"x", "t1"}
    states = {vehicle.state for vehicle in vehicles(simulation).values()}
    assert VehicleState.LOST not in states
    assert set(target_cells(simulation)) == {"x", "t1"}
    assert laws.collisions == []


def test_a_target_is_put_somewhere_else_and_stays_there_when_its_process_starts_again(terrain: Terrain) -> None:
    simulation = simulated(terrain)
    cell = _open(terrain)
    simulation.order(4.0, PAUSE)
    simulation.order(5.0, GiveOrder(subject="target", name="t1", cell=cell))
    simulation.run_until(8.0)
    assert target_cells(simulation)["t1"] == cell
    simulation.crash("targets-0")
    simulation.run_until(16.0)
    assert target_cells(simulation)["t1"] == cell


def test_who_takes_a_zone_for_over_as_its_clock_is_wrong_does_not_say_that_it_obeys(terrain: Terrain) -> None:
    simulation = simulated(terrain, FaultPlan(skews_ms={"agent-a0": 3.6e6, "agent-a1": -3.6e6}))
    corners: Any = [(5, 5), (5, 20), (20, 20), (20, 5)]
    simulation.order(3.0, ZoneOrder(action="add", name="z", polygon=corners, lasts_s=60.0))
    simulation.run_until(5.0)
    obey = {each.agent.plan.id: each._obeys(Obey(author="operator.z")) for each in agents(simulation).values()}
    assert obey == {"a0": False, "a1": True, "a2": True}
    simulation.order(5.0, ZoneOrder(action="remove", name="z"))
    simulation.run_until(7.0)
    assert all(each._obeys(Obey(author="operator.z")) for each in agents(simulation).values())


def _open(terrain: Terrain) -> int:
    """A passable cell in the middle of the terrain."""
    passable = np.flatnonzero(np.isfinite(terrain.pace_s_per_m))
    return int(passable[len(passable) // 2])


@pytest.mark.seeds(4)
def test_every_process_that_starts_after_an_acknowledged_pause_obeys_it(seed: int, terrain: Terrain) -> None:
    chance = random.Random(seed)
    # Only its planner knows a target's place when the process that moves it dies: not both are killed at once.
    names = ("agent-a0", "agent-a1", "agent-a2", "keeper-0", "targets-0")
    crashes = [Crash(8.0 + 4.0 * chance.random(), chance.choice(names)) for _ in range(10)]
    simulation = simulated(terrain, FaultPlan(crashes=tuple(crashes)), seed)
    simulation.order(5.0, PAUSE)
    simulation.run_until(8.0)
    assert simulation.book.paused
    stood = cells(simulation)
    moved: list[str] = []

    def look(node: Node) -> None:
        if isinstance(node.service, AgentService):
            for id, vehicle in node.service.agent.vehicles.items():
                if stood.setdefault(id, vehicle.cell) != vehicle.cell:
                    moved.append(f"{id} at {simulation.now_s:.2f}")

    targets = target_cells(simulation)
    simulation.after_tick.append(look)
    simulation.run_until(20.0)
    assert moved == []
    assert len(cells(simulation)) == 10, "every vehicle has found its place again"
    assert target_cells(simulation) == targets
    simulation.after_tick.remove(look)
    simulation.order(20.0, RESUME)
    simulation.run_until(26.0)
    assert cells(simulation) != stood
