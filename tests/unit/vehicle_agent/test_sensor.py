"""Observations, and the marks which follow from them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind
from vehicle_agent.sensing.sensor import Sight, TruthSensor, compare

GRID = GridSpec(9, 9, 10.0)
CENTRE = 40
LEVEL = np.full((9, 9), 0.1, np.float32)


def changed(cells: dict[int, float]) -> NDArray[np.float32]:
    pace = LEVEL.copy()
    for cell, value in cells.items():
        pace.reshape(-1)[cell] = value
    return pace


@pytest.mark.parametrize(
    ("at", "range_m", "seen"),
    [
        (CENTRE, 20.0, [22, 30, 31, 32, 38, 39, 40, 41, 42, 48, 49, 50, 58]),
        (CENTRE, 1.0, [30, 31, 32, 39, 40, 41, 48, 49, 50]),  # the neighbours, however short the sight
        (8, 10.0, [7, 8, 16, 17]),  # nothing outside the grid
    ],
)
def test_all_cells_within_the_radius_are_seen_once_and_no_others(at, range_m, seen):
    assert sorted(TruthSensor(GRID, LEVEL, range_m).look([at]).cells.tolist()) == seen


def test_what_agrees_with_the_map_is_not_marked() -> None:
    sight = TruthSensor(GRID, changed({CENTRE: 0.1004}), 20.0).look([CENTRE])
    assert len(compare(sight, LEVEL, LEVEL)) == 0


def test_a_cell_that_two_vehicles_see_is_marked_once() -> None:
    truth = changed({41: math.inf})
    findings = compare(TruthSensor(GRID, truth, 20.0).look([40, 42]), LEVEL, LEVEL)
    assert findings.cells.tolist() == [41]


def test_the_sensor_sees_what_the_ground_is_now() -> None:
    truth = LEVEL.copy()
    sensor = TruthSensor(GRID, truth, 10.0)
    truth.reshape(-1)[41] = np.inf
    assert np.isinf(sensor.look([CENTRE]).paces).sum() == 1


paces = st.sampled_from([0.1, 0.2, math.inf])


@given(*(st.lists(paces, min_size=81, max_size=81) for _ in range(3)))
def test_after_the_marks_are_applied_nothing_differs_any_more(true, mapped, prior):
    truth, ground, before = (np.array(values, np.float32).reshape(9, 9) for values in (true, mapped, prior))
    sight = Sight(np.arange(81), truth.reshape(-1))
    findings = compare(sight, ground, before)
    flat = ground.reshape(-1)
    for cell, kind, pace in zip(findings.cells, findings.kinds, findings.paces, strict=True):
        known = {MarkKind.LETHAL: math.inf, MarkKind.PACE: pace, MarkKind.CLEAR: before.reshape(-1)[cell]}
        flat[cell] = known[MarkKind(int(kind))]
    assert (flat == truth.reshape(-1)).all()
    assert len(compare(sight, ground, before)) == 0
