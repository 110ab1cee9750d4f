"""Planning without a network: the example of the docs, and that no cell, target or pace ends the interpreter."""

import doctest
import math
from typing import Any, get_args

import numpy as np
import pytest
from support import slow_twins
from support.planner_strategies import random_pace

import planner_service
from planner_service import RouteFinder
from swarm.config.scenario import Strategy
from swarm.errors import ArgumentError, ConfigError, OutsideGridError
from swarm.wire.route_columns import RouteStatus, TargetStatus


def test_the_example_does_what_it_says() -> None:
    assert doctest.testmod(planner_service).failed == 0


@pytest.mark.parametrize("strategy", get_args(Strategy))
def test_routes_are_driven_as_they_say_and_their_bounds_hold_while_target_and_map_change(strategy):
    pace = random_pace(np.random.default_rng(5), 30, 40, 8.0, 0.15)
    finder = RouteFinder(pace, target=(15, 10), resolution_m=5.0, strategy=strategy, k_min=0)
    for col in range(11, 30):
        finder.change([[1.0, 1.0]], row=15, col=col)
        pace[15, col : col + 2] = 1.0
        finder.move((15, col))
        optimum = slow_twins.cost_to_go(pace, 15 * 40 + col) * 5.0
        for row, start in ((0, 0), (29, 39), (15, 20), (3, 30)):
            found = finder.route(row, start)
            if found.status is RouteStatus.OK:
                rows, cols = found.cells[1:].T
                steps = np.hypot(*np.diff(found.cells, axis=0).T) * 5.0
                assert found.cost_s == pytest.approx(float((pace[rows, cols] * steps).sum()), rel=1e-5)
                assert found.length_m == pytest.approx(float(steps.sum()))
                assert found.lower_bound_s <= optimum[row, start] * (1 + 1e-9)
                assert found.gap >= 1.0
            else:
                assert math.isinf(optimum[row, start])


def test_every_cell_has_an_answer_and_none_ends_the_interpreter() -> None:
    pace = np.ones((6, 7), np.float32)
    pace[2, 2] = np.inf
    finder = RouteFinder(pace, target=(0, 0))
    for row, col in ((-1, 0), (0, -1), (6, 0), (0, 7), (10**6, 10**9), (-(10**12), 3)):
        found = finder.route(row, col)
        assert (found.status, found.gap) == (RouteStatus.OUTSIDE, math.inf)
        with pytest.raises(OutsideGridError, match="6 x 7"):
            finder.move((row, col))
    assert finder.route(2, 2).status is RouteStatus.LETHAL_START
    assert finder.route(5, 6).status is RouteStatus.OK
    finder.move((2, 2))
    assert finder.route(5, 6).status is TargetStatus.LETHAL
    assert np.isinf(finder.cost_to_go_s()).all()
    finder.move((5, 5))
    assert finder.route(5, 6).cost_s == 1.0


def test_a_change_that_is_refused_changes_nothing() -> None:
    finder = RouteFinder(np.ones((6, 7)), target=(0, 0))
    before = finder.cost_to_go_s()
    for block, row, col in (
        ([[1.0]], 6, 0),
        ([[1.0, 1.0]], 0, 6),
        ([[np.nan]], 1, 1),
        ([[0.0]], 1, 1),
        ([[1]], -1, 0),
    ):
        with pytest.raises(ValueError, match=r"^rows .* and columns .* are not inside 6 x 7 cells|a pace is"):
            finder.change(block, row, col)
    np.testing.assert_array_equal(finder.cost_to_go_s(), before)


@pytest.mark.parametrize(
    ("block", "row", "col"), [(np.full((1, 3), np.inf), 5, 4), (np.full((3, 1), np.inf), 3, 6)]
)
def test_a_block_may_end_at_the_border_of_the_grid(block: Any, row: int, col: int) -> None:
    finder = RouteFinder(np.ones((6, 7)), target=(0, 0))
    finder.change(block, row, col)
    assert np.isinf(finder.cost_to_go_s()).sum() == 3


def test_a_place_between_cells_and_an_unknown_setting_are_refused() -> None:
    finder = RouteFinder(np.ones((6, 6)), (5, 5))
    for call in (finder.route, lambda *place: finder.move(place), lambda *place: finder.change([[1.0]], *place)):
        with pytest.raises(TypeError, match=r"\(2\.9, 1\) is no cell, which is two whole numbers"):
            call(2.9, 1)
    for place in ((1, 1, 1), (1,), "11", 1, (1, np.nan), (True, 1), (np.True_, 1), (10**30, 1)):
        with pytest.raises(TypeError, match="is no cell"):
            finder.between((1, 1), place)  # type: ignore[arg-type]
    for key, odd in (("resolution_m", True), ("resolution_m", "10"), ("climb", "up")):
        with pytest.raises(TypeError, match=f"{key} is {odd!r}, expected"):
            RouteFinder(np.ones((6, 6)), **{key: odd})
    with pytest.raises(TypeError, match="route is None, expected FoundRoute"):
        finder.pull(None)  # type: ignore[arg-type]
    for key, value, words in (
        ("strateg", "full", "'strategy'"),
        ("resolution", 10.0, "unknown key resolution; did you mean 'resolution_m'"),
        ("edge", "pap", "'paper'"),
        ("k_min", 99, "0 to 12"),
    ):
        with pytest.raises(ConfigError, match=words):
            RouteFinder(np.ones((6, 6)), (5, 5), **{key: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "pace", [np.nan, 0, -1, 1e39, 1e-50, True, "2", None, 1j, np.ma.masked_equal([[1.0]], 1.0)]
)
def test_what_is_no_pace_is_refused_with_and_without_a_target(pace: Any) -> None:
    ground = np.ones((3, 3))
    ragged: Any = [[1.0, 2.0], [3.0]]
    with pytest.raises(ArgumentError, match="pace is object"):
        RouteFinder(ragged, target=(0, 0))
    for shape, complaint in ((4, "1 dimensions, expected 2"), ((0, 3), "at least one cell")):
        with pytest.raises(ValueError, match=complaint):
            RouteFinder(np.ones(shape), target=(0, 0))
    for call in (lambda: RouteFinder(np.atleast_2d(pace)), lambda: RouteFinder(ground, (0, 0)).change(pace)):
        with pytest.raises(ValueError, match="pace is"):
            call()


def test_a_route_between_any_cells_is_the_one_to_a_target_there() -> None:
    pace = random_pace(np.random.default_rng(8), 60, 70, 6.0, 0.15)
    pace[0, 0] = pace[30, 40] = pace[33, 42] = 1.0
    finder = RouteFinder(pace, resolution_m=5.0)
    for change in ([[1.0]], [[np.inf]], [[2.5, 3.0]]):
        finder.change(change, row=31, col=41)
        pace[31, 41 : 41 + len(change[0])] = change[0]
        known = RouteFinder(pace, target=(30, 40), resolution_m=5.0)
        for start in ((0, 0), (33, 42), (30, 40), (31, 41), (-1, 3)):
            found, expected = finder.between(start, (30, 40)), known.route(*start)
            assert found.status == expected.status
            assert found.cost_s == pytest.approx(expected.cost_s, rel=1e-5)
            assert found.lower_bound_s <= expected.cost_s
            assert found.length_m >= 0
    assert finder.between((0, 0), (0, 0)).cost_s == 0
    assert RouteFinder(pace).route(0, 0).status is RouteStatus.NO_TARGET
