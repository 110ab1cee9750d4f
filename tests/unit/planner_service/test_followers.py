"""Followers: whoever asks, from wherever, the planner keeps a bounded number of them, each on the grid."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from planner_service import followers as module
from planner_service.followers import Followers
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, Window, walk
from swarm.wire.fields import pack_column
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.routes import Route, RouteOutline, RouteStatus

GRID = GridSpec(20, 30, 10.0)


@given(st.lists(st.tuples(st.integers(-(1 << 31), (1 << 32) - 1), st.sampled_from(RouteStatus))))
def test_no_follower_stands_outside_the_grid_whatever_status_its_answer_had(
    asked: list[tuple[int, RouteStatus]],
) -> None:
    followers = Followers("t", GRID, 10, 0)
    for n, (cell, status) in enumerate(asked):
        seconds = 1.0 if status is RouteStatus.OK else math.inf
        route = Route(
            status=status, start=cell, cost_s=seconds, lower_bound_s=seconds, length_m=seconds, remaining_s=0.0
        )
        followers.given(f"v{n}", route, 0, 0, 0)
    assert all(0 <= each.cell < GRID.cells for each in followers.all())
    followers.touch(Window(0, 0, 5, 5), [Window(3, 3, 9, 9)])


def test_beyond_the_capacity_those_registered_first_make_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CAPACITY", 3)
    followers = Followers("t", GRID, 100, 0)
    for n in range(5):
        followers.given(f"v{n}", Route(status=RouteStatus.UNREACHABLE, start=n), 0, n, 0)
    assert [each.cell for each in followers.all()] == [2, 3, 4]


def test_a_tick_pushes_a_bounded_number_and_every_follower_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_PUSHES", 4)
    followers = Followers("t", GRID, 10**6, 0)
    for n in range(10):
        followers.given(f"v{n}", Route(status=RouteStatus.UNREACHABLE, start=n), 0, 0, n)
    pushed: list[str] = []
    for now_ns in (100, 101, 102):
        followers.touch(GRID.window, [])
        for id, follower in list(followers.due(now_ns)):
            pushed.append(id)
            followers.sent(follower, Route(status=RouteStatus.UNREACHABLE, start=follower.cell), now_ns + 1000)
    assert sorted(pushed) == sorted(f"v{n}" for n in range(10))


places = st.tuples(st.integers(0, 19), st.integers(0, 29))


@st.composite
def routes(draw: st.DrawFn) -> Route:
    """A route of any steps, which stays on the grid; it may turn back and cross itself."""
    row, col = draw(places)
    start, directions = GRID.cell(row, col), []
    for direction in draw(st.lists(st.integers(0, 7), max_size=25)):
        if GRID.inside(row + STEP_ROW[direction], col + STEP_COL[direction]):
            row, col = row + STEP_ROW[direction], col + STEP_COL[direction]
            directions.append(direction)
    if not draw(st.integers(0, 4)):
        return Route(status=RouteStatus.UNREACHABLE, start=start)
    return Route(
        status=RouteStatus.OK,
        start=start,
        directions=bytes(directions),
        cost_s=1.0,
        lower_bound_s=1.0,
        length_m=1.0,
    )


@st.composite
def windows(draw: st.DrawFn) -> list[Window]:
    corners = draw(st.lists(st.tuples(places, st.integers(1, 4), st.integers(1, 4)), max_size=3))
    return [Window(row, col, min(row + rows, 20), min(col + cols, 30)) for (row, col), rows, cols in corners]


def crossed(route: Route, changed: list[Window]) -> bool:
    """As `Followers` has it, cell by cell."""
    if route.status is not RouteStatus.OK:
        return False
    on_route = [divmod(cell, GRID.cols) for cell in walk(GRID, route.start, route.directions)]
    return any(
        Window(w.row0 - 1, w.col0 - 1, w.row1 + 1, w.col1 + 1).contains(*place)
        for w in changed
        for place in on_route
    )


class FollowersMachine(RuleBasedStateMachine):
    """Whom a change concerns, whoever comes, goes and is given another route, is what looking at every cell of
    every route finds."""

    def __init__(self) -> None:
        super().__init__()
        self.followers = Followers("t", GRID, 10**9, 0)
        self.given: dict[str, tuple[Route, int]] = {}
        """Vehicle -> its route, and when it may be pushed another one."""
        self.stale: set[str] = set()
        self.heard = 0

    @rule(vehicle=st.sampled_from("abcde"), route=routes(), push_ns=st.integers(0, 3))
    def give(self, vehicle: str, route: Route, push_ns: int) -> None:
        self.followers.given(vehicle, route, 0, 0, push_ns)
        self.given[vehicle] = route, push_ns
        self.stale.discard(vehicle)

    @rule(vehicles=st.sets(st.sampled_from("abcde")))
    def name(self, vehicles: set[str]) -> None:
        """Their agent says who they are: all others leave."""
        self.heard += 1
        ids = sorted(vehicles & self.given.keys())
        cells = pack_column([self.given[id][0].start for id in ids], "<u4")
        both = sorted(self.given)
        all_cells = pack_column([self.given[id][0].start for id in both], "<u4")
        for named, at in ((both, all_cells), (ids, cells)):
            self.followers.hear(Chasers(target="t", author="x", stamp_ns=self.heard, ids=named, cells=at), 0)
        self.given = {id: self.given[id] for id in ids}
        self.stale &= set(ids)

    @rule()
    def forget(self) -> None:
        self.followers.forget_routes()
        self.given = {
            id: (Route(status=RouteStatus.NO_TARGET, start=route.start), 0) for id, (route, _) in self.given.items()
        }
        self.stale = set(self.given)

    @rule(changed=windows(), now_ns=st.integers(0, 3))
    def ask(self, changed: list[Window], now_ns: int) -> None:
        concerned = any(crossed(route, changed) for route, push_ns in self.given.values() if now_ns >= push_ns)
        assert self.followers.any_due_in(changed, now_ns) == concerned

    @rule(changed=windows())
    def touch(self, changed: list[Window]) -> None:
        self.followers.touch(Window(0, 0, 0, 0), changed)
        self.stale |= {id for id, (route, _) in self.given.items() if crossed(route, changed)}
        assert {id for id, each in self.followers.all_items() if each.stale} == self.stale

    @rule(vehicle=st.sampled_from("abcde"), steps=st.integers(0, 25), route=routes())
    def read(self, vehicle: str, steps: int, route: Route) -> None:
        """Another route from a cell of the old one, or from elsewhere."""
        if vehicle not in self.given:
            return
        (follower,) = [each for id, each in self.followers.all_items() if id == vehicle]
        old = follower.route
        if old is None or old.status is not RouteStatus.OK:
            return
        cells = walk(GRID, old.start, old.directions)
        first = cells.index(cells[min(steps, len(cells) - 1)])
        rest = old.directions[first:]
        same = RouteOutline(RouteStatus.OK, cells[first], rest, 0.0)
        assert not self.followers.is_news(follower, same)
        if route.start not in cells:
            assert self.followers.is_news(follower, RouteOutline(RouteStatus.OK, route.start, rest, 0.0))


TestFollowers = FollowersMachine.TestCase
TestFollowers.settings = settings(deadline=None, max_examples=60, stateful_step_count=25)
