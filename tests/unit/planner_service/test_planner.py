"""The planner without a bus or a worker: what it grows and when, and what it tells of that."""

import math
import random
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.scripted_planner import COLS, GRID, ROWS, World, pose

from planner_service.planner import Action, Work
from planner_service.target_tree import Update
from planner_service.tree.partitioned_tree import GrownTree
from swarm.clock import NS_PER_S
from swarm.grid import Window
from swarm.wire.route_columns import RouteStatus


def test_nothing_is_grown_before_the_target_is_known(world: World) -> None:
    world.mark(5)
    assert world.tick() == []
    assert world.tree.calls == []


def test_a_request_before_the_first_tree_is_answered_no_target(world: World) -> None:
    reply = world.ask(5, 6)
    assert [route.status for route in reply.routes] == [RouteStatus.NO_TARGET] * 2
    assert (reply.target, reply.incarnation, reply.target_cell) == ("t0", 7, None)
    assert (reply.rows, reply.cols, reply.tree_age_ms) == (ROWS, COLS, math.inf)


def test_many_poses_in_a_tick_cost_one_update_to_the_newest(ready: World) -> None:
    for seq in range(2, 7):
        ready.pose(10, 19 + seq, seq)
    ready.tick()
    assert ready.tree.calls == [("update", GRID.cell(10, 25), [], 0)]


def test_a_tick_without_news_costs_nothing(ready: World) -> None:
    ready.pose(10, 20, seq=2)
    assert ready.tick() == []
    assert ready.tree.calls == []


def test_the_pose_of_another_target_is_not_ours(world: World) -> None:
    world.watch.on_pose(pose(5, target="t1"), world.now_ns)
    assert world.tick() == []
    assert world.planner.status(0).target_cell is None


def test_map_changes_of_a_tick_are_taken_in_together(ready: World) -> None:
    ready.mark(0)
    ready.mark(GRID.cell(19, 29))
    ready.tick()
    assert ready.tree.calls == [
        ("update", GRID.cell(10, 20), [Window(0, 0, 1, 1), Window(19, 29, 20, 30)], 2),
    ]


def test_changes_wait_as_long_as_repairs_have_had_their_share_and_no_route_passes_them_meanwhile(ready):
    ready.planner._push_ns = NS_PER_S // 5  # changes wait no longer, but for the budget: a tenth of a core
    ready.tree.answers = [Update("repair", GRID.window, 9, repair_ns=80_000_000)]
    ready.mark(1)
    ready.tick()
    assert len(ready.tree.named("update")) == 1
    ready.mark(2)
    for _ in range(7):
        ready.tick()
    assert len(ready.tree.named("update")) == 1
    ready.tick()
    assert len(ready.tree.named("update")) == 2
    ready.tree.answers = [Update("repair", GRID.window, 9, repair_ns=80_000_000)] * 2
    for cell, how in ((3, lambda: ready.ask(3)), (4, lambda: ready.pose(11, 20, seq=2))):
        ready.mark(cell)
        before = len(ready.tree.named("update"))
        how()
        ready.tick()
        assert len(ready.tree.named("update")) == before + 1


def test_a_full_growth_is_handed_to_the_worker_with_its_snapshot_and_version(world: World) -> None:
    world.pose(10, 20)
    world.mark(5)
    world.tree.answers = [Update("none", wants_full=True)]
    (grow,) = world.tick()
    assert isinstance(grow, Work)
    assert world.tree.named("full_job") == [("full_job", GRID.cell(10, 20), 1)]
    assert world.tick() == []
    assert not world.tree.ready


def test_the_grown_tree_is_adopted_and_served(world: World) -> None:
    world.pose(10, 20)
    world.tree.answers = [Update("none", wants_full=True)]
    (grow,) = world.tick()
    assert world.grow(grow, took_ns=5_000_000) == []
    assert world.tree.named("adopt") == [("adopt", 0, GRID.cell(10, 20), [], 0)]
    assert world.ask(0).routes[0].status is RouteStatus.OK
    assert world.counters.counts["growths"] == 1
    assert world.planner.status(0).growth_ms == 5.0


def test_marks_seen_while_growing_cost_one_more_tree_not_one_each(ready: World) -> None:
    ready.tree.answers = [Update("none", wants_full=True)] * 4
    ready.mark(1)
    (grow,) = ready.tick()
    for cell in (10, 20, 29):
        ready.mark(cell)
        assert ready.tick() == []
    ready.tree.answers = [Update("full", GRID.window, 600, wants_full=True)]
    again = ready.planner.adopt(grow.job(), 1, ready.now_ns)
    assert ready.tree.named("full_job")[1:] == [("full_job", GRID.cell(10, 20), 4)]
    assert ready.grow(again[0]) == []
    assert ready.tick() == []
    assert len(ready.tree.named("full_job")) == 2


def test_adoption_is_told_all_that_changed_since_the_snapshot_and_only_that(ready: World) -> None:
    ready.tree.answers = [Update("none", wants_full=True), Update("repair", Window(0, 0, 3, 3), 9)]
    ready.mark(0)
    (grow,) = ready.tick()
    ready.mark(GRID.cell(5, 5))
    ready.tick()
    ready.mark(GRID.cell(15, 15))
    ready.pose(11, 20, seq=2)
    ready.planner.adopt(grow.job(), 1, ready.now_ns)
    windows = [Window(5, 5, 6, 6), Window(15, 15, 16, 16)]
    assert ready.tree.named("adopt") == [("adopt", 1, GRID.cell(11, 20), windows, 3)]
    ready.tree.calls.clear()
    ready.tick()
    assert ready.tree.calls == []


def test_a_growth_is_of_the_map_that_it_was_decided_on_whatever_changes_before_it_runs(ready: World) -> None:
    ready.tree.answers = [Update("none", wants_full=True)]
    ready.mark(1)
    (grow,) = ready.tick()
    ready.mark(2)
    assert grow.job().map_version == 1
    assert ready.map.version == 2


@given(st.randoms(use_true_random=False))
def test_whatever_happens_the_tree_ends_up_with_the_newest_pose_and_map(chance: random.Random) -> None:
    world = World()
    jobs: list[Callable[[], GrownTree]] = []

    def take(actions: list[Action]) -> None:
        jobs.extend(action.job for action in actions if isinstance(action, Work))

    for seq in range(1, 30):
        world.tree.answers = [Update("full", GRID.window, 1, wants_full=chance.random() < 0.4)]
        match chance.randrange(4):
            case 0:
                world.pose(chance.randrange(ROWS), chance.randrange(COLS), seq)
            case 1:
                world.mark(chance.randrange(GRID.cells))
            case 2:
                take(world.tick())
            case 3 if jobs:
                take(world.planner.adopt(jobs.pop()(), 1, world.now_ns))
        assert len(jobs) <= 1
    world.pose(3, 4, 100)
    world.tree.answers = []
    take(world.tick())
    while jobs:
        take(world.planner.adopt(jobs.pop()(), 1, world.now_ns))
    assert world.tree.target_cell == GRID.cell(3, 4)
    assert world.tree.map_version == world.map.version
    assert world.map.take_dirty() == []


def test_a_mark_is_timed_from_its_stamp_to_the_tree_that_knows_it(ready: World) -> None:
    ready.mark(5, stamp_ns=ready.now_ns - 20_000_000)
    ready.tick()
    quantile = ready.counters.histograms["mark_to_tree_ms"].quantile(0.5)
    assert quantile == pytest.approx(120, rel=0.05)


def test_a_mark_that_waits_for_a_full_growth_is_timed_to_its_adoption(ready: World) -> None:
    ready.tree.answers = [Update("none", wants_full=True)]
    ready.mark(5, stamp_ns=ready.now_ns)
    (grow,) = ready.tick()
    assert "mark_to_tree_ms" not in ready.counters.histograms
    ready.now_ns += 900_000_000
    ready.grow(grow)
    quantile = ready.counters.histograms["mark_to_tree_ms"].quantile(0.5)
    assert quantile == pytest.approx(1000, rel=0.05)


def test_gaps_are_measured_at_full_growths_and_told(ready: World) -> None:
    ready.tree.answers = [Update("none", wants_full=True)]
    ready.tree.gaps = np.array([1.0, 1.02, 1.1])
    ready.pose(10, 21, 2)
    (grow,) = ready.tick()
    ready.grow(grow)
    status = ready.planner.status(0)
    assert status.gap_mean == pytest.approx(1.04)
    assert status.gap_max == pytest.approx(1.1)
    assert ready.counters.histograms["gap_excess"].count == 3
    assert ready.counters.histograms["gap_excess"].quantile(1.0) == pytest.approx(0.1, rel=0.03)


@pytest.mark.parametrize(("followers", "measured"), [(1, 1), (64, 64), (130, 44)])
def test_growths_of_its_own_thread_are_measured_once_in_a_period_for_64_followers_at_most(
    ready: World, followers: int, measured: int
) -> None:
    ids = [f"v{n}" for n in range(followers)]
    ready.ask(*(GRID.cell(10, 5) for _ in ids), vehicles=ids)
    for seq in range(2, 12):  # a second of ticks
        ready.pose(10, 18 + seq, seq)
        ready.tick()
    assert ready.counters.histograms["gap_excess"].count == measured


def test_every_served_route_carries_its_proven_gap_into_the_books(ready: World) -> None:
    ready.tree.gap = 1.25
    ready.ask(0, 5, GRID.cells)
    assert ready.counters.histograms["certified_gap_excess"].count == 2
    assert ready.counters.counts["routes_served"] == 3


def test_too_wide_a_gap_asks_for_one_full_growth_a_second(ready: World) -> None:
    ready.tree.gap = 1.6
    grows: list[Action] = []
    for _ in range(21):
        ready.ask(0)
        for grow in ready.tick():
            grows.append(grow)
            ready.grow(grow)
    assert len(grows) == 3


def test_growths_are_timed_by_the_stopwatch_that_is_handed_in() -> None:
    times = iter([10_000_000, 13_000_000])
    world = World(stopwatch=lambda: next(times))
    world.pose(10, 20)
    world.tick()
    assert world.planner.status(0).growth_ms == 3.0
    assert ("observe", 3_000_000) in world.tree.calls


def test_what_a_repair_took_is_observed_by_itself_and_not_with_the_growth_after_it() -> None:
    times = iter([10_000_000, 60_000_000])
    world = World(stopwatch=lambda: next(times))
    world.tree.answers = [Update("exact", GRID.window, 4, repair_ns=45_000_000)]
    world.pose(10, 20)
    world.tick()
    assert world.planner.status(0).growth_ms == 5.0
    assert world.counters.histograms["repair_ms"].count == 1


def test_without_a_stopwatch_growths_take_what_the_model_says(ready: World) -> None:
    assert ready.planner.status(0).growth_ms == pytest.approx(GRID.cells * 15e-6)
    assert ready.tree.named("observe") == []


def test_the_status_is_told_twice_a_second(ready: World) -> None:
    ready.told.clear()
    for _ in range(20):
        ready.tick()
    assert len(ready.told) == 4
    status = ready.told[-1]
    assert (status.target, status.target_cell, status.growths, status.window) == (
        "t0",
        GRID.cell(10, 20),
        1,
        [0, 0, ROWS, COLS],
    )
