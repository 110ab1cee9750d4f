"""Routes on their way to be driven."""

import contextlib

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from swarm.grid import GridSpec, walk
from swarm.wire.route_columns import directions_of
from vehicle_agent.driving.driven_vehicle import Follower

GRID = GridSpec(10, 10, 10.0)


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
