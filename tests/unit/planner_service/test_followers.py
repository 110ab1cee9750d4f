"""Followers: the planner keeps a bounded number of them, each on the grid, whatever is asked from anywhere."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner_service import followers as module
from planner_service.followers import Followers
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, Window, walk
from swarm.wire.fields import pack_column
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.route_columns import Route, RouteOutline, RouteStatus

GRID = GridSpec(20, 30, 10.0)


@given(st.lists(st.tuples(st.integers(-(1 << 31), (1 << 32) - 1), st.sampled_from(RouteStatus))))
def test_no_follower_stands_outside_the_grid_whatever_status_its_answer_had(asked):
    followers = Followers(GRID, 10, 0)
    for n, (cell, status) in enumerate(asked):
        seconds = 1.0 if status is RouteStatus.OK else math.inf
        route = Route(
            status=status, start=cell, cost_s=seconds, lower_bound_s=seconds, length_m=seconds, remaining_s=0.0
        )
        followers.given(f"v{n}", route, 0, 0, 0)
    assert all(0 <= each.cell < GRID.cells for _, each in followers.all_items())
    followers.touch(Window(0, 0, 5, 5), [Window(3, 3, 9, 9)])


def test_beyond_the_capacity_those_registered_first_make_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CAPACITY", 3)
    followers = Followers(GRID, 100, 0)
    for n in range(5):
        followers.given(f"v{n}", Route(status=RouteStatus.UNREACHABLE, start=n), 0, n, 0)
    assert [each.cell for _, each in followers.all_items()] == [2, 3, 4]


def test_a_tick_pushes_a_bounded_number_and_every_follower_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_PUSHES", 4)
    followers = Followers(GRID, 10**6, 0)
    for n in range(10):
        followers.given(f"v{n}", Route(status=RouteStatus.UNREACHABLE, start=n), 0, 0, n)
    pushed: list[str] = []
    for now_ns in (100, 101, 102):
        followers.touch(GRID.window, [])
        for id, follower in (each for batch in followers.due(now_ns).values() for each in batch):
            pushed.append(id)
            followers.sent(follower, Route(status=RouteStatus.UNREACHABLE, start=follower.cell), now_ns + 1000)
    assert sorted(pushed) == sorted(f"v{n}" for n in range(10))


def random_route(chance: random.Random) -> Route:
    """A route of any steps, which stays on the grid; it may turn back and cross itself."""
    row, col = chance.randrange(GRID.rows), chance.randrange(GRID.cols)
    start, directions = GRID.cell(row, col), []
    mostly = chance.randrange(8)
    for _ in range(chance.randrange(20)):
        direction = (mostly + chance.choice((0, 0, 0, 1, -1, 4))) % 8
        if GRID.inside(row + STEP_ROW[direction], col + STEP_COL[direction]):
            row, col = row + STEP_ROW[direction], col + STEP_COL[direction]
            directions.append(direction)
    if chance.random() < 0.2:
        return Route(status=RouteStatus.UNREACHABLE, start=start)
    return Route(status=RouteStatus.OK, start=start, directions=bytes(directions), cost_s=1.0, lower_bound_s=1.0)


def random_windows(chance: random.Random) -> list[Window]:
    corners = [(chance.randrange(GRID.rows), chance.randrange(GRID.cols)) for _ in range(chance.randrange(3))]
    return [Window(row, col, row + chance.randint(1, 3), col + chance.randint(1, 3)) for row, col in corners]


def crossed(route: Route, changed: list[Window]) -> bool:
    """True if a route passes windows or next to them, cell by cell."""
    if route.status is not RouteStatus.OK:
        return False
    on_route = [divmod(cell, GRID.cols) for cell in walk(GRID, route.start, route.directions)]
    wider = [Window(each.row0 - 1, each.col0 - 1, each.row1 + 1, each.col1 + 1) for each in changed]
    return any(window.contains(*place) for window in wider for place in on_route)


@pytest.mark.parametrize("seed", range(5))
def test_whom_a_change_concerns_is_what_looking_at_every_cell_of_every_route_finds(seed: int) -> None:
    """Followers come, go and are given other routes meanwhile."""
    chance = random.Random(f"followers/{seed}")
    followers = Followers(GRID, 10**9, 0)
    has: dict[str, tuple[Route, int]] = {}
    """Vehicle -> its route, and when it may be pushed another one."""
    stale: set[str] = set()
    found = 0
    for turn in range(1500):
        changed, now_ns = random_windows(chance), chance.randrange(4)
        match chance.randrange(8):
            case 0 | 1 | 2:
                vehicle, route = chance.choice("abcdef"), random_route(chance)
                has[vehicle] = route, chance.randrange(4)
                followers.given(vehicle, route, 0, 0, has[vehicle][1])
                stale.discard(vehicle)
            case 3 if chance.random() < 0.3:
                followers.forget_routes()
                has = {
                    id: (Route(status=RouteStatus.NO_TARGET, start=each.start), 0) for id, (each, _) in has.items()
                }
                stale = set(has)
            case 4:
                stay = sorted(chance.sample(sorted(has), chance.randint(0, len(has))))
                for named in (sorted(has), stay):
                    cells = pack_column([has[id][0].start for id in named], "<u4")
                    followers.on_chasers(Chasers(target="t", author="x", stamp_ns=turn, ids=named, cells=cells), 0)
                has = {id: has[id] for id in stay}
                stale &= set(stay)
            case 5:
                followers.touch(Window(0, 0, 0, 0), changed)
                stale |= {id for id, (route, _) in has.items() if crossed(route, changed)}
                found += len(stale)
            case _:
                concerned = any(crossed(route, changed) for route, push_ns in has.values() if now_ns >= push_ns)
                assert followers.any_due_in(changed, now_ns) == concerned
                found += concerned
        assert {id for id, each in followers.all_items() if each.stale} == stale
    assert found > 100


@pytest.mark.parametrize("seed", range(5))
def test_the_rest_of_a_route_is_no_news_from_any_of_its_cells(seed: int) -> None:
    chance = random.Random(f"news/{seed}")
    for _ in range(200):
        followers, old, other = Followers(GRID, 10**9, 0), random_route(chance), random_route(chance)
        followers.given("v", old, 0, 0, 0)
        ((_, follower),) = followers.all_items()
        if old.status is not RouteStatus.OK:
            continue
        cells = walk(GRID, old.start, old.directions)
        cell = chance.choice(cells)
        rest = old.directions[cells.index(cell) :]
        assert not followers.is_news(follower, RouteOutline(RouteStatus.OK, cell, rest, 0.0))
        turned = bytes((code + 1) % 8 for code in rest)
        assert not rest or followers.is_news(follower, RouteOutline(RouteStatus.OK, cell, turned, 0.0))
        assert other.start in cells or followers.is_news(
            follower, RouteOutline(RouteStatus.OK, other.start, rest, 0.0)
        )


def test_an_extension_is_pushed_once_half_of_the_old_route_is_driven() -> None:
    """A route cut after 8 steps to the east, which goes on beyond them."""
    followers, start = Followers(GRID, 10, 0), GRID.cell(5, 5)
    cut = Route(status=RouteStatus.OK, start=start, directions=bytes([2] * 8), cost_s=9.0, remaining_s=5.0)
    followers.given("v", cut, 8, 0, 0)
    ((_, follower),) = followers.all_items()

    def is_news(driven: int, *turned: int) -> bool:
        directions = bytes([2] * (8 - len(turned)) + list(turned))
        return followers.is_news(follower, RouteOutline(RouteStatus.OK, start + driven, directions, 5.0))

    assert [driven for driven in range(9) if is_news(driven)] == [5, 6, 7, 8]
    assert is_news(0, 3)  # other steps are news at once
    assert is_news(4, 3, 3, 3, 3, 3)


def test_that_there_is_no_way_is_told_once() -> None:
    followers = Followers(GRID, 10, 0)
    none = Route(status=RouteStatus.UNREACHABLE, start=7, cost_s=math.inf, lower_bound_s=math.inf)
    followers.given("v", none, 0, 0, 0)
    ((_, follower),) = followers.all_items()
    assert not followers.is_news(follower, RouteOutline(RouteStatus.UNREACHABLE, 7, b"", 0.0))
    assert followers.is_news(follower, RouteOutline(RouteStatus.OK, 7, b"\x02", 0.0))
