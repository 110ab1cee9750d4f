from __future__ import annotations

import math
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.memory_world import MemoryWorld

from launch_scripts.world.referee import Collision, LethalEntry, Referee
from launch_scripts.world.targets import (
    LISTEN_NS,
    PATIENCE_NS,
    Action,
    Captured,
    Publish,
    TargetsService,
    TargetWorld,
)
from launch_scripts.world.walks import Budget, Ground, Walk, Walker, far_place, slowness_of
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import Event, Heard
from swarm.clock import NS_PER_S
from swarm.config.scenario import CostConfig, Scenario, TargetConfig, VehicleConfig
from swarm.errors import ConfigError, TerrainError
from swarm.grid import GridSpec
from swarm.runtime.role import RoleSetup
from swarm.wire.fields import pack_column
from swarm.wire.messages.processes import Note, Stats
from swarm.wire.messages.targets import TargetPose
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, VehicleState
from swarm.wire.topics import FLEET, NOTE, POSE, STATS

FLAT = 0.1
RES = 10.0
TICK = NS_PER_S // 10
NOBODY = np.empty(0, np.int64)


def flat(rows: int = 40, cols: int = 50) -> NDArray[np.float32]:
    return np.full((rows, cols), FLAT, np.float32)


def ground(pace: NDArray[np.float32]) -> Ground:
    rows, cols = pace.shape
    return Ground(GridSpec(rows, cols, RES), pace)


def rough(seed: int, rows: int = 30, cols: int = 34, lethal: float = 0.3) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    pace = rng.uniform(0.05, 0.5, (rows, cols)).astype(np.float32)
    pace[rng.random((rows, cols)) < lethal] = np.inf
    pace[rows // 2] = 0.1
    return pace


def walker(where: Ground, cell: int, walk: Walk, slowness: float = 1.0, seed: int = 1) -> Walker:
    return Walker("t", walk, slowness, random.Random(seed), cell)


# --- walking ------------------------------------------------------------------------------------------------


def test_the_largest_part_is_what_legal_steps_connect() -> None:
    pace = flat(4, 6)
    pace[:, 3] = np.inf
    pace[0, 2] = pace[1, 3] = np.inf
    pace[1, 3] = np.inf
    assert ground(pace).home.tolist() == [0, 1, 6, 7, 8, 12, 13, 14, 18, 19, 20]


def test_nobody_squeezes_past_the_corner_of_a_lethal_cell() -> None:
    pace = flat(2, 2)
    pace[0, 1] = np.inf
    assert ground(pace).step(0, 3) is None
    assert ground(pace).step(0, 4) == 2
    pace[1, 0] = np.inf
    assert len(ground(pace).home) == 1


def test_a_terrain_without_a_passable_cell_is_refused() -> None:
    with pytest.raises(TerrainError, match="every cell of the terrain is lethal"):
        ground(np.full((3, 3), np.inf, np.float32))


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.sampled_from(["random", "waypoints", "evade"]))
def test_every_step_of_every_walk_is_legal(seed: int, walk: Walk) -> None:
    where = ground(rough(seed))
    one = walker(where, where.random_home(random.Random(seed)), walk, seed=seed)
    vehicles = where.home[:3]
    for _ in range(80):
        before, heading_to = one.cell, one.towards
        one.advance(where, 3.0, vehicles, Budget())
        if one.towards is not None:
            assert one.towards in [to for _, to in where.steps(one.cell)]
        assert not where.lethal(one.cell)
        if one.cell != before and heading_to is not None:
            assert heading_to in [to for _, to in where.steps(before)]


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000))
def test_a_way_is_the_cheapest_there_is(seed: int) -> None:
    where = ground(rough(seed, 12, 14))
    start = where.random_home(random.Random(seed))
    way = where.way(start, random.Random(seed))
    cost, at = 0.0, start
    for cell in way:
        assert cell in [to for _, to in where.steps(at)]
        cost += where.length_m(at, cell) * float(where.pace_s_per_m.flat[cell])
        at = cell
    assert cost == pytest.approx(naive_cost(where, start, at))


def naive_cost(where: Ground, start: int, end: int) -> float:
    """Bellman-Ford: slow and obviously right."""
    cost = {start: 0.0}
    changed = True
    while changed:
        changed = False
        for cell, so_far in list(cost.items()):
            for _, to in where.steps(cell):
                there = so_far + where.length_m(cell, to) * float(where.pace_s_per_m.flat[to])
                if there < cost.get(to, math.inf) - 1e-12:
                    cost[to] = there
                    changed = True
    return cost[end]


def test_a_walled_in_target_stays_where_it_is() -> None:
    pace = flat(5, 5)
    pace[1:4, 1:4] = np.inf
    pace[2, 2] = FLAT
    where = ground(pace)
    walks: tuple[Walk, ...] = ("random", "waypoints", "evade")
    for walk in walks:
        one = walker(where, 12, walk)
        one.advance(where, 100.0, NOBODY, Budget())
        assert one.cell == 12


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
    where = ground(np.full((1, 40), pace, np.float32))
    config = TargetConfig(speed_m_per_s=speed)
    one = walker(where, 0, "waypoints", slowness_of(config, CostConfig(flat_speed_m_per_s=10.0)))
    one.way = list(range(39, 0, -1))
    for _ in range(100):
        one.advance(where, 0.1, NOBODY, Budget())
    x_m, _ = one.position_m(where)
    assert x_m - 5.0 == pytest.approx(metres, abs=1e-4)


def test_an_evader_gets_away_from_the_vehicles_near_it() -> None:
    where = ground(flat())
    grid = where.grid
    one = walker(where, grid.cell(20, 25), "evade")
    vehicles = np.array([grid.cell(20, 22), grid.cell(18, 23)])
    one.advance(where, 8.0, vehicles, Budget())
    assert min(grid.distance_cells(one.cell, cell) for cell in vehicles.tolist()) >= 7


def test_ways_are_computed_one_a_tick() -> None:
    where = ground(flat())
    walkers = [walker(where, 100 * n, "waypoints") for n in range(4)]
    for ticked in range(1, 5):
        budget = Budget()
        for one in walkers:
            one.advance(where, 0.1, NOBODY, budget)
        assert sum(1 for one in walkers if one.way) == ticked


def test_a_jump_leads_far_away_and_clear_of_vehicles() -> None:
    where = ground(flat())
    grid = where.grid
    vehicles = np.array([grid.cell(row, 40) for row in range(40)])
    for seed in range(50):
        place = far_place(where, grid.cell(20, 10), vehicles, 3, random.Random(seed))
        row, col = grid.row_col(place)
        assert math.hypot(row - 20, col - 10) >= math.hypot(40, 50) / 4
        assert abs(col - 40) > 3


# --- the referee --------------------------------------------------------------------------------------------


def fleet(
    stamp_ms: float,
    *vehicles: tuple[str, int],
    author: str = "a0.1",
    seq: int | None = None,
    target: str | None = "t",
    state: VehicleState = VehicleState.FOLLOWING,
    at_m: tuple[float, float] = (0.0, 0.0),
) -> Fleet:
    """A report; by default they come every 100 ms, and the sequence number says so."""
    count = len(vehicles)
    return Fleet(
        author=author,
        group="all",
        region=0,
        seq=int(stamp_ms // 100) if seq is None else seq,
        stamp_ns=int(stamp_ms * 1e6),
        ids=[id for id, _ in vehicles],
        target_ids=[] if target is None else [target],
        cells=pack_column([cell for _, cell in vehicles], "<u4"),
        east_m=pack_column([at_m[0]] * count, "<f4"),
        south_m=pack_column([at_m[1]] * count, "<f4"),
        heading_rad=pack_column([0.0] * count, "<f4"),
        states=bytes([state] * count),
        targets=bytes([NO_TARGET if target is None else 0] * count),
    )


def judged(*reports: Fleet, passable: NDArray[np.bool_] | None = None) -> list[Collision | LethalEntry]:
    referee = Referee(np.ones(100, np.bool_) if passable is None else passable)
    return [broken for report in reports for broken in referee.hear(report)]


def b(stamp_ms: float, cell: int) -> Fleet:
    return fleet(stamp_ms, ("b", cell), author="a1.1")


def a(stamp_ms: float, cell: int, **fields: Any) -> Fleet:
    return fleet(stamp_ms, ("a", cell), **fields)


def test_two_vehicles_on_one_cell_at_one_time_collide() -> None:
    (collision,) = judged(a(100, 5), b(150, 5), a(200, 6), b(250, 5))
    assert collision == Collision("a", "b", 5, 200_000_000)


def test_an_encounter_counts_once_and_the_next_one_again() -> None:
    together = [report for n in range(1, 20) for report in (a(100 * n, 5), b(100 * n + 50, 5))]
    apart = [report for n in range(20, 50) for report in (a(100 * n, 5), b(100 * n + 50, 6))]
    again = [report for n in range(50, 60) for report in (a(100 * n, 5), b(100 * n + 50, 5))]
    assert len(judged(*together)) == 1
    assert len(judged(*together, *apart)) == 1
    assert len(judged(*together, *apart, *again)) == 2


def test_entering_a_cell_that_another_has_just_left_is_no_collision() -> None:
    assert judged(a(100, 5), a(200, 6), b(150, 4), b(200, 5), a(300, 7), b(300, 5)) == []
    assert judged(a(100, 5), b(150, 4), a(200, 6), b(201, 5), a(300, 7), b(301, 5)) == []


def test_the_order_in_which_two_agents_are_heard_does_not_matter() -> None:
    reports_a = [a(100, 5), a(200, 5), a(300, 6)]
    reports_b = [b(150, 4), b(250, 5), b(350, 5)]
    for order in ([*reports_a, *reports_b], [*reports_b, *reports_a]):
        assert [(c.first, c.second, c.cell) for c in judged(*order) if isinstance(c, Collision)] == [("a", "b", 5)]


def test_a_lost_report_is_not_held_against_anybody() -> None:
    """The report of 200 ms, that `a` has left cell 5, is lost: that it stood there when `b` came is not known."""
    assert judged(a(100, 5), b(150, 4), b(250, 5), a(300, 7), b(350, 5)) == []


def test_who_is_seen_standing_still_stood_there_meanwhile() -> None:
    assert len(judged(a(100, 5), b(150, 4), b(250, 5), a(900, 5), b(950, 5))) == 1


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 3)), max_size=30), st.randoms())
def test_repeated_and_late_reports_change_nothing(moves: list[tuple[str, int]], chance: random.Random) -> None:
    reports = [(a if id == "a" else b)(100.0 * n, cell) for n, (id, cell) in enumerate(moves)]
    repeated: list[Fleet] = []
    for n, report in enumerate(reports):
        repeated += [report, *(reports[chance.randrange(n + 1)] for _ in range(2))]
    assert judged(*reports) == judged(*repeated)


def test_coming_onto_lethal_ground_counts_once_per_entry() -> None:
    passable = np.ones(100, np.bool_)
    passable[7] = False
    reports = [a(100 * n, cell) for n, cell in enumerate([6, 7, 7, 7, 6, 7], start=1)]
    entries = judged(*reports, passable=passable)
    assert entries == [LethalEntry("a", 7, 200_000_000), LethalEntry("a", 7, 600_000_000)]


def test_a_cell_outside_the_grid_is_nobodys_business() -> None:
    assert judged(a(100, 2**32 - 1), a(200, 100)) == []


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

    def tick(self, count: int = 1) -> list[Action]:
        actions: list[Action] = []
        for _ in range(count):
            actions = self.world.tick(self.now_ns)
            self.now_ns += TICK
        return actions

    def settle(self) -> list[Action]:
        return self.tick(1 + LISTEN_NS // TICK + 1)

    def poses(self, actions: list[Action] | None = None) -> dict[str, TargetPose]:
        actions = self.tick() if actions is None else actions
        return {action.pose.target: action.pose for action in actions if isinstance(action, Publish)}

    def hear(self, cell: int, target: str = "t", state: VehicleState = VehicleState.FOLLOWING) -> list[Action]:
        """A vehicle reports from the middle of a cell."""
        x_m, y_m = self.grid.centre_m(cell)
        report = fleet(self.now_ns / 1e6, ("v", cell), target=target, state=state, at_m=(x_m, -y_m))
        return self.world.hear_fleet(report, self.now_ns)


def still(**fields: Any) -> TargetConfig:
    return TargetConfig(walk="still", start=(20, 25), **fields)


def test_poses_are_told_every_tick_with_a_growing_seq() -> None:
    world = World(TargetConfig(count=3), time_scale=5.0)
    world.settle()
    first, second = world.poses(), world.poses()
    assert sorted(first) == ["t0", "t1", "t2"]
    assert [second[id].seq - first[id].seq for id in first] == [1, 1, 1]
    assert {pose.incarnation for pose in second.values()} == {1}


@pytest.mark.parametrize("walk", ["random", "waypoints", "evade"])
def test_a_target_moves_smoothly_at_its_speed_times_the_time_scale(walk: Walk) -> None:
    world = World(TargetConfig(walk=walk, speed_m_per_s=4.0), time_scale=3.0)
    world.settle()
    places = []
    for _ in range(100):
        pose = world.poses()["t"]
        places.append((pose.x_m, pose.y_m))
        grid = world.grid
        at = grid.cell(
            int((grid.north_m - pose.y_m) // grid.resolution_m), int((pose.x_m - grid.west_m) // grid.resolution_m)
        )
        assert grid.distance_cells(at, pose.cell) <= 1
    strides = np.hypot(*np.diff(np.array(places), axis=0).T)
    assert strides.max() <= 1.2 + 1e-6
    assert np.median(strides) == pytest.approx(1.2)


def test_the_same_seed_gives_the_same_walk_and_another_another() -> None:
    def walk(seed: int) -> list[int]:
        world = World(TargetConfig(), time_scale=20.0, seed=seed)
        world.settle()
        return [world.poses(world.tick(10))["t"].cell for _ in range(30)]

    assert walk(1) == walk(1) != walk(2)


def test_targets_start_connected_to_the_others() -> None:
    pace = flat()
    pace[:, 10] = np.inf
    for seed in range(20):
        world = World(TargetConfig(walk="still"), pace=pace, seed=seed)
        assert world.poses(world.settle())["t"].cell % 50 > 10


def test_a_captured_target_turns_up_far_away() -> None:
    world = World(still())
    before = world.poses(world.settle())["t"]
    captured, publish = world.hear(world.grid.cell(20, 27))
    assert captured == Captured("t", "v", before.cell)
    assert isinstance(publish, Publish)
    assert (publish.pose.captures, publish.pose.jumps) == (1, 1)
    assert world.grid.distance_cells(publish.pose.cell, before.cell) >= 11


def test_a_vehicle_out_of_range_captures_nothing() -> None:
    world = World(still())
    world.settle()
    assert world.hear(world.grid.cell(20, 28)) == []


def test_a_vehicle_that_says_it_has_arrived_is_believed_when_it_is_near() -> None:
    world = World(still())
    world.settle()
    assert world.hear(world.grid.cell(20, 35), state=VehicleState.ARRIVED) == []
    assert len(world.hear(world.grid.cell(20, 29), state=VehicleState.ARRIVED)) == 2


def test_a_vehicle_that_chases_another_target_captures_nothing() -> None:
    world = World(still())
    world.settle()
    assert world.hear(world.grid.cell(20, 25), target="other") == []


def test_one_catch_counts_once() -> None:
    world = World(still())
    world.settle()
    world.hear(world.grid.cell(20, 25))
    world.tick()
    there = world.poses()["t"].cell
    assert world.hear(there) == []
    world.tick(20)
    assert len(world.hear(there)) == 2


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
    world.world.planner_up("t0", True)
    world.world.planner_up("t1", True)
    world.world.hear_planner("t1", None)
    assert list(world.poses()) == ["t1"]
    world.settle()
    assert list(world.poses()) == ["t1", "t2"]
    world.tick((PATIENCE_NS - LISTEN_NS) // TICK)
    assert list(world.poses()) == ["t0", "t1", "t2"]


def test_nonsense_from_a_planner_places_nobody() -> None:
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
    world.world.hear_pose(TargetPose(target="t", incarnation=9, seq=1, stamp_ns=0, cell=cell, x_m=x_m, y_m=y_m))
    assert world.poses() == {}
    assert world.hear(cell) == [Captured("t", "v", cell)]
    assert world.hear(cell) == []


@pytest.mark.parametrize(
    ("start", "sentence"),
    [((40, 3), r"target t: start \[40, 3\] is outside the terrain of 40 x 50"), ((0, 0), "is lethal")],
)
def test_a_start_nobody_can_stand_on_is_refused(start: tuple[int, int], sentence: str) -> None:
    pace = flat()
    pace[0, 0] = np.inf
    with pytest.raises(ConfigError, match=sentence):
        World(TargetConfig(start=start), pace=pace)


# --- on the bus ---------------------------------------------------------------------------------------------


class Driven:
    """The service on a memory bus, ticked ten times a second."""

    def __init__(self, world: MemoryWorld, pace: NDArray[np.float32], plan: Scenario, incarnation: int = 1) -> None:
        self.world = world
        self.bus = world.bus(f"targets{incarnation}")
        setup = RoleSetup(plan, "r1", "targets", "0", incarnation, 0)
        self.service = TargetsService(setup, terrain_of_pace(pace, RES), pace, self.bus, self._post)
        self.service.start(self._now())
        self._tick()

    def _now(self) -> int:
        return self.world.scheduler.clock.now_ns()

    def _post(self, event: Event) -> None:
        self.service.handle(event, self._now())

    def _tick(self) -> None:
        if not self.bus.closed:
            self.service.tick(self._now())
            self.world.scheduler.after(TICK, self._tick)


class Ear:
    """Hears everything that is published on some topics."""

    def __init__(self, world: MemoryWorld) -> None:
        self.bus = world.bus("ear")
        self.heard: list[Any] = []
        for topic in (POSE, NOTE, STATS):
            self.bus.subscribe(topic, self._post)

    def _post(self, event: Event) -> None:
        assert isinstance(event, Heard)
        self.heard.append(event.message)

    def of(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.heard if isinstance(message, kind)]


def test_the_service_tells_poses_captures_and_broken_laws() -> None:
    world = MemoryWorld()
    pace = flat()
    pace[0, 0] = np.inf
    ear = Ear(world)
    Driven(world, pace, scenario(still()))
    world.run_ms(2000)
    assert len(ear.of(TargetPose)) == pytest.approx(10, abs=1)
    cell = 20 * 50 + 25
    for n in range(4):
        for author, ids in (("a0.1", ["v", "x"]), ("a1.1", ["w"])):
            at = {"v": cell, "x": 0 if n else 1, "w": cell}
            report = fleet(
                world.scheduler.clock.now_ns() / 1e6,
                *((id, at[id]) for id in ids),
                author=author,
                seq=n,
                at_m=(255.0, 205.0),
            )
            ear.bus.publish(FLEET, report, region=0, author=author)
        world.run_ms(100)
    world.run_ms(1500)
    assert [note.kind for note in ear.of(Note)] == ["capture", "lethal-entry", "collision"]
    assert ear.of(Note)[0].cell == cell
    counts = ear.of(Stats)[-1].counts
    assert [counts[name] for name in ("captures", "collisions", "lethal_entries")] == [1, 1, 1]
    assert 0 < counts["poses"] <= len(ear.of(TargetPose))


def test_counts_are_declared_before_anything_happens() -> None:
    world = MemoryWorld()
    ear = Ear(world)
    Driven(world, flat(), scenario(still()))
    world.run_ms(10)
    counts = ear.of(Stats)[0].counts
    assert [counts[name] for name in ("captures", "collisions", "lethal_entries", "poses")] == [0, 0, 0, 0]
