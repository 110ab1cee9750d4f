"""The cost of a route does not depend on the length of the part that is given."""

import numpy as np
import pytest

from planner_service.target_tree import TargetTree
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, walk

GRID = GridSpec(30, 60, 10.0)
TARGET = GRID.cell(15, 55)


@pytest.mark.parametrize("length_weight", [0.0, 0.05, 0.5])
def test_a_route_that_is_cut_has_the_travel_time_of_the_whole(length_weight: float) -> None:
    pace = np.random.default_rng(1).uniform(0.05, 0.6, (GRID.rows, GRID.cols)).astype(np.float32)
    pace[3, 3] = np.inf
    tree = TargetTree(GRID, PlannerConfig(strategy="full", length_weight=length_weight))
    tree.update(pace, TARGET, [], 1)
    cells = [GRID.cell(15, 3), GRID.cell(2, 40), TARGET, GRID.cell(3, 3), -1]
    whole, cut = tree.routes(cells), tree.routes(cells, 20)
    for long, short in zip(whole, cut, strict=True):
        assert long.status is short.status
        assert len(short.directions) <= 20
        np.testing.assert_allclose(short.cost_s, long.cost_s, rtol=1e-5)
        np.testing.assert_allclose(short.gap, long.gap, rtol=1e-5)
    assert cut[2].remaining_s == whole[2].remaining_s == 0.0
    first = cut[0]
    after = tree.routes([walk(GRID, first.start, first.directions)[-1]])[0]
    np.testing.assert_allclose(first.remaining_s, after.cost_s, rtol=1e-5)
