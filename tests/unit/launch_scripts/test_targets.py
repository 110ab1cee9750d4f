"""Targets: where they start, how they move, when they are captured, and what the service tells of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from support.makers import target_pose
from support.planner_swarm import Ear
from support.swarm_model import SwarmModel
from support.target_reports import RES, flat, fleet

from launch_scripts.simulation.world.service import PoseThrottle, TargetsService
from launch_scripts.simulation.world.targets import (
    LISTEN_NS,
    PATIENCE_NS,
    STAY_COOL_DOWN_NS,
    Action,
    Captured,
    TargetWorld,
)
from launch_scripts.simulation.world.walks import Walk
from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.store import homes_of
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, TargetConfig, VehicleConfig
from swarm.wire.codec import decode, encode
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.processes import Note, Stats
from swarm.wire.messages.vehicles import VehicleState
from swarm.wire.topics import FLEET, NOTE, POSE, STATS

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


def test_a_captured_target_turns_up_far_away() -> None:
    world = World(still())
    before = world.poses(world.settle())["t"]
    captured, publish = world.hear(world.grid.cell(20, 27))
    assert captured == Captured("t", "v", before.cell)
    assert isinstance(publish, TargetPose)
    assert (publish.captures, publish.jumps) == (1, 1)
    assert world.grid.distance_cells(publish.cell, before.cell) >= 11


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
    world.planned = {"t0", "t1"}
    world.world.hear_planner("t1", None)
    assert list(world.poses()) == ["t1"]
    world.settle()
    assert list(world.poses()) == ["t1", "t2"]
    world.tick((PATIENCE_NS - LISTEN_NS) // TICK)
    assert list(world.poses()) == ["t0", "t1", "t2"]


def test_in_a_run_that_begins_all_targets_are_placed_at_once() -> None:
    world = World(TargetConfig(count=2), still(name="s"))
    world.planned = {"t0"}
    assert world.poses() == {}
    world.world.begin_anew()
    assert sorted(world.poses()) == ["s", "t0", "t1"]


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


def stand_by(leader: World, **fields: Any) -> World:
    """A standby that has heard what a leader tells."""
    standby = World(still(**fields))
    standby.world.lead(False)
    for pose in leader.poses().values():
        standby.world.hear_pose(pose, standby.now_ns)
    return standby


def test_a_standby_does_nothing_and_goes_on_from_where_the_leader_ended() -> None:
    leader = World(still(), incarnation=9)
    leader.settle()
    cell = leader.world._targets["t"].walker.cell
    assert leader.hear(cell) != []
    standby = stand_by(leader)
    assert standby.tick() == []
    assert standby.world.ready
    assert standby.hear(cell) == []
    last = leader.poses()["t"]
    standby.world.hear_pose(last, standby.now_ns)
    standby.world.lead(True)
    first = standby.poses()["t"]
    assert (first.cell, first.captures, first.jumps) == (last.cell, 1, 1)
    assert (first.incarnation, first.seq) > (last.incarnation, last.seq)


def test_a_capture_that_the_leader_counted_counts_once_after_it_is_gone() -> None:
    leader = World(still(caught="stay"), incarnation=9)
    leader.settle()
    cell = leader.world._targets["t"].walker.cell
    assert leader.hear(cell) == [Captured("t", "v", cell)]
    standby = stand_by(leader, caught="stay")
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
