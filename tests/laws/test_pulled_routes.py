"""Pulled routes against segments whose crossings are fractions: what they cost, and what they may not touch."""

import itertools
import math
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import segments
from support.effort import few

from planner_service.any_angle_routes import Puller
from planner_service.route_finder import RouteFinder
from swarm.client.route import Route as ClientRoute
from swarm.client.terrain_frame import Frame
from swarm.config.scenario import PlannerConfig
from swarm.errors import ProtocolError
from swarm.grid import GridSpec, walk
from swarm.wire.codec import decode, encode
from swarm.wire.messages.planning import PushedRoute
from swarm.wire.route_columns import NO_TARGET, OK, Route, RouteBatch, Routes, RouteStatus
from vehicle_agent.driving.driven_vehicle import Follower
from vehicle_agent.driving.dynamics import PluginDynamics, Stretch
from vehicle_agent.driving.motion import Motion


@settings(max_examples=few(120), deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(2, 24),
    st.integers(2, 24),
    st.sampled_from((0.0, 0.1, 0.3)),
    st.booleans(),
    st.sampled_from((4, 8)),
)
def test_a_pulled_route_costs_its_integral_is_never_costlier_and_touches_nothing_lethal(
    seed: int, rows: int, cols: int, lethal: float, corner_cutting: bool, neighbours: Literal[4, 8]
) -> None:
    random = np.random.default_rng(seed)
    pace = random_ground(random, rows, cols, lethal)
    finder = RouteFinder(pace, (0, 0), resolution_m=2.5, corner_cutting=corner_cutting, neighbours=neighbours)
    for row, col in ((rows - 1, cols - 1), (rows - 1, 0), (rows // 2, cols - 1)):
        route = finder.route(row, col)
        if route.status.value != "ok":
            continue
        pulled = finder.pull(route)
        assert pulled.turns[0].tolist() == [row, col]
        assert pulled.turns[-1].tolist() == [0, 0]
        assert pulled.cost_s <= pulled.grid_cost_s
        for cells, cost_s in ((pulled.turns, pulled.cost_s), (route.cells, pulled.grid_cost_s)):
            way = [(int(r), int(c)) for r, c in cells]
            exact = sum(segments.cost_s(pace, a, b, corner_cutting) for a, b in itertools.pairwise(way))
            assert cost_s == pytest.approx(2.5 * exact, rel=1e-12)


def test_over_open_ground_a_pulled_route_is_one_straight_segment() -> None:
    finder = RouteFinder(np.ones((200, 200)), (0, 0))
    pulled = finder.pull(finder.route(199, 83))
    assert pulled.turns.tolist() == [[199, 83], [0, 0]]
    assert pulled.cost_s == pulled.length_m == pytest.approx(math.hypot(199, 83), rel=1e-12)


def test_a_segment_through_an_exact_corner_needs_both_cells_beside_it() -> None:
    pace = np.ones((3, 3))
    pace[0, 1] = np.inf
    straight = [[2, 2], [0, 0]]
    assert RouteFinder(pace, (0, 0), corner_cutting=True).route(2, 2).cells.shape == (3, 2)
    for corner_cutting in (True, False):
        finder = RouteFinder(pace, (0, 0), corner_cutting=corner_cutting)
        assert (finder.pull(finder.route(2, 2)).turns.tolist() == straight) is corner_cutting


def test_a_route_that_a_change_has_shut_is_not_pulled() -> None:
    finder = RouteFinder(np.ones((1, 5)), (0, 0))
    route = finder.route(0, 4)
    finder.change(np.inf, 0, 2)
    with pytest.raises(ValueError, match="shut by now"):
        finder.pull(route)
    with pytest.raises(ValueError, match="unreachable"):
        finder.pull(finder.route(0, 4))


def random_ground(random: np.random.Generator, rows: int, cols: int, lethal: float) -> NDArray[np.float32]:
    pace = random.uniform(0.2, 3.0, (rows, cols)).astype(np.float32)
    pace[random.random((rows, cols)) < lethal] = np.inf
    pace[0, 0] = 1.0
    return pace


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from((0.0, 0.2)), st.booleans(), st.sampled_from((4, 8)))
def test_cells_of_pulled_routes_are_those_that_their_segments_cross(
    seed: int, lethal: float, corner_cutting: bool, neighbours: Literal[4, 8]
) -> None:
    random = np.random.default_rng(seed)
    pace = random_ground(random, *random.integers(2, 30, 2).tolist(), lethal)
    config = PlannerConfig(corner_cutting=corner_cutting, neighbours=neighbours)
    finder = RouteFinder(pace, (0, 0), corner_cutting=corner_cutting, neighbours=neighbours)
    starts = random.choice(np.flatnonzero(np.isfinite(pace)), 4)
    batch = finder._tree.routes([*starts.tolist(), -1])
    pulled = Puller(pace, 1.0, config).pull_batch(batch)
    same = RouteBatch.of(list(batch))  # read-only, as those of a search are
    assert list(Puller(pace, 1.0, config).pull_batch(same)) == list(pulled)
    for before, route in zip(batch, pulled, strict=True):
        assert (route.status, route.start, route.cost_s) == (before.status, before.start, before.cost_s)
        if not before.directions:
            assert not route.legs
            continue
        cells = [divmod(cell, pace.shape[1]) for cell in walk(finder.grid, route.start, route.directions)]
        legs = [(cells[a], cells[b], cells[a : b + 1]) for a, b in itertools.pairwise(route.turns)]
        assert cells[-1] == (0, 0)
        assert len(set(cells)) == len(cells)
        assert neighbours == 8 or all(abs(a - c) + abs(b - d) == 1 for (a, b), (c, d) in itertools.pairwise(cells))
        for start, end, along in legs:
            assert along == [cell for cell, _ in segments.crossed(start, end)[0]]
            assert math.isfinite(segments.cost_s(pace, start, end, corner_cutting))
        assert route.length_m == pytest.approx(sum(math.dist(a, b) for a, b, _ in legs), rel=1e-12)
    assert encode_again(pulled) == list(pulled)


def test_a_route_that_would_come_back_to_a_cell_is_not_pulled() -> None:
    """From the cell below the start a segment leads back over the start; a vehicle with a pushed route there begins
    the same loop again."""
    pace = np.array(
        [[1, 92.7, 3.2], [58.4, 12.9, 1.4], [10.3, 0.01, 17], [2.7, 6.4, 0.01], [0.1, 8.6, 0.01], [0.2, 0.9, 2.4]],
        np.float32,
    )
    finder = RouteFinder(pace, (0, 0), resolution_m=2.0, neighbours=4)
    batch = finder._tree.routes([11, 5])  # (3, 2), and one above it
    one, other = Puller(pace, 2.0, PlannerConfig(neighbours=4)).pull_batch(batch)
    assert one.directions == batch[0].directions
    assert one.turns == tuple(range(len(one.directions) + 1))
    assert one.length_m == batch[0].length_m
    cells = walk(finder.grid, other.start, other.directions)
    assert len(set(cells)) == len(cells)
    route = finder.route(3, 2)
    pulled = finder.pull(route)
    assert pulled.turns.tolist() == route.cells.tolist()
    assert pulled.cost_s == pulled.grid_cost_s
    assert pulled.length_m == route.length_m


def encode_again(batch: RouteBatch) -> list[Route]:
    columns = batch.columns()
    columns.relate()
    return list(columns)


class Drive:
    """A vehicle that sets out on a pulled route over random ground. It has one unless `cells` is empty."""

    def __init__(self, seed: int, lethal: float, resolution_m: float = 1.0) -> None:
        self.random = np.random.default_rng(seed)
        self.pace = random_ground(self.random, 24, 24, lethal)
        self.finder = RouteFinder(self.pace, (0, 0), resolution_m=resolution_m)
        self.start = int(self.random.choice(np.flatnonzero(np.isfinite(self.pace))))
        found = self.finder._tree.routes([self.start])
        self.route = Puller(self.pace, resolution_m, PlannerConfig()).pull_batch(found)[0]
        self.cells: list[int] = []
        self.follower, self.motion = Follower(), Motion(self.finder.grid, self.start)
        if self.route.status is RouteStatus.OK and self.route.directions:
            self.cells = walk(self.finder.grid, self.start, self.route.directions)
            assert self.follower.begin(self.cells, self.cells[:1], turns=self.route.turns)

    def point(self, cell: int) -> tuple[float, float] | None:
        return self.follower.point(cell, 24)


SEEDS, LETHAL = st.integers(0, 2**32 - 1), st.sampled_from((0.0, 0.2))


@settings(max_examples=60)
@given(SEEDS, LETHAL)
def test_who_drives_a_pulled_route_takes_its_integral_and_is_in_its_cells_all_the_way(
    seed: int, lethal: float
) -> None:
    drive = Drive(seed, lethal)
    motion, took_s = drive.motion, 0.0
    for cell in drive.cells[1:]:
        motion.set_out(cell, drive.point(cell))
        while not motion.at_rest:
            occupied, tick_s = motion.cell, float(drive.random.uniform(0.05, 1.0))
            took_s += tick_s - motion.advance(tick_s, float(drive.pace.item(occupied)))
            east, south = motion.place_m()
            row, col = divmod(motion.cell, 24)
            assert max(abs(south - row - 0.5), abs(east - col - 0.5)) <= 0.5 + 1e-9
        drive.follower.moved(cell)
    if drive.cells:
        route = drive.finder.route(*divmod(drive.start, 24))
        assert took_s == pytest.approx(drive.finder.pull(route).cost_s, rel=1e-9)


@settings(max_examples=30)
@given(SEEDS, LETHAL)
def test_dynamics_know_how_long_a_pulled_route_is_and_where_it_turns(seed: int, lethal: float) -> None:
    """On cells that a segment crosses there is no turn, and no more way than the segment is long."""
    drive = Drive(seed, lethal, resolution_m=5.0)
    if not 1 < len(drive.route.directions) <= 20:  # what a vehicle looks ahead
        return
    asked: list[Stretch] = []

    class Says:
        def speed(self, stretch: Stretch) -> float:
            asked.append(stretch)
            return 1.0

    dynamics, cells = PluginDynamics(Says(), drive.finder.grid, None), drive.cells
    drive.motion.set_out(cells[1], drive.point(cells[1]))
    dynamics.begin(0.1)
    dynamics.advance("v", drive.motion, cells, 0.1, 0.1, drive.point)
    assert asked[0].ahead_m == pytest.approx(drive.route.length_m, rel=1e-12)
    corners = [np.divmod(np.array(cells)[turn], 24) for turn in drive.route.turns]
    assert len(asked[0].turns) == len(corners) - 2
    legs_m = [5.0 * math.dist(a, b) for a, b in itertools.pairwise(corners)]
    assert [at_m for at_m, _ in asked[0].turns] == pytest.approx(list(itertools.accumulate(legs_m))[:-1])


def test_a_vehicle_drives_through_the_middles_where_a_planner_lies_about_a_segment() -> None:
    follower = Follower()
    around = [0, 1, 2, 12, 22, 21, 20]  # in a grid of 10 columns; a segment from 0 to 20 crosses none but 10
    assert follower.begin(around, [0], turns=(0, 6))
    assert [follower.point(cell, 10) for cell in around] == [None] * 7


@pytest.mark.parametrize("legs", [[3], [1, 2], [1], [2, 1], [0, 2], [2, 0]])
def test_legs_that_do_not_end_with_their_route_are_refused(legs: list[int]) -> None:
    fields = {"status": RouteStatus.OK, "start": 0, "cost_s": 1.0}
    told = PushedRoute(
        vehicle="a", target="t", incarnation=1, target_cell=2, map_version=0,
        route=Route(**fields, directions=b"\2\2", legs=np.array([2], "<u4").tobytes()),
    )  # fmt: skip
    payload = encode(told)
    assert decode(payload, PushedRoute) == told
    good, bad = b"\xc4\x04\2\0\0\0", np.array(legs, "<u4").tobytes()
    assert payload.count(good) == 1
    with pytest.raises(ProtocolError):
        decode(payload.replace(good, bytes([0xC4, len(bad)]) + bad), PushedRoute)
    routes = RouteBatch.of([Route(**fields, directions=b"\2\2"), Route(status=RouteStatus.NO_TARGET, start=3)])
    columns = routes.columns()
    assert [*columns.statuses] == [OK, NO_TARGET]
    with pytest.raises(ValueError, match="legs"):
        Routes(
            **{name: getattr(columns, name) for name in Routes.__struct_fields__ if name != "legs"}, legs=bad
        ).check_bounds()


def test_a_client_refuses_a_segment_that_ends_where_it_begins() -> None:
    """East and back west as one segment: no position on it is defined."""
    frame = Frame(GridSpec(9, 9, 1.0))
    legs = np.array([2], "<u4").tobytes()
    for directions, refused in ((b"\2\6", True), (b"\2\2", False)):
        route = Route(status=RouteStatus.OK, start=0, cost_s=1.0, directions=directions, legs=legs)
        told = PushedRoute(vehicle="a", target="t", incarnation=1, target_cell=2, map_version=0, route=route)
        assert decode(encode(told), PushedRoute) == told
        if refused:
            with pytest.raises(ValueError, match="ends where it begins"):
                ClientRoute.of(frame, route, told)
        else:
            assert ClientRoute.of(frame, route, told).ahead(0.0, 0.0, 1.0)


def test_a_route_that_is_not_pulled_beside_one_that_is_goes_step_by_step() -> None:
    pulled = Route(
        status=RouteStatus.OK, start=0, directions=b"\2\3", cost_s=1.0, legs=np.array([2], "<u4").tobytes()
    )
    other = Route(status=RouteStatus.OK, start=5, directions=b"\4\4\4", cost_s=1.0)
    one, two = RouteBatch.of([pulled, other])
    assert one == pulled
    assert two.turns == (0, 1, 2, 3)
