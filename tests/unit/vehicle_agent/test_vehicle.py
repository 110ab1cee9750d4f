"""One vehicle: events in, actions and a state out."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import VehicleState
from swarm.wire.routes import RouteStatus
from vehicle_agent.driving.vehicle import (
    AskRoute,
    Assigned,
    Follow,
    MadeWay,
    MakesWay,
    NoAnswer,
    NoWay,
    PlannerBack,
    PlannerGone,
    Reason,
    RouteCut,
    RouteGiven,
    RouteRefused,
    StillBlocked,
    TargetJumped,
    TargetLeft,
    TargetReached,
    Vehicle,
    VehicleEvent,
)

GRID = GridSpec(10, 10, 10.0)
S = NS_PER_S
ROUTE = RouteGiven("t0", (11, 12, 13, 14), 3.0, 2.5, partial=False)


@pytest.fixture
def vehicle() -> Vehicle:
    return Vehicle("v", GRID, 11)


@pytest.fixture
def follower(vehicle: Vehicle) -> Vehicle:
    vehicle.handle(Assigned("t0"), S)
    vehicle.tick(S)
    vehicle.handle(ROUTE, S)
    return vehicle


def run_out(vehicle: Vehicle) -> None:
    for cell in vehicle.route.ahead():
        vehicle.motion.set_out(cell)
        vehicle.motion.advance(vehicle.motion.advance(100.0, 0.1), 0.1)
        vehicle.route.moved(cell)


def test_without_a_target_it_is_idle_and_asks_nobody(vehicle: Vehicle) -> None:
    assert vehicle.tick(S) == []
    assert vehicle.state is VehicleState.IDLE


def test_given_a_target_it_asks_once_and_waits(vehicle: Vehicle) -> None:
    vehicle.handle(Assigned("t0"), S)
    assert vehicle.tick(S) == [AskRoute("v", "t0", 11, False, Reason.ASSIGNED)]
    assert vehicle.tick(2 * S) == []
    assert vehicle.state is VehicleState.WAITING


def test_given_a_route_it_follows_it_and_says_so(vehicle: Vehicle) -> None:
    vehicle.handle(Assigned("t0"), S)
    vehicle.tick(S)
    assert vehicle.handle(ROUTE, S) == [Follow("v", "t0", (11, 12, 13, 14), 3.0, 2.5)]
    assert vehicle.state is VehicleState.FOLLOWING


def test_without_an_answer_it_asks_again_later_and_later(vehicle: Vehicle) -> None:
    vehicle.handle(Assigned("t0"), 0)
    asked_at = []
    for tick in range(200):
        now_ns = tick * S // 10
        if vehicle.tick(now_ns):
            asked_at.append(tick)
            vehicle.handle(NoAnswer(), now_ns)
    waits = [after - before for before, after in pairwise(asked_at)]
    assert waits[:6] == [2, 4, 8, 16, 30, 30]


def test_a_route_that_ran_out_is_asked_for_by_force(follower: Vehicle) -> None:
    run_out(follower)
    assert follower.tick(2 * S) == [AskRoute("v", "t0", 14, True, Reason.RAN_OUT)]
    assert follower.state is VehicleState.WAITING


def test_with_its_target_in_reach_it_has_arrived_and_asks_nothing(follower: Vehicle) -> None:
    run_out(follower)
    follower.handle(TargetReached(), 2 * S)
    assert follower.tick(3 * S) == []
    assert follower.state is VehicleState.ARRIVED
    follower.handle(TargetLeft(), 4 * S)
    assert follower.state is VehicleState.WAITING
    assert [action.force for action in follower.tick(4 * S) if isinstance(action, AskRoute)] == [True]


def test_a_route_given_in_parts_is_asked_for_before_it_ends(vehicle: Vehicle) -> None:
    vehicle.handle(Assigned("t0"), S)
    vehicle.tick(S)
    vehicle.handle(RouteGiven("t0", (11, 12, 13), 9.0, 9.0, partial=True), S)
    assert vehicle.tick(2 * S) == [AskRoute("v", "t0", 11, False, Reason.CONTINUED)]
    assert not Reason.CONTINUED.is_reroute


def test_a_pushed_route_replaces_the_old_one_from_here_on(follower: Vehicle) -> None:
    follower.motion.set_out(12)
    follower.motion.advance(100.0, 0.1)
    follower.route.moved(12)
    pushed = RouteGiven("t0", (11, 12, 22, 32), 3.0, 3.0, partial=False, pushed=True)
    assert follower.handle(pushed, 2 * S) == [Follow("v", "t0", (12, 22, 32), 3.0, 3.0)]


def test_a_pushed_route_that_does_not_pass_here_makes_it_stop_and_ask(follower: Vehicle) -> None:
    pushed = RouteGiven("t0", (44, 45), 3.0, 3.0, partial=False, pushed=True)
    assert follower.handle(pushed, 2 * S) == []
    assert follower.tick(3 * S) == [AskRoute("v", "t0", 11, False, Reason.ASSIGNED)]


def test_a_route_to_another_target_is_ignored(follower: Vehicle) -> None:
    assert follower.handle(RouteGiven("t1", (11, 21), 1.0, 1.0, partial=False, pushed=True), 2 * S) == []
    assert follower.route.ahead() == [12, 13, 14]


def test_a_cell_not_yet_entered_is_given_up_when_the_new_route_does_not_want_it(follower: Vehicle) -> None:
    follower.motion.set_out(12)
    follower.motion.advance(0.2, 0.1)
    follower.handle(RouteGiven("t0", (11, 21, 31), 1.0, 1.0, partial=False, pushed=True), 2 * S)
    assert follower.motion.entering is None
    assert follower.motion.head == 11


def test_a_closure_ahead_makes_it_ask_for_another_way(follower: Vehicle) -> None:
    follower.route.cut({14}.__contains__)
    follower.handle(RouteCut(), 2 * S)
    assert follower.tick(3 * S) == [AskRoute("v", "t0", 11, False, Reason.CUT)]
    assert follower.state is VehicleState.FOLLOWING


def test_its_planner_gone_it_keeps_its_route_and_is_lost_until_the_planner_is_back(follower: Vehicle) -> None:
    follower.handle(PlannerGone(), 2 * S)
    assert follower.state is VehicleState.LOST
    assert follower.route.ahead() == [12, 13, 14]
    run_out(follower)
    assert follower.tick(3 * S) == []
    assert follower.state is VehicleState.LOST
    follower.handle(PlannerBack(), 4 * S)
    assert follower.tick(4 * S) == [AskRoute("v", "t0", 14, False, Reason.PLANNER_BACK)]


def test_no_way_to_its_target_leaves_it_stranded_and_it_tries_again(vehicle: Vehicle) -> None:
    vehicle.handle(Assigned("t0"), S)
    vehicle.tick(S)
    vehicle.handle(RouteRefused("t0", RouteStatus.UNREACHABLE), S)
    assert vehicle.state is VehicleState.STRANDED
    assert vehicle.tick(2 * S) == []
    assert len(vehicle.tick(5 * S)) == 1
    assert vehicle.state is VehicleState.STRANDED
    vehicle.handle(ROUTE, 5 * S)
    assert vehicle.state is VehicleState.FOLLOWING


def test_a_planner_that_has_not_seen_the_target_yet_is_asked_again(vehicle: Vehicle) -> None:
    vehicle.handle(Assigned("t0"), S)
    vehicle.tick(S)
    vehicle.handle(RouteRefused("t0", RouteStatus.NO_TARGET), S)
    assert vehicle.state is VehicleState.WAITING
    assert len(vehicle.tick(2 * S)) == 1


def test_no_way_to_any_target_is_stranded_even_before_it_had_one(vehicle: Vehicle) -> None:
    vehicle.handle(NoWay(), S)
    assert vehicle.state is VehicleState.STRANDED
    vehicle.handle(Assigned("t1"), 2 * S)
    assert vehicle.tick(2 * S) == [AskRoute("v", "t1", 11, False, Reason.ASSIGNED)]


def test_a_jump_of_its_target_makes_it_ask_at_once(follower: Vehicle) -> None:
    follower.handle(TargetJumped(), 2 * S)
    assert follower.tick(3 * S) == [AskRoute("v", "t0", 11, False, Reason.JUMPED)]


def test_whoever_makes_way_leaves_its_route_and_rests_before_it_asks(follower: Vehicle) -> None:
    follower.handle(MakesWay(), 2 * S)
    assert follower.resting(100 * S)
    assert follower.handle(ROUTE, 2 * S) == []
    follower.handle(MadeWay(5 * S), 3 * S)
    assert follower.tick(4 * S) == []
    assert follower.tick(5 * S) == [AskRoute("v", "t0", 11, False, Reason.BLOCKED)]
    assert Reason.BLOCKED.is_reroute


def test_whoever_is_blocked_for_long_asks_but_keeps_its_route(follower: Vehicle) -> None:
    follower.handle(StillBlocked(), 2 * S)
    assert follower.tick(3 * S) == [AskRoute("v", "t0", 11, False, Reason.BLOCKED)]
    assert follower.route.left == 3


events: st.SearchStrategy[VehicleEvent] = st.sampled_from(
    [
        Assigned("t0"),
        Assigned("t1"),
        NoWay(),
        ROUTE,
        RouteGiven("t1", (11, 21), 1.0, 1.0, partial=True, pushed=True),
        RouteGiven("t0", (77,), 1.0, 1.0, partial=False, pushed=True),
        RouteRefused("t0", RouteStatus.UNREACHABLE),
        RouteRefused("t1", RouteStatus.NO_TARGET),
        NoAnswer(),
        PlannerGone(),
        PlannerBack(),
        TargetReached(),
        TargetLeft(),
        TargetJumped(),
        RouteCut(),
        MakesWay(),
        MadeWay(3 * S),
        StillBlocked(),
    ]
)


@given(st.lists(events, max_size=30))
def test_whatever_happens_the_state_tells_what_is_so_and_it_never_gives_up(happened: list[VehicleEvent]) -> None:
    vehicle = Vehicle("v", GRID, 11)
    for second, event in enumerate(happened):
        vehicle.handle(event, second * S)
        vehicle.tick(second * S)
        if vehicle.target is not None:
            assert (vehicle.state is VehicleState.ARRIVED) == vehicle.in_reach
            assert (vehicle.state is VehicleState.LOST) == (vehicle.planner_gone and not vehicle.in_reach)
            assert vehicle.state is not VehicleState.IDLE
            if vehicle.state is VehicleState.FOLLOWING:
                assert vehicle.route.left
    # Once all is well again, a vehicle with nothing to drive asks.
    end_ns = 100 * S
    for healed in (Assigned("t2"), NoAnswer(), PlannerBack(), TargetLeft(), MadeWay(0)):
        vehicle.handle(healed, end_ns)
    asked = [action for wait in range(10) for action in vehicle.tick(end_ns + wait * S)]
    assert asked
