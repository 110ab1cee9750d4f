"""Targets as obstacles: speed and heading are taken from poses, and a jump leaves nothing behind."""

import math

import pytest

from swarm.clock import NS_PER_S
from swarm.config.toml_files import parse_scenario
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.wire.messages.planning import TargetPose
from vehicle_agent.traffic.obstacles import Obstacles, TargetObstacles

GRID = GridSpec(20, 20, 10.0)
NOW = 10**18
TEXT = """
targets = [{{ name = "t", obstacle_radius_m = {radius} }}, {{ name = "soft" }}]
vehicles = {{ capture_range_m = 30 }}
"""


def pose(col: float, target: str = "t", jumps: int = 0) -> TargetPose:
    return TargetPose(
        target=target, incarnation=1, seq=1, stamp_ns=0, cell=0, x_m=col * 10.0, y_m=-55.0, jumps=jumps
    )


def cells(obstacles: Obstacles) -> set[tuple[int, int]]:
    return {divmod(cell, 20) for cell in range(GRID.cells) if cell in obstacles.closed}


def test_a_target_closes_its_cell_and_those_that_it_drives_to() -> None:
    made, obstacles = TargetObstacles(parse_scenario(TEXT.format(radius=2)), GRID), Obstacles(GRID)
    for number, col in enumerate((3.5, 4.5)):
        (obstacle,) = made.obstacles_of(pose(col), NOW + number * NS_PER_S // 2)
        obstacles.take_report(obstacle, NOW)
    assert obstacle.heading_rad == pytest.approx(math.pi / 2)
    assert obstacle.speed_m_per_s == pytest.approx(20.0)
    assert cells(obstacles) == {(5, 4), (5, 5)}


def test_a_captured_target_that_jumps_leaves_its_old_place_open_and_nobody_is_told_that_it_leaps() -> None:
    made, obstacles = TargetObstacles(parse_scenario(TEXT.format(radius=2)), GRID), Obstacles(GRID)
    for number, (col, jumps) in enumerate(((3.5, 0), (15.5, 1))):
        for obstacle in made.obstacles_of(pose(col, jumps=jumps), NOW + number * NS_PER_S // 5):
            obstacles.take_report(obstacle, NOW + number * NS_PER_S // 5)
    assert cells(obstacles) == {(5, 15)}
    assert obstacles.complaints == []


def test_a_target_without_a_radius_is_no_obstacle() -> None:
    made = TargetObstacles(parse_scenario(TEXT.format(radius=2)), GRID)
    assert made.obstacles_of(pose(3.5, "soft"), NOW) == []


def test_an_obstacle_that_leaves_no_cell_within_capture_range_is_refused() -> None:
    scenario = parse_scenario(TEXT.format(radius=11))
    with pytest.raises(ConfigError, match="capture_range_m is 30, expected at least 31"):
        TargetObstacles(scenario, GRID)
