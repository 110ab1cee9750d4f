"""The cell that a vehicle occupies, however it is driven."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.grid import GridSpec
from vehicle_agent.driving.motion import Motion, roll, together

GRID = GridSpec(rows=5, cols=5, resolution_m=10.0)
ACTS = st.lists(
    st.one_of(
        st.tuples(st.just("set out"), st.sampled_from([-6, -5, -4, -1, 1, 4, 5, 6])),
        st.tuples(st.just("advance"), st.floats(0.0, 3.0)),
        st.just(("turn back", 0)),
    ),
    max_size=30,
)


@given(ACTS, st.floats(0.05, 2.0))
def test_a_vehicle_is_in_its_tail_until_it_is_driven_to_the_border(acts, pace_s_per_m):
    motion = Motion(GRID, 12)
    for act, value in acts:
        if act == "set out" and motion.at_rest:
            row, col = divmod(motion.head, 5)
            step = next((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if 5 * i + j == value)
            if 0 <= row + step[0] < 5 and 0 <= col + step[1] < 5:
                motion.set_out(motion.head + int(value))
        elif act == "advance":
            motion.advance(value, pace_s_per_m)
        elif act == "turn back":
            motion.turn_back()
        assert motion.cell == (motion.tail if motion.done_m < motion.border_m else motion.head)
        assert motion.at_rest == (motion.tail == motion.head)


@given(st.lists(st.tuples(st.floats(0.0, 1.2), st.booleans()), max_size=40), st.floats(-0.4, 0.4))
def test_motions_that_roll_together_are_where_each_would_be_that_is_driven_alone(ticks, aside):
    """One in the middle, one at rest, and one beside it, whose stretch bends at the border."""
    paces = np.linspace(0.05, 0.2, GRID.cells).astype(np.float32)
    alone, rolled = [[Motion(GRID, cell) for cell in (6, 12, 17)] for _ in range(2)]
    for motion in (*alone[::2], *rolled[::2]):
        motion.set_out(motion.head + 1, (motion.head // 5 + aside, motion.head % 5 + 1.0))
    rows = together(rolled)
    for seconds, turns in ticks:
        for motion in rolled:
            if not motion.at_rest:
                motion.roll_on(motion.head, 1.5, counts=True)
        on = roll(rows, paces, seconds).tolist()
        for one, other, rolls in zip(alone, rolled, on, strict=True):
            one.advance(seconds, 1.5 * paces.item(one.head))
            if not rolls:
                other.advance(seconds, 1.5 * paces.item(other.head))
            if turns:
                one.turn_back()
                other.turn_back()
            assert (one.cell, one.at_rest, one.done_m) == (other.cell, other.at_rest, other.done_m)
            assert one.place_m() == other.place_m()


def test_a_vehicle_that_turns_back_heads_where_it_came_from_over_as_many_metres() -> None:
    motion = Motion(GRID, 12)
    motion.set_out(13)  # east
    motion.advance(0.2, 0.1)
    motion.turn_back()
    assert motion.heading_rad == pytest.approx(1.5 * math.pi)
    assert (motion.head, motion.entering, motion.left_m) == (12, None, pytest.approx(2.0))
    assert motion.place_m() == pytest.approx((27.0, 25.0))
    assert motion.advance(1.0, 0.1) == pytest.approx(0.8)
    assert motion.place_m() == (25.0, 25.0)


def test_a_pulled_step_passes_the_border_where_its_own_line_does() -> None:
    """Its line leads from (2, 2) to a point beside the middle of the cell to the east."""
    motion = Motion(GRID, 12)
    motion.set_out(13, (2.4, 3.0))
    motion.advance(motion.border_m * 0.1, 0.1)
    east_m, south_m = motion.place_m()
    assert (east_m, south_m) == pytest.approx((30.0, 27.0))
    assert motion.length_m == pytest.approx(10.0 * math.hypot(1.0, 0.4))  # it has no bend


def test_a_vehicle_occupies_the_cell_that_its_point_is_in() -> None:
    motion = Motion(GRID, 6)
    motion.set_out(7)
    assert motion.advance(0.4, 0.1) == 0.0
    assert (motion.cell, motion.entering, motion.place_m()) == (6, 7, (19.0, 15.0))
    # One second a cell: the border after half of it, and there it stops to look around.
    assert motion.advance(0.6, 0.1) == pytest.approx(0.5)
    assert (motion.cell, motion.entering, motion.at_rest) == (7, None, False)
    assert motion.advance(0.7, 0.1) == pytest.approx(0.2)
    assert motion.at_rest
    assert motion.place_m() == (25.0, 15.0)


def test_a_diagonal_step_is_longer_and_heads_south_east() -> None:
    motion = Motion(GRID, 6)
    motion.set_out(12)
    left_s = motion.advance(motion.advance(2.0, 0.1), 0.1)
    assert left_s == pytest.approx(2.0 - math.sqrt(2.0))
    assert motion.heading_rad == pytest.approx(0.75 * math.pi)


def test_no_one_sets_out_for_a_cell_that_is_no_neighbour() -> None:
    with pytest.raises(ValueError, match="no step"):
        Motion(GRID, 9).set_out(10)


@given(st.lists(st.floats(0.01, 0.3), min_size=30, max_size=30))
def test_time_is_neither_lost_nor_won_by_cutting_it_up(slices: list[float]) -> None:
    motion = Motion(GRID, 0)
    spent_s, target = 0.0, 1
    for seconds in slices:
        left_s = seconds
        while left_s > 0.0 and target < GRID.cols:
            if motion.at_rest:
                motion.set_out(target)
            left_s = motion.advance(left_s, 0.1)
            target += motion.at_rest
        spent_s += seconds - left_s
    east_m, _ = motion.place_m()
    assert east_m == pytest.approx(5.0 + 10.0 * spent_s, abs=1e-3)
