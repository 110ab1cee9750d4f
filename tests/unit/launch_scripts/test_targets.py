"""Targets: where they start, how they move, when they are captured, and what the service tells of it."""

import itertools
import math
import random
from dataclasses import replace
from functools import partial
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import slow_twins as naive
from support.makers import target_pose
from support.planner_swarm import Ear, rough
from support.swarm_model import SwarmModel
from support.target_reports import RES, flat, fleet

from launch_scripts.simulation.world.rovers import Rovers
from launch_scripts.simulation.world.service import PoseThrottle, TargetsService
from launch_scripts.simulation.world.targets import (
    LISTEN_NS,
    PATIENCE_NS,
    STAY_COOL_DOWN_NS,
    Action,
    Captured,
    TargetWorld,
)
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
from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.slope_and_climb import climb_of
from shared_map.terrain.store import homes_of
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.ground import CostConfig
from swarm.config.scenario import Scenario, TargetConfig, VehicleConfig, Walk
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec
from swarm.wire.codec import decode, encode
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.processes import Note, Stats
from swarm.wire.messages.vehicles import Obstacle, VehicleState
from swarm.wire.topics import FLEET, NOTE, POSE, STATS
from vehicle_agent.traffic.obstacles import REACTION_S, capsule_of

S = NS_PER_S
TICK = NS_PER_S // 10


# --- the world ----------------------------------------------------------------------------------------------


def scenario(*targets: TargetConfig, **fields: Any) -> Scenario:
    return Scenario(targets=targets, vehicles=VehicleConfig(capture_range_m=25.0), **fields)


class World:
    def __init__(
        self, *targets: TargetConfig, pace: NDArray[np.float32] | None = None, incarnation: int = 1, **fields: Any
    ) -> None:
        pace = flat() if pace is None else pace
        self.terrain = terrain_of_pace(pace, RES)
        self.grid = self.terrain.grid
        self.world = TargetWorld(scenario(*targets, **fields), self.terrain, pace, incarnation)
        self.now_ns = 10 * NS_PER_S
        self.planned: set[str] = set()

    def tick(self, count: int = 1) -> list[Action]:
        actions: list[Action] = []
        for _ in range(count):
            actions = self.world.tick(self.now_ns, self.planned)
            self.now_ns += TICK
        return actions

    def settle(self) -> list[Action]:
        return self.tick(1 + LISTEN_NS // TICK + 1)

    def poses(self, actions: list[Action] | None = None) -> dict[str, TargetPose]:
        actions = self.tick() if actions is None else actions
        return {action.target: action for action in actions if isinstance(action, TargetPose)}

    def hear(self, cell: int, target: str = "t", state: VehicleState = VehicleState.FOLLOWING) -> list[Action]:
        """A vehicle reports from the middle of a cell."""
        x_m, y_m = self.grid.centre_m(cell)
        report = fleet(self.now_ns / 1e6, ("v", cell), target=target, state=state, at_m=(x_m, -y_m))
        return self.world.hear_fleet(report, self.now_ns)


def still(**fields: Any) -> TargetConfig:
    return TargetConfig(walk="still", start=(20, 25), **fields)


@pytest.mark.parametrize("walk", ["random", "waypoints", "evade"])
def test_a_target_moves_smoothly_at_its_speed_times_the_time_scale(walk: Walk) -> None:
    world = World(TargetConfig(walk=walk, speed_m_per_s=4.0), time_scale=3.0)
    world.settle()
    places = []
    for _ in range(100):
        pose = world.poses()["t"]
        places.append((pose.x_m, pose.y_m))
        x_m, y_m = world.grid.centre_m(pose.cell)
        assert max(abs(pose.x_m - x_m), abs(pose.y_m - y_m)) < 1.5 * world.grid.resolution_m
    strides = np.hypot(*np.diff(np.array(places), axis=0).T)
    assert strides.max() <= 1.2 + 1e-6
    assert np.median(strides) == pytest.approx(1.2)


def test_a_captured_target_turns_up_far_away_and_one_catch_counts_once() -> None:
    world = World(still())
    before = world.poses(world.settle())["t"]
    captured, publish = world.hear(world.grid.cell(20, 27))
    assert captured == Captured("t", "v", before.cell)
    assert isinstance(publish, TargetPose)
    assert (publish.captures, publish.jumps) == (1, 1)
    assert world.grid.distance_cells(publish.cell, before.cell) >= 11
    world.tick()
    there = world.poses()["t"].cell
    assert world.hear(there) == []
    world.tick(20)
    assert len(world.hear(there)) == 2


@pytest.mark.parametrize(
    ("col", "how", "captures"),
    [
        (28, {}, False),
        (25, {"target": "other"}, False),
        (35, {"state": VehicleState.ARRIVED}, False),
        (29, {"state": VehicleState.ARRIVED}, True),  # it is believed when it is near
    ],
)
def test_only_a_chaser_within_reach_captures_its_target(col: int, how: dict[str, Any], captures: bool) -> None:
    world = World(still())
    world.settle()
    assert len(world.hear(world.grid.cell(20, col), **how)) == 2 * captures


def test_a_target_that_stays_is_caught_once_per_approach() -> None:
    world = World(still(caught="stay"))
    world.settle()
    near = world.grid.cell(20, 26)
    caught = []
    for _ in range(100):
        caught += world.hear(near)
        world.tick()
    assert caught == [Captured("t", "v", world.grid.cell(20, 25))]
    world.tick(51)
    assert len(world.hear(near)) == 1
    pose = world.poses()["t"]
    assert (pose.captures, pose.jumps, pose.cell) == (2, 0, world.grid.cell(20, 25))


def test_a_restarted_driver_goes_on_where_planners_last_saw_the_targets() -> None:
    world = World(TargetConfig(count=2), still(name="s"), incarnation=2)
    assert world.poses() == {}
    seen = world.grid.cell(3, 4)
    world.world.hear_planner("t0", seen)
    assert world.poses()["t0"].cell == seen
    assert sorted(world.poses()) == ["t0"]
    world.world.hear_planner("t0", world.grid.cell(30, 30))
    assert world.grid.distance_cells(world.poses()["t0"].cell, seen) <= 1
    world.settle()
    assert sorted(world.poses()) == ["s", "t0", "t1"]


def test_a_driver_waits_longer_for_a_planner_that_is_alive_but_silent() -> None:
    world = World(TargetConfig(count=3))
    world.planned = {"t0", "t1"}
    world.world.hear_planner("t1", None)
    assert list(world.poses()) == ["t1"]
    world.settle()
    assert list(world.poses()) == ["t1", "t2"]
    world.tick((PATIENCE_NS - LISTEN_NS) // TICK)
    assert list(world.poses()) == ["t0", "t1", "t2"]


def test_where_targets_may_start_is_the_same_for_every_finder() -> None:
    pace = flat()
    pace[:, 30] = np.inf
    plan, terrain = scenario(TargetConfig(count=9)), terrain_of_pace(pace, RES)
    found = homes_of(terrain.pace_s_per_m, pace)
    assert found.sum() == pace[:, :30].size
    poses = []
    for homes in (None, found, ~found & np.isfinite(pace)):
        world = TargetWorld(plan, terrain, pace, 1, homes=homes)
        world.begin_anew()
        poses.append([action.cell for action in world.tick(0) if isinstance(action, TargetPose)])
    assert len(poses[0]) == 9
    assert poses[0] == poses[1] != poses[2]


def test_nonsense_from_a_planner_places_no_one() -> None:
    pace = flat()
    pace[0, 0] = np.inf
    home = World(TargetConfig(), pace=pace).poses
    for cell in (0, -1, 2**31):
        world = World(TargetConfig(), pace=pace)
        world.world.hear_planner("t", cell)
        world.world.hear_planner("x", 5)
        assert world.poses()["t"].cell not in (0, 5)
    assert home() == {}


def test_an_external_target_is_not_driven_but_can_be_caught() -> None:
    world = World(TargetConfig(walk="external"))
    world.settle()
    assert world.poses() == {}
    cell = world.grid.cell(5, 5)
    x_m, y_m = world.grid.centre_m(cell)
    pose = TargetPose(target="t", incarnation=9, seq=1, stamp_ns=0, cell=cell, x_m=x_m, y_m=y_m)
    world.world.hear_pose(pose, world.now_ns)
    assert world.poses() == {}
    assert world.hear(cell) == [Captured("t", "v", cell)]
    assert world.hear(cell) == []


def test_a_capture_that_the_leader_counted_counts_once_after_it_is_gone() -> None:
    leader = World(still(caught="stay"), incarnation=9)
    leader.settle()
    cell = leader.world._targets["t"].walker.cell
    assert leader.hear(cell) == [Captured("t", "v", cell)]
    standby = World(still(caught="stay"))
    standby.world.lead(False)
    standby.world.hear_pose(leader.poses()["t"], standby.now_ns)
    standby.world.lead(True)
    assert standby.hear(cell) == []
    assert standby.poses()["t"].captures == 1
    standby.now_ns += STAY_COOL_DOWN_NS + TICK
    assert standby.hear(cell) == [Captured("t", "v", cell)]
    assert standby.poses()["t"].captures == 2


def test_a_pose_with_the_highest_incarnation_that_there_is_leaves_a_standby_its_own() -> None:
    standby = World(still(), incarnation=5)
    standby.world.lead(False)
    highest = (1 << 62) - 1
    most = (1 << 53) - 1
    lie = target_pose("t", 777, incarnation=highest, seq=highest, captures=most, jumps=most)
    standby.world.hear_pose(lie, standby.now_ns)
    standby.world.lead(True)
    standby.tick(1 + STAY_COOL_DOWN_NS // TICK)
    assert len(standby.hear(777)) == 2
    pose = standby.poses()["t"]
    assert (pose.incarnation, pose.captures, pose.jumps) == (5, 1, 1)
    assert decode(encode(pose), TargetPose) == pose


# --- what is told ---------------------------------------------------------------------------------------------


def test_a_pose_is_told_when_the_target_has_moved_or_was_caught_and_else_twice_a_second() -> None:
    telling = PoseThrottle(resolution_m=10.0)
    here = TargetPose(target="t", incarnation=1, seq=1, stamp_ns=0, cell=5, x_m=0.0, y_m=0.0)
    assert telling.is_news(here)
    for changed, news in (
        ({"x_m": 2.4}, False),
        ({"x_m": 2.4, "y_m": 1.0}, True),
        ({"cell": 6}, True),
        ({"jumps": 1}, True),
        ({"incarnation": 2}, True),
        ({"stamp_ns": S // 2 - 1}, False),
        ({"stamp_ns": S // 2}, True),
        ({"stamp_ns": -1}, True),  # its clock was put back
        ({"target": "u"}, True),
    ):
        telling = PoseThrottle(resolution_m=10.0)
        telling.is_news(here)
        assert telling.is_news(msgspec.structs.replace(here, **changed)) is news


# --- on the bus ---------------------------------------------------------------------------------------------


def targets_on(pace: NDArray[np.float32], plan: Scenario, **said: Any) -> tuple[SwarmModel, Ear]:
    """A swarm of nothing but targets, and what it says."""
    model = SwarmModel(terrain=terrain_of_pace(pace, RES), scenario=plan)
    ear = Ear(model, (POSE, NOTE, STATS))
    setup = replace(model.setup("targets", "0"), **said)
    model.start("targets", lambda bus, post: TargetsService(setup, model.terrain, pace, bus, post), phase_ns=0)
    return model, ear


def test_the_service_tells_poses_captures_and_broken_laws() -> None:
    pace = flat()
    pace[0, 0] = np.inf
    world, ear = targets_on(pace, scenario(still()))
    world.run(0.01)
    counts = ear.of(Stats)[0].counts  # declared before anything happens
    assert [counts[name] for name in ("captures", "collisions", "lethal_entries", "poses")] == [0, 0, 0, 0]
    world.run(2)
    assert 2 <= len(ear.of(TargetPose)) <= 3  # a target at rest is reported twice a second
    cell = 20 * 50 + 25
    for n in range(4):
        for author, ids in (("a0.1", ["v", "x"]), ("a1.1", ["w"])):
            at = {"v": cell, "x": 0 if n else 1, "w": cell}
            places = ((id, at[id]) for id in ids)
            report = fleet(world.now_ns / 1e6, *places, author=author, seq=n, at_m=(255.0, 205.0))
            ear.bus.publish(FLEET, report, region=0, author=author)
        world.run(0.1)
    world.run(1.5)
    assert [note.kind for note in ear.of(Note)] == ["capture", "lethal-entry", "collision"]
    assert ear.of(Note)[0].cell == cell
    counts = ear.of(Stats)[-1].counts
    assert [counts[name] for name in ("captures", "collisions", "lethal_entries")] == [1, 1, 1]
    assert 0 < counts["poses"] <= len(ear.of(TargetPose))


@pytest.mark.parametrize("anew", [True, False])
def test_a_service_with_which_the_run_begins_waits_for_what_is_ordered_but_for_no_planner(
    anew: bool,
) -> None:
    model, ear = targets_on(flat(), scenario(still()), anew=anew)
    model.run(0.3)
    assert ear.of(TargetPose) == []
    model.keeper("0", KeeperStore(":memory:"))
    model.run(0.5)
    assert bool(ear.of(TargetPose)) == anew


# --- walks, and rovers that are moved with the targets ------------------------------------------------------------


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
        budget.paths = 1
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
TEXT = "seed = 4\ntime_scale = 2\nrovers = [{ count = 6, speed_m_per_s = 3, radius_m = 2 }]\n"


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
