"""Growth beside an independent Dijkstra, on any grid and every rule."""

from typing import Any

import numpy as np
from support import slow_twins as naive
from support.planner_strategies import RULES, random_pace

from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.terrain.slope_and_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

RATIOS = (1.0, 2.0, 10.0, 100.0, 1e4, 1e6, 1e9)
WALLS = (0.0, 0.1, 0.25, 0.45)


def inner(tree: CostToGoTree, padded: np.ndarray) -> np.ndarray:
    """The (rows, cols) view of a padded array."""
    grid = tree.cost_grid.grid
    return padded.reshape(grid.rows + 2, grid.cols + 2)[1:-1, 1:-1]


def unpadded(cost_grid: CostGrid, padded: np.ndarray) -> np.ndarray:
    """The cells of the grid of padded ones."""
    rows, cols = np.divmod(padded, cost_grid.stride)
    return (rows - 1) * cost_grid.grid.cols + cols - 1


def loaded(pace: np.ndarray, grid: GridSpec | None = None, climb: Climb | None = None, **config: Any) -> CostGrid:
    """The costs of a map of paces, on cells of a metre where no grid is given, under the rules of the planner."""
    rows, cols = pace.shape
    costs = CostGrid(grid or GridSpec(rows, cols, 1.0), PlannerConfig(**config), climb)
    costs.load(pace)
    return costs


def grown(costs: CostGrid, root: int) -> CostToGoTree:
    """The tree of a map, grown from scratch."""
    tree = CostToGoTree(costs)
    tree.grow(root)
    return tree


def assert_equals_dijkstra(pace: np.ndarray, target: int, rules: dict[str, Any], rtol: float = 1e-5) -> None:
    tree = grown(loaded(pace, **rules), target)
    mine, parents = inner(tree, tree.cost), inner(tree, tree.parent)
    best = naive.cost_to_go(pace, target, **rules)
    np.testing.assert_allclose(mine, np.where(np.isfinite(pace), best, np.inf), rtol=rtol)
    # Every reachable cell's parent is a neighbour whose offer is what the cell costs.
    rows, cols = np.nonzero(np.isfinite(mine))
    codes = parents[rows, cols]
    away = codes != 255
    assert away.sum() == rows.size - 1
    rows, cols, codes = rows[away], cols[away], codes[away]
    r, c = rows + np.array(STEP_ROW)[codes], cols + np.array(STEP_COL)[codes]
    slanted = (codes % 2 == 1) & (rules["edge"] == "octile")
    step = pace[r, c].astype(np.float64) * np.where(slanted, np.sqrt(2.0), 1.0)
    np.testing.assert_allclose(mine[rows, cols], mine[r, c] + step, rtol=1e-5)


def random_grids(count: int, seed: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    for n in range(count):
        rows, cols = (int(side) for side in rng.integers(1, most, 2))
        pace = random_pace(rng, rows, cols, RATIOS[n % 7], WALLS[n // 7 % 4])
        target = int(rng.choice(np.flatnonzero(np.isfinite(pace))))
        assert_equals_dijkstra(pace, target, RULES[n // 28 % 5])
