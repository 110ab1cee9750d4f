"""Vehicles drive although every message is late: slower, but they are granted cells at any delay to a second. Where
processes are stopped anywhere within a call, no vehicles meet, and no report says that they did."""

from collections import defaultdict

import pytest
from support.simulated import cells

from launch_scripts.simulation.faults import FaultPlan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import crowd, world
from launch_scripts.simulation.simulate import Node, Simulation
from vehicle_agent.service import AgentService


def drive(delay_ms: float, until_s: float, jitter_ms: float) -> tuple[Simulation, LawBook, int]:
    """Returns the simulation, its laws and the steps of all vehicles from the eighth second on."""
    scenario, terrain = world("small", 3)
    simulation = Simulation(scenario, faults=FaultPlan(delay_ms=delay_ms, jitter_ms=jitter_ms), terrain=terrain)
    laws, entered = LawBook(simulation), 0
    simulation.run_until(8.0)
    before = cells(simulation)
    while simulation.now_s < until_s:
        simulation.run_until(simulation.now_s + 0.1)
        after = cells(simulation)
        entered += sum(before.get(id) != cell for id, cell in after.items())
        before = after
    return simulation, laws, entered


@pytest.mark.parametrize(
    ("delay_ms", "jitter_ms", "until_s", "least", "is_slow"),
    [
        (50.0, 0.0, 10.0, 1, False),
        (200.0, 0.0, 20.0, 22, True),  # without delay they enter 220
        pytest.param(400.0, 0.0, 20.0, 22, True, marks=pytest.mark.thorough),
        (600.0, 0.0, 20.0, 22, True),
        (1000.0, 0.0, 28.0, 1, None),
        pytest.param(150.0, 450.0, 20.0, 21, None, marks=pytest.mark.thorough),
    ],
)
def test_a_swarm_whose_messages_are_all_late_drives_and_says_so_where_they_are_slow(
    delay_ms: float, jitter_ms: float, until_s: float, least: int, is_slow: bool | None
) -> None:
    simulation, laws, entered = drive(delay_ms, until_s, jitter_ms)
    assert entered >= least
    assert laws.collisions == laws.lethal == []
    notes = [note.text for _, note in simulation.recorder.notes if note.kind == "slow_link"]
    assert is_slow in (None, bool(notes))
    assert all("answers slowly" in text for text in notes)


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
