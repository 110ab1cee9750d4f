"""One vehicle: what it asks for and its state, whatever happens; and its route on the way."""

import contextlib
import random
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.vehicle_states import record, table

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec, walk
from swarm.wire.messages.vehicles import Followed, VehicleState
from swarm.wire.route_columns import RouteStatus, directions_of
from vehicle_agent.driving.driven_vehicle import Follower, GivenRoute, Reason, Vehicle

GRID = GridSpec(10, 10, 10.0)
S = NS_PER_S
ROUTE = GivenRoute("t0", (11, 12, 13, 14), 3.0, 2.5, partial=False)


def cells_of(followed: Followed | None) -> list[int]:
    assert followed is not None
    return [*walk(GRID, followed.start, followed.directions)]


@pytest.fixture
def vehicle() -> Vehicle:
    return Vehicle("v", GRID, 11)


@pytest.fixture
def waiting(vehicle: Vehicle) -> Vehicle:
    vehicle.assign("t0", S)
    vehicle.route_request(S)
    return vehicle


@pytest.fixture
def follower(waiting: Vehicle) -> Vehicle:
    waiting.give_route(ROUTE, [waiting.cell], S)
    return waiting


def run_out(vehicle: Vehicle) -> None:
    for cell in vehicle.route.ahead():
        vehicle.motion.set_out(cell)
        vehicle.motion.advance(vehicle.motion.advance(100.0, 0.1), 0.1)
        vehicle.route.moved(cell)


def test_given_a_target_it_asks_once_and_waits(vehicle: Vehicle) -> None:
    vehicle.assign("t0", S)
    assert vehicle.route_request(S) is Reason.ASSIGNED
    assert vehicle.route_request(2 * S) is None
    assert vehicle.state is VehicleState.WAITING


def test_without_an_answer_it_asks_again_later_and_later(vehicle: Vehicle) -> None:
    vehicle.assign("t0", 0)
    asked_at = []
    for tick in range(200):
        now_ns = tick * S // 10
        if vehicle.route_request(now_ns):
            asked_at.append(tick)
            vehicle.no_answer(now_ns)
    waits = [after - before for before, after in pairwise(asked_at)]
    assert waits[:6] == [2, 4, 8, 16, 30, 30]


def test_with_its_target_in_reach_it_has_arrived_and_asks_nothing(follower: Vehicle) -> None:
    run_out(follower)
    follower.set_in_reach(True)
    assert follower.route_request(3 * S) is None
    assert follower.state is VehicleState.ARRIVED
    follower.set_in_reach(False)
    assert follower.state is VehicleState.WAITING
    assert follower.route_request(4 * S) is Reason.RAN_OUT


def test_a_pushed_route_replaces_the_old_one_from_here_on(follower: Vehicle) -> None:
    follower.motion.set_out(12)
    follower.motion.advance(100.0, 0.1)
    follower.route.moved(12)
    pushed = GivenRoute("t0", (11, 12, 22, 32), 3.0, 3.0, partial=False, pushed=True)
    followed = follower.give_route(pushed, [follower.cell], 2 * S)
    assert (cells_of(followed), followed.target, followed.cost_s) == ([12, 22, 32], "t0", 3.0)


def test_a_route_to_another_target_is_ignored(follower: Vehicle) -> None:
    pushed = GivenRoute("t1", (11, 21), 1.0, 1.0, partial=False, pushed=True)
    assert follower.give_route(pushed, [follower.cell], 2 * S) is None
    assert follower.route.ahead() == [12, 13, 14]


def test_a_route_may_begin_where_the_path_ends_that_it_still_drives(follower: Vehicle) -> None:
    given = GivenRoute("t0", (13, 23, 33), 1.0, 1.0, partial=False)
    assert cells_of(follower.give_route(given, [11, 12, 13], 2 * S)) == [11, 12, 13, 23, 33]
    assert follower.route.after(13, 9) == [23, 33]


def test_its_planner_gone_it_keeps_its_route_and_is_lost_until_the_planner_is_back(follower: Vehicle) -> None:
    follower.lose_planner(2 * S)
    assert follower.state is VehicleState.LOST
    assert follower.route.ahead() == [12, 13, 14]
    run_out(follower)
    assert follower.route_request(3 * S) is None
    assert follower.state is VehicleState.LOST
    follower.regain_planner(4 * S)
    assert follower.route_request(4 * S) is Reason.PLANNER_BACK


def test_no_way_to_its_target_leaves_it_stranded_and_it_tries_again(waiting: Vehicle) -> None:
    waiting.refuse_route("t0", RouteStatus.UNREACHABLE, S)
    assert waiting.state is VehicleState.STRANDED
    assert waiting.route_request(2 * S) is None
    assert waiting.route_request(5 * S) is not None
    assert waiting.state is VehicleState.STRANDED
    waiting.give_route(ROUTE, [waiting.cell], 5 * S)
    assert waiting.state is VehicleState.FOLLOWING


def test_a_planner_that_has_not_seen_the_target_yet_is_asked_again(waiting: Vehicle) -> None:
    waiting.refuse_route("t0", RouteStatus.NO_TARGET, S)
    assert waiting.state is VehicleState.WAITING
    assert waiting.route_request(2 * S) is not None


def pushed(*cells: int, partial: bool = False) -> Callable[[Vehicle], object]:
    route = GivenRoute("t0", cells, 3.0, 3.0, partial, pushed=True)
    return lambda vehicle: vehicle.give_route(route, [vehicle.cell], 2 * S)


@pytest.mark.parametrize(
    ("happen", "reason", "left"),
    [
        (lambda vehicle: vehicle.blocked_for_long(2 * S), Reason.BLOCKED, 3),
        (lambda vehicle: vehicle.cut_route(2 * S), Reason.CUT, 3),
        (lambda vehicle: vehicle.target_jumped(2 * S), Reason.JUMPED, 3),
        (pushed(11, 12, 13, partial=True), Reason.CONTINUED, 2),  # before it ends
        (pushed(44, 45), Reason.ASSIGNED, 0),  # which does not pass here: it stops
        (run_out, Reason.RAN_OUT, 0),
    ],
)
def test_a_vehicle_that_needs_another_route_asks_and_drives_on_what_it_has(follower, happen, reason, left):
    happen(follower)
    assert follower.route_request(3 * S) is reason
    state = VehicleState.FOLLOWING if left else VehicleState.WAITING
    assert (follower.route.left, follower.state) == (left, state)
    assert not Reason.CONTINUED.is_reroute


def random_call(vehicle: Vehicle, chance: random.Random) -> None:
    """One thing happens to a vehicle that its agent may let happen."""
    target, asked, flag = vehicle.target, vehicle.asked, chance.random() < 0.5
    to, cells = chance.choice("ab"), chance.choice([(11, 12, 13), (50, 51), (11,)])
    route = GivenRoute(to, cells, 1.0, 1.0, False, flag, chance.random() < 0.3)
    status = chance.choice([RouteStatus.UNREACHABLE, RouteStatus.NO_TARGET])
    calls: list[tuple[bool, Callable[[], object]]] = [
        (True, lambda: vehicle.assign(chance.choice("ab"), 0)),
        (True, lambda: vehicle.set_tracked(flag)),
        (True, vehicle.no_way),
        *[(True, lambda: setattr(vehicle.motion, "at_rest", flag))] * 2,
        (target is not None, vehicle.release),
        (target is not None and not vehicle.planner_gone, lambda: vehicle.lose_planner(0)),
        (target is not None, lambda: vehicle.regain_planner(0)),
        (target is not None, lambda: vehicle.set_in_reach(flag)),
        (target is not None, lambda: vehicle.target_jumped(0)),
        (True, lambda: vehicle.route_request(10 * S)),
        (flag or asked is not None, lambda: vehicle.give_route(route, [11], 0)),
        *[(asked is not None, lambda: vehicle.refuse_route(asked or "", status, 0))] * 3,
        *[(asked is not None, lambda: vehicle.no_answer(0))] * 3,
        (vehicle.route.left > 0, lambda: vehicle.route.cut(lambda cells: 0) and vehicle.cut_route(0)),
        (vehicle.route.left > 0 and not vehicle.in_reach, lambda: vehicle.blocked_for_long(0)),
        *[(vehicle.route.left > 0, lambda: [vehicle.route.moved(cell) for cell in vehicle.route.ahead()])] * 3,
    ]
    chance.choice([call for may, call in calls if may])()


@given(st.randoms(use_true_random=False))
def test_whatever_happens_the_state_tells_what_is_so_and_it_never_gives_up(chance: random.Random) -> None:
    vehicle = Vehicle("v", GRID, 11)
    for _ in range(chance.randrange(30)):
        random_call(vehicle, chance)
        vehicle.route_request(10 * S)
        if vehicle.target is not None:
            assert (vehicle.state is VehicleState.ARRIVED) == (vehicle.in_reach and vehicle.tracked)
            if vehicle.state is VehicleState.OUTDATED:
                assert not vehicle.tracked
            if vehicle.state in (VehicleState.FOLLOWING, VehicleState.ARRIVED):
                assert vehicle.tracked
            assert (vehicle.state is VehicleState.LOST) == (vehicle.planner_gone and not vehicle.in_reach)
            assert vehicle.state is not VehicleState.IDLE
            assert vehicle.state is not VehicleState.FOLLOWING or vehicle.route.left
    # Once all is well again, a vehicle with nothing to drive asks.
    end_ns = 100 * S
    vehicle.assign("c", end_ns)
    vehicle.no_answer(end_ns)
    vehicle.regain_planner(end_ns)
    vehicle.set_in_reach(False)
    assert any(vehicle.route_request(end_ns + wait * S) for wait in range(10))


def test_the_table_of_transitions_has_all_that_vehicles_can_make_and_no_other(monkeypatch) -> None:
    made = record(monkeypatch)
    for seed in range(5000):
        chance, vehicle = random.Random(seed), Vehicle("v", GRID, 11)
        for _ in range(60):
            random_call(vehicle, chance)
    assert made == table()


# --- routes on their way to be driven ------------------------------------------------------------------------


def following(*cells: int, here: int | None = None) -> Follower:
    route = Follower()
    assert route.begin(cells, [cells[0] if here is None else here])
    return route


def test_a_vehicle_that_was_pushed_comes_back_to_its_route_further_on() -> None:
    route = following(11, 12, 13, 14)
    route.moved(12)
    assert route.ahead(2) == [13, 14]
    route.moved(23)
    assert route.ahead(2) == [13, 14]
    assert route.after(23, 2) == []
    route.moved(14)
    assert route.ahead() == []


def test_what_comes_after_a_cell_of_the_route_is_known_before_the_vehicle_is_there() -> None:
    route = following(11, 12, 13, 14)
    assert route.after(12, 1) == [13]
    assert route.after(14, 3) == []
    assert route.near(2) == [11, 12]


def test_a_route_ends_before_the_first_step_ahead_that_is_closed() -> None:
    route = following(11, 12, 13, 14, here=12)
    assert not route.cut(lambda cells: len(cells) - 1)
    assert route.cut(lambda cells: cells.index(13))
    assert route.ahead() == [13]


@given(st.integers(1, 10), st.integers(0, 99), st.lists(st.integers(0, 8), max_size=12).map(bytes))
def test_directions_from_the_network_become_cells_and_back_or_nothing(cols: int, start: int, codes: bytes) -> None:
    grid = GridSpec(10, cols, 10.0)
    with contextlib.suppress(ValueError):
        cells = walk(grid, start, codes)
        assert directions_of(cells, cols) == directions_of(np.array(cells), cols) == codes


@given(st.lists(st.lists(st.integers(0, 99), max_size=4), max_size=20))
def test_bounds_of_a_route_are_those_of_its_cells_whatever_has_changed(routes: list[list[int]]) -> None:
    route = Follower()
    for cells in routes:
        if not cells:
            route.drop()
        else:
            assert route.begin(cells, cells)
        assert route.left == len(route.ahead())
        north, west, south, east = route.bounds(GRID.cols)
        rows, cols = [cell // GRID.cols for cell in cells], [cell % GRID.cols for cell in cells]
        if cells:
            assert (north, west, south, east) == (min(rows), min(cols), max(rows), max(cols))
        else:
            assert north - 1 > south + 1  # nothing is in it, nor in one that is a cell wider
