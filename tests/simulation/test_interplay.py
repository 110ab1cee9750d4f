"""Obstacles, external vehicles, added agents, zones and orders at once, under all faults: what none of them breaks
alone."""

from __future__ import annotations

import pytest
from support.interplay import Interplay

from launch_scripts.simulation.laws import ROUTED_WITHIN_S


@pytest.mark.parametrize("seed", [4, pytest.param(9, marks=pytest.mark.thorough), 13])
def test_no_law_breaks_whatever_joins_leaves_and_is_ordered(seed: int) -> None:
    world = Interplay(seed)
    assert world.run() == []
    assert all(robot.moves > 0 for robot in world.robots)
    assert world.routed_after_s is not None
    # The last orders are taken back 2.3 s after the last fault, and a question that was lost before is asked again.
    assert world.routed_after_s < ROUTED_WITHIN_S + 3.0
