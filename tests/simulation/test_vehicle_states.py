"""Vehicles of simulated runs go from state to state as the table says."""

import pytest
from support.vehicle_states import record, table

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.sample_worlds import world
from launch_scripts.simulation.simulate import Simulation

SECONDS = 8.0


@pytest.mark.parametrize(
    ("name", "seed"), [("small", 1), ("small", 4), pytest.param("rovers", 1, marks=pytest.mark.thorough)]
)
def test_simulated_vehicles_make_no_transition_but_those_of_the_table(
    name: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = record(monkeypatch)
    scenario, terrain = world(name, seed)
    Simulation(scenario, faults=random_plan(scenario, seed, SECONDS), terrain=terrain).run_until(SECONDS)
    assert made - table() == set()
    assert {event for _, event, _ in made} >= {"assign", "give_route"}
