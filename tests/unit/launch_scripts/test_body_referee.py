"""Blame for a hit between a body and a vehicle: the fault is that of the last to move in, if it was told in
time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.target_reports import fleet

from launch_scripts.simulation.world.referee import BodyHit, Referee
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Body, Fleet

GRID = GridSpec(10, 10, 10.0)
MS = 1_000_000


def body(at_ms: int, col: float, row: float = 5.5, **said: object) -> tuple[int, Body]:
    fields = {"id": "r1", "incarnation": 1, "seq": at_ms, "x_m": col * 10.0, "y_m": -row * 10.0, "radius_m": 1.0}
    return at_ms, Body(**(fields | {"lease_s": 1.0} | said))  # type: ignore[arg-type]


def vehicle(at_ms: int, col: int, row: int = 5) -> tuple[int, Fleet]:
    return at_ms, fleet(at_ms, ("a", row * 10 + col))


def judged(*reports: tuple[int, Body | Fleet]) -> list[BodyHit]:
    referee = Referee({"ground": np.ones(100, np.float32)}, GRID)
    hits = []
    for at_ms, report in sorted(reports, key=lambda each: each[0]):
        if isinstance(report, Body):
            referee.hear_body(report, at_ms * MS)
        else:
            hits += [each for each in referee.on_fleet(report) if isinstance(each, BodyHit)]
    return hits


def standing(from_ms: int, until_ms: int, col: float) -> list[tuple[int, Body]]:
    return [body(at, col) for at in range(from_ms, until_ms, 100)]


def on(from_ms: int, until_ms: int, col: int) -> list[tuple[int, Fleet]]:
    return [vehicle(at, col) for at in range(from_ms, until_ms, 100)]


def test_a_vehicle_that_enters_a_cell_which_a_body_has_closed_for_two_ticks_is_at_fault() -> None:
    (hit,) = judged(*standing(0, 2000, 5.5), *on(50, 1000, 4), *on(1050, 2000, 5))
    assert hit.by_vehicle
    assert hit.sentence == "a drove into body r1, which had closed the cell for 1.1 s"


def test_a_body_that_drives_into_a_vehicle_is_at_fault() -> None:
    (hit,) = judged(*on(50, 2000, 5), *standing(0, 1000, 3.5), *standing(1000, 2000, 5.5))
    assert not hit.by_vehicle
    assert hit.sentence == "body r1 drove into a, which was there first"


def test_a_vehicle_that_enters_where_a_body_has_just_come_had_no_time() -> None:
    (hit,) = judged(*on(50, 1000, 4), *on(1050, 2000, 5), *standing(900, 2000, 5.5))
    assert not hit.by_vehicle
    assert hit.sentence == "body r1 met a, 0.15 s after its first report of the cell"


def test_a_vehicle_that_crosses_the_way_on_which_a_body_comes_is_at_fault() -> None:
    """The body had closed the cell ahead of itself before it was there."""
    comes = [
        body(at, 2.5 + at / 1000 * 1.5, heading_rad=math.pi / 2, speed_m_per_s=15.0) for at in range(0, 2000, 100)
    ]
    (hit,) = judged(*comes, *on(50, 1600, 9), *on(1650, 2000, 5))
    assert hit.by_vehicle


@pytest.mark.parametrize("lease_s", [0.0, 0.3])
def test_a_body_whose_lease_has_ended_is_met_by_nobody(lease_s: float) -> None:
    assert judged(body(0, 5.5, lease_s=lease_s), *on(50, 900, 4), *on(950, 2000, 5)) == []


def test_an_overlap_that_late_messages_explain_is_no_hit() -> None:
    assert judged(*standing(0, 1000, 5.5), *standing(1000, 2000, 8.5), *on(50, 800, 4), *on(900, 2000, 5)) == []


def test_an_encounter_is_told_once_and_a_vehicle_of_which_reports_are_missing_is_not_blamed() -> None:
    hits = judged(*standing(0, 3000, 5.5), *on(50, 1000, 4), *on(1050, 3000, 5))
    assert len(hits) == 1
    (hit,) = judged(*standing(1000, 3000, 5.5), *on(50, 300, 4), *on(2050, 3000, 5))
    assert not hit.by_vehicle, "it may have come before the body"
