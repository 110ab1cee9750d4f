"""Followers: whoever asks, from wherever, the planner keeps a bounded number of them, each on the grid."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner_service import followers as module
from planner_service.followers import Followers
from swarm.grid import GridSpec, Window
from swarm.wire.routes import Route, RouteStatus

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
