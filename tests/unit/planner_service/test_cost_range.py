"""The lowest and highest cell cost: an extreme cell that is another now leaves no trace."""

from unittest import mock

import numpy as np
import pytest

from planner_service.kernels.cell_costs import block_ranges
from planner_service.target_tree import TargetTree
from planner_service.tree import cost_changes as changes
from planner_service.tree.cost_grid import CostGrid
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.wire.messages.map_data import PACE_LEAST

GRID = GridSpec(256, 256, 10.0)


def hills() -> np.ndarray:
    return np.random.default_rng(1).uniform(0.05, 0.6, (GRID.rows, GRID.cols)).astype(np.float32)


@pytest.mark.parametrize("length_weight", [0.0, 0.5])
def test_a_change_of_an_extreme_cell_passes_over_its_own_blocks_only(length_weight: float) -> None:
    grid, pace = CostGrid(GRID, PlannerConfig(length_weight=length_weight)), hills()
    grid.load(pace)
    looked = []

    def look(bits: np.ndarray, which: np.ndarray, ranges: np.ndarray) -> None:
        looked.append(which.size)
        block_ranges(bits, which, ranges)

    where = np.unravel_index([np.argmin(pace), np.argmax(pace), 77], pace.shape)
    pace[where] = (0.5, 0.06, np.inf)
    windows = [Window(row, col, row + 1, col + 1) for row, col in np.transpose(where).tolist()]
    with mock.patch.object(changes, "block_ranges", look):
        assert grid.apply(pace, windows).cells.size == 3
    assert looked == [3] * (2 if length_weight else 1)
    time = pace[np.isfinite(pace)] * np.float32(10)
    cost = time + np.float32(length_weight * 10)
    assert (grid.lowest_cell_cost, grid.highest_cell_cost) == (float(cost.min()), float(cost.max()))
    assert grid.time_share == pytest.approx(time.min() / cost.min(), rel=1e-6)


@pytest.mark.parametrize("strategy", ["multi_resolution", "variable_range", "auto"])
@pytest.mark.parametrize("wrong", [1e-9, PACE_LEAST])
def test_one_wrong_mark_costs_windows_only_while_it_stands(strategy: str, wrong: float) -> None:
    config = PlannerConfig(strategy=strategy, k_min=1)  # type: ignore[arg-type]
    kinds = []
    for marked in (False, True):
        tree, pace = TargetTree(GRID, config), hills()
        tree.update(pace, GRID.cell(120, 120), [], 0)
        was = float(pace[20, 20])
        pace[20, 20] = wrong if marked else was
        tree.update(pace, GRID.cell(120, 120), [Window(20, 20, 21, 21)], 1)
        pace[20, 20] = was
        tree.update(pace, GRID.cell(120, 121), [Window(20, 20, 21, 21)], 2)
        kinds.append([tree.update(pace, GRID.cell(120, 122 + n), [], 3 + n).kind for n in range(5)])
        assert all(route.gap < 1.5 for route in tree.routes([GRID.cell(5, 5), GRID.cell(250, 9)]))
    assert kinds[0] == kinds[1]
    assert strategy == "auto" or set(kinds[0]) == {"window"}
