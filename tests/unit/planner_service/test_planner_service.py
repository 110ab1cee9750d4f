"""A planner on a bus: its routes keep the laws while target, map and followers change, and after restarts."""

import math

import numpy as np
import pytest
from support.planner_swarm import GRID, RENEWS, RES, Swarm, flat, rough
from support.scripted_planner import TRACKED

from planner_service.kernel_build import load_all
from planner_service.planner import MOST_ROUTES, Planner
from planner_service.target_search import TargetSearch
from planner_service.target_tree import TargetTree
from planner_service.tracker_notes import TargetWatch
from shared_map.cost_map import CostMap
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import Replied
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec
from swarm.runtime.stats import Counters
from swarm.wire.codec import encode
from swarm.wire.fields import column
from swarm.wire.messages.planning import (
    CostReply,
    CostRequest,
    PlannerStatus,
    PushedRoute,
    RouteRequest,
    TargetPose,
)
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import COST, ROUTE


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    load_all()


def test_one_wildcard_question_brings_the_costs_of_all_planners() -> None:
    swarm = Swarm(targets=3)
    swarm.cells = {"t0": GRID.cell(0, 0), "t1": GRID.cell(0, 10), "t2": GRID.cell(30, 0)}
    swarm.run(0.5)
    replies = swarm.ear.ask(COST, CostRequest(cells=[GRID.cell(0, 20), GRID.cells + 5]))
    costs = {reply.target: column(reply.cost_to_go_s, "<f4").tolist() for reply in replies}
    assert sorted(costs) == ["t0", "t1", "t2"]
    assert costs["t1"] == pytest.approx([10.0, math.inf])
    assert costs["t0"][0] == pytest.approx(20.0)
    assert all(isinstance(reply, CostReply) for reply in replies)


def test_a_target_on_lethal_ground_has_no_routes_until_it_is_back() -> None:
    pace = flat()
    pace[3:8, 3:8] = np.inf
    pace[5, 6] = 1.0  # open, but no way leads there
    swarm = Swarm(pace)
    for _ in range(2):
        swarm.cells["t"] = GRID.cell(10, 10)
        swarm.run(0.3)
        assert swarm.ear.routes(0).routes[0].status is RouteStatus.OK
        swarm.cells["t"] = GRID.cell(5, 5)
        swarm.run(0.3)
        reply = swarm.ear.routes(0)
        assert (reply.target_cell, reply.routes[0].status) == (None, RouteStatus.NO_TARGET)
        assert (reply.lethal_target, reply.nearest_cell) == (GRID.cell(5, 5), GRID.cell(2, 5))
        (costs,) = swarm.ear.ask(COST, CostRequest(cells=[0]))
        assert (costs.lethal_target, costs.nearest_cell) == (GRID.cell(5, 5), GRID.cell(2, 5))
        assert lethal_alarms(swarm) == [None]
        swarm.cells["t"] = GRID.cell(10, 10)
        swarm.run(1.3)
        assert None not in lethal_alarms(swarm)


def lethal_alarms(swarm: Swarm) -> list[int | None]:
    """The end of the newest alarm about the target's ground; None while it lasts."""
    alarms = swarm.planners["t"]._member.alarms.current()
    return [each.over_ns for each in alarms if each.kind == "target-lethal"][:1]


def test_a_target_whose_tracker_never_came_is_an_alarm_until_one_comes() -> None:
    swarm = Swarm()
    swarm.run(11.0)
    alarms = swarm.planners["t"]._member.alarms
    assert [(each.kind, each.over_ns) for each in alarms.current()] == [("no-tracker", None)]
    swarm.cells["t"] = GRID.cell(10, 10)
    swarm.run(0.3)
    assert [each.kind for each in alarms.current() if each.over_ns is None] == []


def test_after_a_reconnect_every_follower_is_pushed_its_route_as_one_before_may_have_been_lost() -> None:
    swarm = Swarm()
    swarm.cells["t"] = GRID.cell(20, 5)
    swarm.run(0.5)
    start = GRID.cell(20, 40)
    route = swarm.ear.routes(start, vehicles=["a"]).routes[0]
    for up in (False, True):
        swarm.report(("a", start))
        swarm.run(1.0)
        assert not swarm.ear.of(PushedRoute)
        swarm.network.link_changed("planner-t-1", up)
    swarm.report(("a", start))
    swarm.run(1.0)
    (pushed,) = swarm.ear.of(PushedRoute)
    assert (pushed.vehicle, pushed.route.directions) == ("a", route.directions)


def test_windows_and_the_exact_trees_that_renew_them_are_counted() -> None:
    swarm = Swarm(rough(9), "auto", cpu_budget=RENEWS)
    for n in range(60):
        swarm.cells["t"] = GRID.cell(20, 10 + n // 2)
        swarm.report(("v", GRID.cell(20, 0)))
        swarm.run(0.1)
    stats = swarm.ear.last_stats()
    assert stats.counts["growths"] > 5
    assert stats.counts["window_growths"] > 10
    assert sum(stats.histograms["window_ms"].values()) == stats.counts["window_growths"]
    status = swarm.ear.of(PlannerStatus)[-1]
    assert status.following == 1
    assert 1.0 <= status.gap_mean <= status.gap_max


def test_the_largest_answer_fits_into_one_message_with_its_routes_cut() -> None:
    pace = np.full((200, 200), np.inf, np.float32)
    for row in range(0, 200, 2):  # one way in serpentines, ten thousand steps long
        pace[row] = 0.1
        pace[row + 1, 199 if row % 4 == 0 else 0] = 0.1
    tree = TargetTree(GridSpec(200, 200, RES), PlannerConfig())
    watch = TargetWatch("t", tree.cost_grid.grid, Counters())
    search, cost_map = TargetSearch(TRACKED, tree.cost_grid, 1.0), CostMap(terrain_of_pace(pace, RES))
    planner = Planner(watch, 1, PlannerConfig(), tree, cost_map, Counters(), target_search=search)
    watch.on_pose(TargetPose(target="t", incarnation=1, seq=1, stamp_ns=0, cell=0, x_m=0, y_m=0), 0)
    planner.tick(0)
    whole = planner.answer(RouteRequest(cells=[198 * 200]), 0)
    assert len(whole.routes[0].directions) > 20_000
    assert whole.routes[0].remaining_s == 0
    reply = planner.answer(RouteRequest(cells=[198 * 200] * MOST_ROUTES), 0)
    assert all(route.remaining_s > 0 for route in reply.routes)
    assert len(encode(reply)) < ROUTE.answer_bytes


def test_questions_that_waited_for_a_tree_are_answered_in_bounded_work_a_tick_and_agents_first() -> None:
    """400 expensive questions of ten sessions wait for the first tree, and then one of a vehicle."""
    swarm = Swarm()
    answered: list[str] = []

    def ask(asker: str, request: CostRequest | RouteRequest) -> None:
        topic = COST if isinstance(request, CostRequest) else ROUTE
        swarm.ear.bus.ask(
            topic, request, lambda event: answered.append(asker) if isinstance(event, Replied) else None, tag=asker,
            target="t", asker=asker, timeout_s=10.0,
        )  # fmt: skip

    swarm.cells["t"] = GRID.cell(5, 5)
    swarm.run(0.5)
    planner, waits = swarm.planners["t"], [True]
    planner._must_wait = lambda name, cells, now_ns: waits[0]  # type: ignore[method-assign]
    for n in range(200):
        ask(f"rover.q{n % 10}", CostRequest(cells=list(range(2000)) * 10))
    ask("agent.a0", RouteRequest(cells=[GRID.cell(0, 20)]))
    swarm.run(0.02)
    assert answered == []
    waits[0] = False
    per_tick = []
    for _ in range(60):
        before = len(answered)
        planner.tick(swarm.now_ns)
        swarm.run(0.001)
        per_tick.append(len(answered) - before)
    assert answered[0] == "agent.a0"
    assert max(per_tick) <= 5
    assert len(answered) == 201
