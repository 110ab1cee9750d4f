"""The planner without a bus or a worker: what it answers, and to whom it pushes routes."""

import numpy as np
from support.scripted_planner import GRID, World

from planner_service.planner import FOLLOWER_LEASE_NS, GOOD_GAP, MOST_ROUTES, Answer, Refusal
from planner_service.target_tree import Update
from swarm.clock import NS_PER_S
from swarm.grid import Window, walk
from swarm.wire.messages.planning import CostReply, CostRequest, PushedRoute, RouteReply, RouteRequest


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
