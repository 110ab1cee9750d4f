"""The planner without a bus or a worker: what it grows, what it answers, and to whom it pushes."""

import math
import random
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.scripted_planner import COLS, GRID, ROWS, World, pose

from planner_service.planner import FOLLOWER_LEASE_NS, GOOD_GAP, MOST_ROUTES, Action, Answer, Refusal, Work
from planner_service.target_tree import Update
from planner_service.tree.partitioned_tree import GrownTree
from swarm.clock import NS_PER_S
from swarm.grid import Window, walk
from swarm.wire.messages.planning import CostReply, CostRequest, PushedRoute, RouteReply, RouteRequest
from swarm.wire.route_columns import RouteStatus


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def ready() -> World:
    """Knows the target at row 10, col 20, and has its tree."""
    world = World()
    world.pose(10, 20)
    world.tick()
    assert world.tree.ready
    world.tree.calls.clear()
    return world


def test_before_the_target_is_known_nothing_is_grown_or_answered(world: World) -> None:
    world.mark(5)
    world.watch.on_pose(pose(5, target="t1"), world.now_ns)
    assert world.tick() == []
    assert world.tree.calls == []
    assert world.planner.status(0).target_cell is None
    reply = world.ask(5, 6)
    assert [route.status for route in reply.routes] == [RouteStatus.NO_TARGET] * 2
    assert (reply.target, reply.incarnation, reply.target_cell) == ("t0", 7, None)
    assert (reply.rows, reply.cols, reply.tree_age_ms) == (ROWS, COLS, math.inf)


@pytest.mark.parametrize(
    ("happen", "calls"),
    [
        (lambda ready: ready.pose(10, 20, seq=2), []),
        (
            lambda ready: [ready.pose(10, 19 + seq, seq) for seq in range(2, 7)],
            [("update", GRID.cell(10, 25), [], 0)],
        ),
        (
            lambda ready: [ready.mark(cell) for cell in (0, GRID.cell(19, 29))],
            [("update", GRID.cell(10, 20), [Window(0, 0, 1, 1), Window(19, 29, 20, 30)], 2)],
        ),
    ],
    ids=["no news", "poses", "marks"],
)
def test_all_news_of_a_tick_cost_one_update_and_no_news_none(ready: World, happen, calls) -> None:
    happen(ready)
    assert ready.tick() == []
    assert ready.tree.calls == calls


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


def test_the_tree_of_a_growth_that_a_worker_is_handed_is_adopted_and_served(world) -> None:
    world.pose(10, 20)
    world.mark(5)
    world.tree.answers = [Update("none", wants_full=True)]
    (grow,) = world.tick()
    assert isinstance(grow, Work)
    assert world.tree.named("full_job") == [("full_job", GRID.cell(10, 20), 1)]
    assert world.tick() == []
    assert not world.tree.ready
    assert world.grow(grow, took_ns=5_000_000) == []
    assert world.tree.named("adopt") == [("adopt", 1, GRID.cell(10, 20), [], 1)]
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
    assert (grow.job().map_version, ready.map.version) == (1, 2)  # of the map that it was decided on
    ready.tick()
    ready.mark(GRID.cell(15, 15))
    ready.pose(11, 20, seq=2)
    ready.planner.adopt(grow.job(), 1, ready.now_ns)
    windows = [Window(5, 5, 6, 6), Window(15, 15, 16, 16)]
    assert ready.tree.named("adopt") == [("adopt", 1, GRID.cell(11, 20), windows, 3)]
    ready.tree.calls.clear()
    ready.tick()
    assert ready.tree.calls == []


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
    assert ready.counters.histograms["mark_to_tree_ms"].quantile(1.0) == pytest.approx(120, rel=0.05)
    ready.now_ns += NS_PER_S  # changes wait no longer
    ready.tree.answers = [Update("none", wants_full=True)]
    ready.mark(6, stamp_ns=ready.now_ns)
    (grow,) = ready.tick()
    assert ready.counters.histograms["mark_to_tree_ms"].count == 1
    ready.now_ns += 900_000_000
    ready.grow(grow)
    assert ready.counters.histograms["mark_to_tree_ms"].quantile(1.0) == pytest.approx(1000, rel=0.05)


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


def test_too_wide_a_gap_asks_for_one_full_growth_a_second(ready: World) -> None:
    ready.tree.gap = 1.6
    grows: list[Action] = []
    for _ in range(21):
        ready.ask(0)
        for grow in ready.tick():
            grows.append(grow)
            ready.grow(grow)
    assert len(grows) == 3


@pytest.mark.parametrize("repair_ms", [0, 45])
def test_growths_are_timed_by_the_stopwatch_without_the_repair_before_them(
    repair_ms: int,
) -> None:
    times = iter([10_000_000, 60_000_000])
    world = World(stopwatch=lambda: next(times))
    world.tree.answers = [Update("full", GRID.window, 4, repair_ns=repair_ms * 1_000_000)]
    world.pose(10, 20)
    world.tick()
    assert world.planner.status(0).growth_ms == 50.0 - repair_ms
    assert ("observe", (50 - repair_ms) * 1_000_000) in world.tree.calls
    assert ("repair_ms" in world.counters.histograms) == (repair_ms > 0)


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


# --- what it answers, and to whom it pushes routes ---


def test_a_person_asks_by_row_and_col(ready: World) -> None:
    reply = ready.ask(row=10, col=17)
    (route,) = reply.routes
    assert (route.start, list(route.directions)) == (GRID.cell(10, 17), [2, 2, 2])


def test_nothing_is_forced_for_routes_that_are_proven_good(ready: World) -> None:
    ready.tree.gap = GOOD_GAP - 0.01
    ready.ask(3, 4, force=True)
    assert ready.tree.named("force") == []
    ready.tree.gap = GOOD_GAP + 0.01
    ready.ask(3, 4, force=True)
    assert ready.tree.named("force") == [("force", [3, 4])]


def test_the_range_is_forced_once_between_two_changes_of_the_tree(ready: World) -> None:
    ready.tree.gap = 2.0
    ready.ask(3, 4, force=True)
    ready.ask(4, 5, 3, force=True)
    ready.ask(4, 9)
    ready.ask(GRID.cells, force=True)
    assert ready.tree.named("force") == [("force", [3, 4]), ("force", [5])]
    ready.pose(10, 21, seq=2)
    ready.tick()
    ready.ask(4, force=True)
    assert ready.tree.named("force")[-1] == ("force", [4])
    assert ready.counters.counts["window_growths"] == 3


def test_the_trees_age_is_since_the_last_exact_growth(ready: World) -> None:
    ready.tree.answers = [Update("window", Window(0, 0, 5, 5), 25)] * 3
    for seq in range(2, 5):
        ready.pose(10, 20 + seq, seq)
        ready.tick()
    assert ready.ask(0).tree_age_ms == 300.0
    ready.pose(10, 28, 9)
    ready.tick()
    assert ready.ask(0).tree_age_ms == 0.0


def test_a_follower_inside_the_updated_window_is_pushed_a_newer_route(ready: World) -> None:
    ready.ask(GRID.cell(10, 5), GRID.cell(0, 0), vehicles=["near", "far"])
    ready.now_ns += NS_PER_S
    ready.tree.answers = [Update("window", Window(8, 0, 12, 30), 100)]
    ready.pose(11, 20, seq=2)
    (push,) = ready.tick()
    assert (push.vehicle, push.target, push.incarnation) == ("near", "t0", 7)
    assert walk(GRID, push.route.start, push.route.directions)[-1] == GRID.cell(11, 20)


def test_a_follower_whose_route_a_map_change_crosses_is_pushed_a_newer_route(ready: World) -> None:
    ready.ask(GRID.cell(10, 5), GRID.cell(0, 20), vehicles=["crossed", "clear"])
    ready.now_ns += NS_PER_S
    ready.tree.answers = [Update("repair", Window(9, 12, 12, 13), 3)]
    ready.mark(GRID.cell(10, 12))
    ready.tick()
    (_, follower), _ = ready.planner.followers.all_items()
    # The scripted tree knows no way around: the steps are the old ones, which is no news.
    assert not follower.stale
    ready.chasers(("crossed", GRID.cell(11, 6)), ("clear", GRID.cell(1, 20)))
    ready.tree.answers = [Update("repair", Window(9, 12, 12, 13), 3)]
    ready.mark(GRID.cell(9, 12))
    (push,) = ready.tick()
    assert push.vehicle == "crossed"
    assert push.route.start == GRID.cell(11, 6)


def test_routes_are_pushed_to_a_vehicle_at_most_every_push_s(ready: World) -> None:
    ready.ask(GRID.cell(10, 0), vehicles=["v"])
    pushed_ns: list[int] = []
    for seq in range(2, 42):
        ready.pose(10 + seq % 2, 20, seq)
        pushed_ns += [ready.now_ns for action in ready.tick() if isinstance(action, PushedRoute)]
    assert len(pushed_ns) >= 2
    assert all(np.diff([0, *pushed_ns]) >= NS_PER_S)


def test_a_route_that_only_says_what_the_vehicle_knows_is_not_pushed(ready: World) -> None:
    ready.ask(GRID.cell(10, 0), vehicles=["v"])
    ready.chasers(("v", GRID.cell(10, 3)))
    for _ in range(30):
        ready.mark(GRID.cell(0, 29))
        ready.mark(GRID.cell(0, 28))
        assert ready.tick() == []


def test_who_is_silent_for_five_seconds_is_dropped(ready: World) -> None:
    ready.ask(0, vehicles=["v"])
    asked_ns = ready.now_ns
    while ready.now_ns < asked_ns + FOLLOWER_LEASE_NS:
        ready.tick()
        assert len(ready.planner.followers) == 1
    ready.tick()
    assert len(ready.planner.followers) == 0


def test_after_a_restart_those_who_report_to_follow_are_pushed_routes_without_asking(world: World) -> None:
    world.chasers(("v", GRID.cell(10, 0)))
    world.pose(10, 20)
    (push,) = world.tick()
    assert push.vehicle == "v"


def test_an_answer_is_sent_before_it_is_counted(ready: World) -> None:
    counted = []
    request = RouteRequest(cells=[3], vehicles=["v1"])

    def send(answer: Answer) -> None:
        counted.append((ready.counters.counts["routes_served"], len(ready.planner.followers)))

    answer = ready.planner.answer(request, ready.now_ns, send)
    assert isinstance(answer, RouteReply)
    assert counted == [(0, 0)]
    assert (ready.counters.counts["routes_served"], len(ready.planner.followers)) == (1, 1)


def test_every_answer_is_sent_once(ready: World) -> None:
    sent: list[Answer] = []
    asked = [RouteRequest(cells=[3]), CostRequest(cells=[3]), RouteRequest(cells=[0] * (MOST_ROUTES + 1))]
    returned = [ready.planner.answer(each, ready.now_ns, sent.append) for each in asked]
    assert returned == sent
    assert [type(each) for each in sent] == [RouteReply, CostReply, Refusal]
