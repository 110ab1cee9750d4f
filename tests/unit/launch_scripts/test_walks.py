"""Targets and rovers of the simulation."""

import itertools
import math
import random
from functools import partial

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import slow_twins as naive
from support.planner_swarm import rough
from support.target_reports import RES, flat

from launch_scripts.process_table import processes_of
from launch_scripts.simulation.world.rovers import Rovers
from launch_scripts.simulation.world.walks import (
    WALKS,
    Budget,
    TrueTerrain,
    Walker,
    WalkWorld,
    Waypoints,
    far_place,
    slowness_of,
)
from shared_map.terrain.slope_and_climb import climb_of
from swarm.clock import NS_PER_S
from swarm.config.ground import CostConfig
from swarm.config.scenario import TargetConfig, Walk
from swarm.config.scenario_files import parse_scenario
from swarm.errors import TerrainError
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Obstacle
from vehicle_agent.traffic.obstacles import REACTION_S, capsule_of

NOBODY = np.empty(0, np.int64)
MOVING = [walk for walk in WALKS if walk not in ("still", "external")]


def terrain(pace: NDArray[np.float32]) -> TrueTerrain:
    rows, cols = pace.shape
    return TrueTerrain(GridSpec(rows, cols, RES), pace)


def walker(
    where: TrueTerrain,
    cell: int,
    walk: Walk,
    slowness: float = 1.0,
    seed: int = 1,
    budget: Budget | None = None,
) -> Walker:
    world = WalkWorld("t", where, random.Random(seed), budget or Budget())
    return Walker(where, WALKS[walk](world), slowness, cell)


@pytest.mark.parametrize("walk", MOVING)
def test_no_target_takes_a_step_that_is_too_steep_and_none_outruns_the_climb(walk: Walk) -> None:
    """Terraces, each of which may be left downhill only."""
    heights = np.repeat(np.arange(6, dtype=np.float32) * 0.6 * RES, 5)[:, None] + np.zeros((30, 34), np.float32)
    climb = climb_of(
        GridSpec(30, 34, RES), heights, CostConfig(directional=True, max_climb_deg=20, max_slope_deg=50)
    )
    assert climb is not None
    where = TrueTerrain(GridSpec(30, 34, RES), rough(3, 0.1, 30, 34), climb)
    one = walker(where, where.nearest(29 * 34 + 15), walk)
    downhill = 0
    for _ in range(1500):
        before = one.cell
        one.towards = one.towards or one.walk.choose(before, np.array([before - 34]))
        if one.towards is None:
            continue
        assert climb.allows(before, one.towards)
        level_s = where.length_m(before, one.towards) * where.pace_s_per_m.item(one.towards)
        elapsed_s = level_s * climb.of_step(before, one.towards) * 1.0001
        one.advance(elapsed_s, partial(np.array, [before - 34]))
        assert one.cell != before
        downhill += heights.flat[one.cell] < heights.flat[before]
    assert walk == "evade" or downhill > 0


def test_the_largest_part_is_what_legal_steps_connect() -> None:
    pace = flat(4, 6)
    pace[:, 3] = np.inf
    pace[0, 2] = pace[1, 3] = np.inf
    pace[1, 3] = np.inf
    assert terrain(pace).home.tolist() == [0, 1, 6, 7, 8, 12, 13, 14, 18, 19, 20]


def test_no_one_squeezes_past_the_corner_of_a_lethal_cell() -> None:
    pace = flat(2, 2)
    pace[0, 1] = np.inf
    assert terrain(pace).step(0, 3) is None
    assert terrain(pace).step(0, 4) == 2
    pace[1, 0] = np.inf
    assert len(terrain(pace).home) == 1


def test_a_terrain_without_a_passable_cell_is_refused() -> None:
    with pytest.raises(TerrainError, match="every cell of the terrain is lethal"):
        terrain(np.full((3, 3), np.inf, np.float32))


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.sampled_from(MOVING))
def test_every_step_of_every_walk_is_legal(seed: int, walk: Walk) -> None:
    where = terrain(rough(seed, 0.3, 30, 34))
    one = walker(where, where.random_home(random.Random(seed)), walk, seed=seed)
    vehicles = where.home[:3]
    for _ in range(80):
        before, heading_to = one.cell, one.towards
        one.advance(3.0, lambda: vehicles)
        if one.towards is not None:
            assert one.towards in [to for _, to in where.steps(one.cell)]
        assert not where.lethal(one.cell)
        if one.cell != before and heading_to is not None:
            assert heading_to in [to for _, to in where.steps(before)]


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000))
def test_a_way_is_the_cheapest_there_is(seed: int) -> None:
    where = terrain(rough(seed, 0.3, 12, 14))
    start = where.random_home(random.Random(seed))
    way = where.way(start, random.Random(seed))
    cost, at = 0.0, start
    for cell in way:
        assert cell in [to for _, to in where.steps(at)]
        cost += where.length_m(at, cell) * float(where.pace_s_per_m.flat[cell])
        at = cell
    # Ways from a cell are ways to it turned round, on which a step has the pace of the cell that it leaves.
    costs = naive.cost_to_go(where.pace_s_per_m, start, left_share=1.0)
    assert cost == pytest.approx(RES * costs.flat[at])


@pytest.mark.parametrize(
    ("speed", "pace", "metres"),
    [
        (4.0, 0.1, 40.0),
        (4.0, 0.4, 10.0),
        (4.0, 0.05, 80.0),
        (10.0, 0.1, 100.0),
        (50.0, 0.1, 100.0),
        (0.0, 0.1, 0.0),
    ],
)
def test_ten_seconds_of_driving(speed: float, pace: float, metres: float) -> None:
    """At 10 m/s on level ground: a target's own speed there, as much slower on slow ground, never outrunning it."""
    where = terrain(np.full((1, 40), pace, np.float32))
    config = TargetConfig(speed_m_per_s=speed)
    one = walker(where, 0, "waypoints", slowness_of(config, CostConfig(flat_speed_m_per_s=10.0)))
    assert isinstance(one.walk, Waypoints)
    one.walk.way, one.walk.led_to = list(range(39, 0, -1)), 0
    for _ in range(100):
        one.advance(0.1, lambda: NOBODY)
    x_m, _ = one.position_m()
    assert x_m - 5.0 == pytest.approx(metres, abs=1e-4)


def test_an_evader_gets_away_from_the_vehicles_near_it() -> None:
    where = terrain(flat())
    grid = where.grid
    one = walker(where, grid.cell(20, 25), "evade")
    vehicles = np.array([grid.cell(20, 22), grid.cell(18, 23)])
    one.advance(8.0, lambda: vehicles)
    assert min(grid.distance_cells(one.cell, cell) for cell in vehicles.tolist()) >= 7


def test_ways_are_computed_one_a_tick() -> None:
    where = terrain(flat())
    budget = Budget()
    walkers = [walker(where, 100 * n, "waypoints", budget=budget) for n in range(4)]
    for ticked in range(1, 5):
        budget.ways = 1
        for one in walkers:
            one.advance(0.1, lambda: NOBODY)
        assert sum(1 for one in walkers if one.towards is not None) == ticked


def test_a_jump_leads_far_away_and_clear_of_vehicles() -> None:
    where = terrain(flat())
    grid = where.grid
    vehicles = np.array([grid.cell(row, 40) for row in range(40)])
    for seed in range(50):
        place = far_place(where, grid.cell(20, 10), vehicles, 3, random.Random(seed))
        row, col = grid.row_col(place)
        assert math.hypot(row - 20, col - 10) >= math.hypot(40, 50) / 4
        assert abs(col - 40) > 3


# --- simulated rovers ---------------------------------------------------------------------------------------------

GRID = GridSpec(30, 30, 10.0)
TICK = NS_PER_S // 10
TEXT = """
seed = 4
time_scale = 2
[[rovers]]
count = 6
speed_m_per_s = 3
radius_m = 2
"""


def ground() -> TrueTerrain:
    pace = np.full((30, 30), 0.1, np.float32)
    pace[10:12, 5:25] = np.inf
    return TrueTerrain(GRID, pace)


SCENARIO = parse_scenario(TEXT)


def driven(rovers: Rovers, seconds: float, time_scale: float = 2.0) -> list[dict[str, Obstacle]]:
    """The last pose of each rover, tick by tick."""
    told: dict[str, Obstacle] = {}
    ticks = []
    for tick in range(int(seconds * 10)):
        told |= {obstacle.id: obstacle for obstacle in rovers.tick(time_scale, tick * TICK)}
        ticks.append(dict(told))
    return ticks


def test_a_rover_is_always_where_its_last_word_said_that_it_would_be() -> None:
    ticks = driven(Rovers(SCENARIO, ground(), 1), 60.0)
    moved = 0
    for before, after in itertools.pairwise(ticks):
        for id, obstacle in after.items():
            said = before[id]
            reach = capsule_of(said, GRID, said.speed_m_per_s * REACTION_S, margin_m=0.01)
            far_m = math.hypot(obstacle.x_m - said.x_m, obstacle.y_m - said.y_m)
            moved += far_m > 0
            assert far_m <= math.hypot(reach.east_m, reach.north_m) + 1e-6
            along = (obstacle.x_m - said.x_m) * reach.north_m - (obstacle.y_m - said.y_m) * reach.east_m
            assert abs(along) < 1e-6 * max(far_m, 1.0) * max(math.hypot(reach.east_m, reach.north_m), 1.0)
    assert moved > 1000


def test_rovers_keep_to_the_ground_and_stop_at_times() -> None:
    terrain = ground()
    ticks = driven(Rovers(SCENARIO, terrain, 1), 60.0)
    obstacles = [obstacle for told in ticks for obstacle in told.values()]
    assert not any(
        terrain.lethal(int(-obstacle.y_m // 10) * 30 + int(obstacle.x_m // 10)) for obstacle in obstacles
    )
    assert {obstacle.speed_m_per_s for obstacle in obstacles} == {0.0, 6.0}


def test_one_that_takes_over_goes_on_from_where_the_other_was() -> None:
    ticks = driven(Rovers(SCENARIO, ground(), 1), 20.0)
    second = Rovers(SCENARIO, ground(), 2)
    for obstacle in ticks[-1].values():
        second.note_obstacle(obstacle)
    second.note_obstacle(msgspec.structs.replace(ticks[-1]["r0"], id="nobody"))
    for id, obstacle in driven(second, 0.1)[0].items():
        last = ticks[-1][id]
        assert (obstacle.x_m, obstacle.y_m) == (last.x_m, last.y_m)
        assert (obstacle.incarnation, obstacle.seq) == (2, 1)


def test_rovers_stand_while_the_run_is_paused() -> None:
    ticks = driven(Rovers(SCENARIO, ground(), 1), 3.0, time_scale=0.0)
    assert {(obstacle.x_m, obstacle.y_m, obstacle.speed_m_per_s) for obstacle in ticks[-1].values()} == {
        (obstacle.x_m, obstacle.y_m, 0.0) for obstacle in ticks[0].values()
    }


def test_rovers_need_the_process_that_moves_them() -> None:
    external = parse_scenario(TEXT + '[[targets]]\nwalk = "external"\n')
    assert any(spec.role == "targets" for spec in processes_of(external))
