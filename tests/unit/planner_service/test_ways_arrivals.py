"""The earliest arrivals at every cell, against their slow twin."""

import numpy as np
import pytest
from support import slow_twins as naive
from support.kernel_oracle import loaded

from planner_service.target_search import Ways
from swarm.grid import GridSpec


@pytest.mark.parametrize("seed", range(4))
def test_arrivals_are_the_cheapest_ways_out_and_the_bound_of_large_maps_is_below(seed, monkeypatch):
    chance = np.random.default_rng(seed)
    pace = chance.uniform(0.02, 1.0, (24, 31)).astype(np.float32)
    pace[chance.random(pace.shape) < 0.2] = np.inf
    costs = loaded(pace, GridSpec(*pace.shape, 10.0), corner_cutting=True)
    start = int(chance.choice(np.flatnonzero(np.isfinite(pace))))
    # Ways out are ways in turned round, on which a step has the pace of the cell that it leaves.
    exact = 10.0 * naive.cost_to_go(pace, start, corner_cutting=True, left_share=1.0)
    ways = Ways(costs)
    np.testing.assert_allclose(ways.arrivals_s(start), exact, rtol=1e-5)
    monkeypatch.setattr("planner_service.target_search._MOST_CELLS", 0)
    bound = ways.arrivals_s(start)
    assert (bound <= exact * (1 + 1e-5)).all()
    assert (np.isinf(bound) == np.isinf(exact)).all()
