"""The planner without a bus or a worker: what it grows and when, what it serves, pushes and tells."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from planner_service.followers import route_cells
from planner_service.full_growth import GrownTree
from planner_service.planner import FOLLOWER_LEASE_NS, Action, GrowTree, Planner
from planner_service.target_tree import TargetTree, Update
from shared_map.cost_map import CostMap
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, Window, walk
from swarm.runtime.stats import Counters
from swarm.wire.fields import column, pack_column
from swarm.wire.messages.planning import (
    CostReply,
    CostRequest,
    PlannerStatus,
    PushedRoute,
    RouteReply,
    RouteRequest,
)
from swarm.wire.messages.targets import TargetPose
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, VehicleState
from swarm.wire.routes import Route, RouteBatch, RouteStatus
from swarm.wire.statements import MarkKind

ROWS, COLS = 20, 30
GRID = GridSpec(ROWS, COLS, 10.0)
TICK = NS_PER_S // 10


class ScriptedTree(TargetTree):
    """Straight routes without any growth; each call is noted, and answers what the test says."""

    def __init__(self) -> None:
        super().__init__(GRID, PlannerConfig())
        self.calls: list[tuple[Any, ...]] = []
        self.answers: list[Update] = []
        self.gap = 1.0
        self.gaps: NDArray[np.float64] = np.empty(0)

    def update(
        self, pace: NDArray[np.float32], target_cell: int, dirty: Sequence[Window], map_version: int
    ) -> Update:
        self.calls.append(("update", target_cell, list(dirty), map_version))
        return self._answer(target_cell, map_version, Update("full", GRID.window, GRID.cells))

    def full_job(
        self, pace_snapshot: NDArray[np.float32], target_cell: int, map_version: int
    ) -> Callable[[], GrownTree]:
        self.calls.append(("full_job", target_cell, map_version))
        cost, parent = np.zeros(1, np.float32), np.zeros(1, np.uint8)
        return lambda: GrownTree(target_cell, map_version, cost, parent, cost, 1.0, None)

    def adopt(
        self,
        grown: GrownTree,
        pace: NDArray[np.float32],
        target_cell: int,
        dirty: Sequence[Window],
        map_version: int,
        followed_cells: Any,
    ) -> Update:
        self.calls.append(("adopt", grown.map_version, target_cell, list(dirty), map_version))
        self.last_gaps = self.gaps
        return self._answer(target_cell, map_version, Update("full", GRID.window, GRID.cells))

    def force(self, cells: Any) -> Update:
        self.calls.append(("force", list(cells)))
        return Update("forced", GRID.window, len(cells))

    def routes(self, cells: Any, max_cells: int = 0) -> RouteBatch:
        return RouteBatch.of([self._route(int(cell), max_cells) for cell in cells])

    def cost_to_go_at(self, cells: Any) -> NDArray[np.float32]:
        return np.array([cell if 0 <= cell < GRID.cells else math.inf for cell in cells], np.float32)

    def measured_model_ns(self) -> int:
        return 1

    def observe_full_ns(self, took_ns: int) -> None:
        self.calls.append(("observe", took_ns))

    def named(self, name: str) -> list[tuple[Any, ...]]:
        return [call for call in self.calls if call[0] == name]

    def _answer(self, target_cell: int, map_version: int, otherwise: Update) -> Update:
        update = self.answers.pop(0) if self.answers else otherwise
        if update.kind != "none":
            self.ready, self.target_cell, self.map_version = True, target_cell, map_version
        return update

    def _route(self, cell: int, max_cells: int) -> Route:
        if not self.ready or self.target_cell is None:
            return Route(status=RouteStatus.NO_TARGET, start=cell)
        if not 0 <= cell < GRID.cells:
            return Route(status=RouteStatus.OUTSIDE, start=cell)
        steps = straight(cell, self.target_cell)
        part = steps[: max_cells or None]
        return Route(
            status=RouteStatus.OK,
            start=cell,
            directions=bytes(part),
            cost_s=float(max(len(steps), 1)),
            lower_bound_s=max(len(steps), 1) / self.gap,
            remaining_s=float(len(steps) - len(part)),
        )


def straight(start: int, end: int) -> list[int]:
    (row, col), (to_row, to_col) = GRID.row_col(start), GRID.row_col(end)
    codes = {step: code for code, step in enumerate(zip(STEP_ROW, STEP_COL, strict=True))}
    steps: list[int] = []
    while (row, col) != (to_row, to_col):
        step = (int(np.sign(to_row - row)), int(np.sign(to_col - col)))
        row, col = row + step[0], col + step[1]
        steps.append(codes[step])
    return steps


class World:
    """A planner with its map and its tree."""

    def __init__(self, stopwatch: Callable[[], int] | None = None) -> None:
        self.map = CostMap(terrain_of_pace(np.full((ROWS, COLS), 0.1, np.float32)))
        self.tree = ScriptedTree()
        self.counters = Counters()
        self.newest_mark_ns: int | None = None
        self.planner = Planner(
            "t0",
            7,
            PlannerConfig(),
            self.tree,
            self.map,
            self.counters,
            stopwatch=stopwatch,
            newest_mark_ns=self._newest,
        )
        self.now_ns = 0
        self.told: list[PlannerStatus] = []

    def _newest(self) -> int | None:
        stamp_ns, self.newest_mark_ns = self.newest_mark_ns, None
        return stamp_ns

    def pose(self, row: int, col: int, seq: int = 1, incarnation: int = 1) -> None:
        cell = GRID.cell(row, col)
        self.planner.hear_pose(pose(cell, seq, incarnation))

    def mark(self, *cells: int, stamp_ns: int | None = None) -> None:
        kinds = np.full(len(cells), MarkKind.LETHAL, np.uint8)
        self.map.apply(np.array(cells, np.uint32), kinds, np.zeros(len(cells), np.float32))
        self.newest_mark_ns = stamp_ns

    def tick(self) -> list[Action]:
        """All that a tick brings, but for the status twice a second."""
        self.now_ns += TICK
        actions = self.planner.tick(self.now_ns)
        self.told.extend(action for action in actions if isinstance(action, PlannerStatus))
        return [action for action in actions if not isinstance(action, PlannerStatus)]

    def ask(self, *cells: int, **fields: Any) -> RouteReply:
        request = RouteRequest(cells=list(cells), **fields)
        reply = self.planner.answer(request, self.now_ns)
        assert isinstance(reply, RouteReply)
        return reply

    def fleet(self, *vehicles: tuple[str, int, str | None], stamp_ns: int | None = None) -> None:
        report = fleet(*vehicles, stamp_ns=self.now_ns if stamp_ns is None else stamp_ns)
        self.planner.hear_fleet(report, self.now_ns)

    def grow(self, action: Action, took_ns: int = 5_000_000) -> list[Action]:
        """Do a growth that was asked for."""
        assert isinstance(action, GrowTree)
        return self.planner.adopt(action.job(), took_ns, self.now_ns)


def pose(cell: int, seq: int = 1, incarnation: int = 1, target: str = "t0") -> TargetPose:
    return TargetPose(target=target, incarnation=incarnation, seq=seq, stamp_ns=0, cell=cell, x_m=0, y_m=0)


def fleet(*vehicles: tuple[str, int, str | None], stamp_ns: int) -> Fleet:
    targets = sorted({target for _, _, target in vehicles if target is not None})
    count = len(vehicles)
    return Fleet(
        author="a0.1",
        group="all",
        region=0,
        seq=1,
        stamp_ns=stamp_ns,
        ids=[id for id, _, _ in vehicles],
        target_ids=targets,
        cells=pack_column([cell for _, cell, _ in vehicles], "<u4"),
        east_m=pack_column([0.0] * count, "<f4"),
        south_m=pack_column([0.0] * count, "<f4"),
        heading_rad=pack_column([0.0] * count, "<f4"),
        states=bytes([VehicleState.FOLLOWING] * count),
        targets=bytes([NO_TARGET if target is None else targets.index(target) for _, _, target in vehicles]),
    )


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


@settings(deadline=None)
@given(st.permutations([(1, 1), (1, 2), (1, 9), (2, 1), (2, 2)]))
def test_the_newest_pose_wins_in_whatever_order_poses_arrive(order: list[tuple[int, int]]) -> None:
    world = World()
    for incarnation, seq in order:
        world.pose(incarnation, seq, seq, incarnation)
    world.tick()
    assert world.tree.target_cell == GRID.cell(2, 2)


def test_the_pose_of_another_target_is_not_ours(world: World) -> None:
    world.planner.hear_pose(pose(5, target="t1"))
    assert world.tick() == []
    assert world.planner.status(0).target_cell is None


def test_map_changes_of_a_tick_are_taken_in_together(ready: World) -> None:
    ready.mark(0)
    ready.mark(GRID.cell(19, 29))
    ready.tick()
    assert ready.tree.calls == [
        ("update", GRID.cell(10, 20), [Window(0, 0, 1, 1), Window(19, 29, 20, 30)], 2),
    ]


def test_a_full_growth_is_handed_to_the_worker_with_its_snapshot_and_version(world: World) -> None:
    world.pose(10, 20)
    world.mark(5)
    world.tree.answers = [Update("none", wants_full=True)]
    (grow,) = world.tick()
    assert isinstance(grow, GrowTree)
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
    assert isinstance(grow, GrowTree)
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
    assert isinstance(grow, GrowTree)
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
    assert isinstance(grow, GrowTree)
    assert grow.job().map_version == 1
    assert ready.map.version == 2


@settings(deadline=None)
@given(st.randoms(use_true_random=False))
def test_whatever_happens_the_tree_ends_up_with_the_newest_pose_and_map(chance: random.Random) -> None:
    world = World()
    jobs: list[Callable[[], GrownTree]] = []

    def take(actions: list[Action]) -> None:
        jobs.extend(action.job for action in actions if isinstance(action, GrowTree))

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


def test_a_person_asks_by_row_and_col(ready: World) -> None:
    reply = ready.ask(row=10, col=17)
    (route,) = reply.routes
    assert (route.start, list(route.directions)) == (GRID.cell(10, 17), [2, 2, 2])


def test_outside_is_a_status(ready: World) -> None:
    assert ready.ask(row=10, col=COLS).routes[0].status is RouteStatus.OUTSIDE
    statuses = [route.status for route in ready.ask(-1, GRID.cells, 2**31, 0).routes]
    assert statuses == [RouteStatus.OUTSIDE] * 3 + [RouteStatus.OK]


def test_costs_come_as_a_column_with_inf_outside(ready: World) -> None:
    reply = ready.planner.answer(CostRequest(cells=[3, GRID.cells]), ready.now_ns)
    assert isinstance(reply, CostReply)
    assert column(reply.cost_to_go_s, "<f4").tolist() == [3.0, math.inf]


def test_asking_again_gives_the_same_answer(ready: World) -> None:
    assert ready.ask(3, 4, force=True) == ready.ask(3, 4, force=True)


def test_the_range_is_forced_once_between_two_changes_of_the_tree(ready: World) -> None:
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
    assert isinstance(push, PushedRoute)
    assert (push.vehicle, push.target, push.incarnation) == ("near", "t0", 7)
    assert walk(GRID, push.route.start, push.route.directions)[-1] == GRID.cell(11, 20)


def test_a_follower_whose_route_a_map_change_crosses_is_pushed_a_newer_route(ready: World) -> None:
    ready.ask(GRID.cell(10, 5), GRID.cell(0, 20), vehicles=["crossed", "clear"])
    ready.now_ns += NS_PER_S
    ready.tree.answers = [Update("repair", Window(9, 12, 12, 13), 3)]
    ready.mark(GRID.cell(10, 12))
    ready.tick()
    follower = ready.planner.followers.get("crossed")
    clear = ready.planner.followers.get("clear")
    assert follower is not None
    assert clear is not None
    # The scripted tree knows no way around: the steps are the old ones, which is no news.
    assert not follower.stale
    ready.fleet(("crossed", GRID.cell(11, 6), "t0"), ("clear", GRID.cell(1, 20), "t0"))
    ready.tree.answers = [Update("repair", Window(9, 12, 12, 13), 3)]
    ready.mark(GRID.cell(9, 12))
    (push,) = ready.tick()
    assert isinstance(push, PushedRoute)
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
    ready.fleet(("v", GRID.cell(10, 3), "t0"))
    for _ in range(30):
        ready.mark(GRID.cell(0, 29))
        ready.mark(GRID.cell(0, 28))
        assert ready.tick() == []


def test_reports_tell_where_a_follower_is_now_and_who_else_follows(ready: World) -> None:
    ready.ask(GRID.cell(10, 0), vehicles=["v"])
    ready.fleet(("v", GRID.cell(10, 3), "t0"), ("w", GRID.cell(3, 3), "t0"), ("x", 5, "t1"), ("y", 6, None))
    assert ready.planner.followers.cells.tolist() == [GRID.cell(10, 3), GRID.cell(3, 3)]
    assert ready.planner.status(0).following == 2


def test_who_chases_another_target_is_dropped_at_once(ready: World) -> None:
    ready.ask(0, 1, vehicles=["v", "w"])
    ready.fleet(("v", 0, "t1"), ("w", 1, None))
    assert len(ready.planner.followers) == 0


def test_an_older_report_changes_nothing(ready: World) -> None:
    ready.fleet(("v", 5, "t0"), stamp_ns=200)
    ready.fleet(("v", 4, "t0"), stamp_ns=100)
    ready.fleet(("v", 4, "t1"), stamp_ns=100)
    assert ready.planner.followers.cells.tolist() == [5]


def test_who_is_silent_for_five_seconds_is_dropped(ready: World) -> None:
    ready.ask(0, vehicles=["v"])
    asked_ns = ready.now_ns
    while ready.now_ns < asked_ns + FOLLOWER_LEASE_NS:
        ready.tick()
        assert len(ready.planner.followers) == 1
    ready.tick()
    assert len(ready.planner.followers) == 0


def test_after_a_restart_those_who_report_to_follow_are_pushed_routes_without_asking(world: World) -> None:
    world.fleet(("v", GRID.cell(10, 0), "t0"))
    world.pose(10, 20)
    (push,) = world.tick()
    assert isinstance(push, PushedRoute)
    assert push.vehicle == "v"


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
    assert ready.counters.histograms["gap"].count == 3
    assert ready.counters.histograms["gap_excess"].quantile(1.0) == pytest.approx(0.1, rel=0.03)


def test_every_served_route_carries_its_proven_gap_into_the_books(ready: World) -> None:
    ready.tree.gap = 1.25
    ready.ask(0, 5, GRID.cells)
    assert ready.counters.histograms["certified_gap"].count == 2
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


def test_the_cells_of_a_route_are_those_walked() -> None:
    start, directions = GRID.cell(5, 5), bytes([0, 1, 2, 3, 4, 5, 6, 7, 2])
    rows, cols = route_cells(GRID, Route(status=RouteStatus.OK, start=start, directions=directions))
    assert [GRID.cell(r, c) for r, c in zip(rows.tolist(), cols.tolist(), strict=True)] == walk(
        GRID, start, directions
    )
