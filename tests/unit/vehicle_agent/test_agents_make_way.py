"""Agents end to end on a simulated network, in crowds and corridors: they make way for each other."""

import pytest
from support.agent_world import OPEN, AgentWorld, pace_of, scenario

TWO_WAYS = """
seed = {seed}
targets = [{{ name = "west", walk = "still" }}, {{ name = "east", walk = "still" }}]
groups = [
    {{ name = "eastbound", vehicles = {count}, cells = {west_cells}, targets = ["east"] }},
    {{ name = "westbound", vehicles = {count}, cells = {east_cells}, targets = ["west"] }},
]
vehicles = {{ per_agent = {per_agent}, sense_range_m = 30.0, capture_range_m = {capture} }}
"""


@pytest.mark.parametrize("seed", range(4))
def test_a_corridor_with_one_passing_place_lets_two_pass_each_other(seed: int) -> None:
    corridor = ["#" * 21, "#" + "." * 19 + "#", "#" * 10 + "." + "#" * 10, "#" * 21]
    text = TWO_WAYS.format(seed=seed, count=1, west_cells=[[1, 2]], east_cells=[[1, 16]], per_agent=1, capture=10.0)
    world = AgentWorld(text, pace_of(corridor)).begin(west=(1, 1), east=(1, 19))
    world.arrive(120)


@pytest.mark.seeds(1)
def test_two_columns_pass_each_other_through_a_gap(seed: int) -> None:
    field = ["." * 9 + ("..." if row == 4 else "###") + "." * 9 for row in range(9)]
    west = [[row, col] for col in (1, 3) for row in (2, 4, 6)]
    east = [[row, 20 - col] for row, col in west]
    text = TWO_WAYS.format(seed=seed, count=6, west_cells=west, east_cells=east, per_agent=3, capture=25.0)
    world = AgentWorld(text, pace_of(field)).begin(west=(4, 2), east=(4, 18))
    world.arrive(300)


@pytest.mark.parametrize("seed", range(3))
def test_a_crowd_fits_around_its_target(seed: int) -> None:
    # 21 cells lie within 25 m of the target: room for all 16, if those in front move up.
    text = scenario(16, per_agent=4, capture=25.0).replace("seed = 3", f"seed = {seed}")
    world = AgentWorld(text, pace_of(OPEN)).begin(t=(10, 10))
    world.arrive(120)


def test_a_vehicle_that_has_arrived_in_a_corridor_moves_up_for_those_behind() -> None:
    corridor = ["#" * 16, "#" + "." * 14 + "#", "#" * 16]
    text = scenario(3, [(1, 5), (1, 3), (1, 1)], per_agent=1, capture=30.0)
    world = AgentWorld(text, pace_of(corridor)).begin(t=(1, 12))
    world.arrive(60)
