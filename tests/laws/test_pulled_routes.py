"""Pulled routes against segments whose crossings are fractions: what they cost, and what they may not touch."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.effort import few

from planner_service.route_finder import RouteFinder

Cell = tuple[int, int]


def crossed(start: Cell, end: Cell) -> tuple[list[tuple[Cell, Fraction]], list[tuple[Cell, Cell]]]:
    """Of a segment between centres: the cells that it crosses with their share of it, and the exact corners that
    it passes, each as the two cells beside it."""
    steps = [end[k] - start[k] for k in (0, 1)]
    met: list[dict[Fraction, int]] = [
        {Fraction(2 * i + 1, 2 * abs(n)): k for i in range(abs(n))} for k, n in enumerate(steps)
    ]  # where it meets lines between rows, and between cols
    marks = sorted({Fraction(0), Fraction(1), *met[0], *met[1]})
    shares = []
    for early, late in itertools.pairwise(marks):
        middle = (early + late) / 2
        half = Fraction(1, 2)
        at = (math.floor(start[0] + steps[0] * middle + half), math.floor(start[1] + steps[1] * middle + half))
        shares.append((at, late - early))
    corners = []
    for t in met[0].keys() & met[1].keys():
        before, after = (
            next(cell for (cell, _), m in zip(shares, marks[1:], strict=True) if m == t),
            next(cell for (cell, _), m in zip(shares, marks, strict=False) if m == t),
        )
        corners.append(((before[0], after[1]), (after[0], before[1])))
    return shares, corners


def twin_cost_s(pace: NDArray[np.float32], start: Cell, end: Cell, corner_cutting: bool) -> float:
    shares, corners = crossed(start, end)
    touched = [cell for cell, _ in shares]
    if not corner_cutting:
        touched += [cell for pair in corners for cell in pair]
    if not all(np.isfinite(pace[cell]) for cell in touched):
        return math.inf
    exact = sum(Fraction(float(pace[cell])) * share for cell, share in shares)
    return float(exact) * math.dist(start, end)


@settings(max_examples=few(120), deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(2, 24),
    st.integers(2, 24),
    st.sampled_from((0.0, 0.1, 0.3)),
    st.booleans(),
    st.sampled_from((4, 8)),
)
def test_a_pulled_route_costs_its_integral_is_never_dearer_and_touches_nothing_lethal(
    seed: int, rows: int, cols: int, lethal: float, corner_cutting: bool, neighbours: Literal[4, 8]
) -> None:
    random = np.random.default_rng(seed)
    pace = random.uniform(0.2, 3.0, (rows, cols)).astype(np.float32)
    pace[random.random((rows, cols)) < lethal] = np.inf
    pace[0, 0] = 1.0
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
            exact = sum(twin_cost_s(pace, a, b, corner_cutting) for a, b in itertools.pairwise(way))
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
