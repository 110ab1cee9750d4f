"""Agents end to end on a simulated network, in crowds and corridors: they make way for each other."""

import random

import pytest
from support.agent_world import OPEN, AgentWorld, pace_of, scenario
from support.swarm_model import LossyLinks

from shared_map.vehicle_class_grounds import class_grounds
from vehicle_agent.start_cells import spawn_cells

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


def maze(seed: int, size: int = 14) -> list[str]:
    """Ways one cell wide around pillars, with some of them walled up."""
    chance = random.Random(seed)
    return [
        "".join(
            "#" if (row % 2 and col % 2) or ((row % 2 or col % 2) and chance.random() < 0.25) else "."
            for col in range(size)
        )
        for row in range(size)
    ]


@pytest.mark.seeds(1)
def test_in_a_crowded_maze_no_one_is_stuck_for_long(seed: int) -> None:
    chance = random.Random(seed)
    text = scenario(24, per_agent=6, capture=15.0).replace('name = "t"\n', 'name = "t"\ncount = 3\n')
    world = AgentWorld(text, pace_of(maze(seed)), links=LossyLinks(seed, dropped=0.05, repeated=0.1, jitter_ms=150))
    grounds = class_grounds(world.scenario, world.terrain, world.truth)
    spawns = spawn_cells(world.scenario, world.terrain.grid, grounds)
    homes = sorted(cell for cells in spawns.values() for cell in cells.values())
    places = [world.terrain.grid.row_col(cell) for cell in homes]
    for target in world.scenario.target_ids:
        world.put_target(target, *chance.choice(places))
    world.start_all()
    stands_since: dict[str, tuple[tuple[int, int], int]] = {}
    longest_s = captures = 0
    for second in range(60):
        world.run(1.0)
        for target in world.scenario.target_ids:
            if any(v.target == target and v.in_reach for v in world.vehicles()):
                captures += 1
                world.put_target(target, *chance.choice(places), jumped=True)
        for id, place in world.where().items():
            if id not in stands_since or stands_since[id][0] != place:
                stands_since[id] = (place, second)
            longest_s = max(longest_s, second - stands_since[id][1])
    assert captures > 18
    assert longest_s < 30
    world.assert_lawful()
