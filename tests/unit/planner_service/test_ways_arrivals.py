"""The earliest arrivals at every cell, against scipy's Dijkstra over steps priced by the cell entered."""

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from planner_service.search.search_routes import Ways
from planner_service.tree.cost_grid import CostGrid
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec


def oracle_s(pace: np.ndarray, metres: float, start: int) -> np.ndarray:
    rows, cols = pace.shape
    tails, heads, prices = [], [], []
    for row, col in np.argwhere(np.isfinite(pace)):
        for south in (-1, 0, 1):
            for east in (-1, 0, 1):
                to = row + south, col + east
                if (south or east) and 0 <= to[0] < rows and 0 <= to[1] < cols and np.isfinite(pace[to]):
                    tails.append(row * cols + col)
                    heads.append(to[0] * cols + to[1])
                    prices.append(float(pace[to]) * metres * np.hypot(south, east))
    graph = csr_array((prices, (tails, heads)), shape=(pace.size, pace.size))
    return dijkstra(graph, indices=start).reshape(pace.shape)


@pytest.mark.parametrize("seed", range(4))
def test_arrivals_are_the_cheapest_ways_out_and_the_bound_of_large_maps_is_below(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    chance = np.random.default_rng(seed)
    pace = chance.uniform(0.02, 1.0, (24, 31)).astype(np.float32)
    pace[chance.random(pace.shape) < 0.2] = np.inf
    costs = CostGrid(GridSpec(*pace.shape, 10.0), PlannerConfig(corner_cutting=True))
    costs.load(pace)
    start = int(chance.choice(np.flatnonzero(np.isfinite(pace))))
    exact = oracle_s(pace, 10.0, start)
    ways = Ways(costs)
    np.testing.assert_allclose(ways.arrivals_s(start), exact, rtol=1e-5)
    monkeypatch.setattr("planner_service.search.search_routes._MOST_CELLS", 0)
    bound = ways.arrivals_s(start)
    assert (bound <= exact * (1 + 1e-5)).all()
    assert (np.isinf(bound) == np.isinf(exact)).all()
