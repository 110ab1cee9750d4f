"""Targets as bodies: speed and heading are taken from poses, and a jump leaves nothing behind."""

from __future__ import annotations

import math

import pytest

from swarm.clock import NS_PER_S
from swarm.config.load import parse_scenario
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.wire.messages.planning import TargetPose
from vehicle_agent.bodies import Bodies, TargetBodies

GRID = GridSpec(20, 20, 10.0)
NOW = 10**18
TEXT = """
[[targets]]
name = "t"
body_radius_m = {radius}
[[targets]]
name = "soft"
[vehicles]
capture_range_m = 30
"""


def pose(col: float, target: str = "t", jumps: int = 0) -> TargetPose:
    return TargetPose(
        target=target, incarnation=1, seq=1, stamp_ns=0, cell=0, x_m=col * 10.0, y_m=-55.0, jumps=jumps
    )


def cells(bodies: Bodies) -> set[tuple[int, int]]:
    return {divmod(cell, 20) for cell in range(GRID.cells) if cell in bodies.closed}


def test_a_target_closes_its_cell_and_those_that_it_drives_to() -> None:
    made, bodies = TargetBodies(parse_scenario(TEXT.format(radius=2)), GRID), Bodies(GRID)
    for number, col in enumerate((3.5, 4.5)):
        (body,) = made.bodies_of(pose(col), NOW + number * NS_PER_S // 2)
        bodies.take_report(body, NOW)
    assert body.heading_rad == pytest.approx(math.pi / 2)
    assert body.speed_m_per_s == pytest.approx(20.0)
    assert cells(bodies) == {(5, 4), (5, 5)}


def test_a_captured_target_that_jumps_leaves_its_old_place_open_and_nobody_is_told_that_it_leaps() -> None:
    made, bodies = TargetBodies(parse_scenario(TEXT.format(radius=2)), GRID), Bodies(GRID)
    for number, (col, jumps) in enumerate(((3.5, 0), (15.5, 1))):
        for body in made.bodies_of(pose(col, jumps=jumps), NOW + number * NS_PER_S // 5):
            bodies.take_report(body, NOW + number * NS_PER_S // 5)
    assert cells(bodies) == {(5, 15)}
    assert bodies.complaints == []


def test_a_target_without_a_radius_is_no_body() -> None:
    made = TargetBodies(parse_scenario(TEXT.format(radius=2)), GRID)
    assert made.bodies_of(pose(3.5, "soft"), NOW) == []


def test_a_body_that_leaves_no_cell_within_capture_range_is_refused() -> None:
    scenario = parse_scenario(TEXT.format(radius=11))
    with pytest.raises(ConfigError, match="capture_range_m is 30, expected at least 31"):
        TargetBodies(scenario, GRID)
