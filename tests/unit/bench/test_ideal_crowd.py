"""The bound of crowds: who may follow drives faster, in every world, and none share a cell."""

import pytest
from bench.whole_swarm.ideal_crowd import drive_ideal

from launch_scripts.simulation.sample_worlds import CROWDS, crowd


@pytest.mark.parametrize("kind", CROWDS)
def test_an_ideal_crowd_drives_most_of_the_time_and_more_than_one_that_may_not_follow(kind: str) -> None:
    _, terrain = crowd(kind, 3, 100, 25, 30)
    flows = [drive_ideal(terrain.pace_s_per_m, 100, 3, 60, follow)["cells_per_step"] for follow in (True, False)]
    assert 1.0 >= flows[0] > 1.2 * flows[1] > 0.0
