"""The open cell nearest to a target on lethal ground, beside a search of all cells about it."""

import numpy as np
import pytest
from support.planner_strategies import random_pace

from planner_service.target_tree import TargetTree
from planner_service.tree import cost_grid
from swarm.config.scenario import PlannerConfig, Strategy
from swarm.grid import GridSpec, Window


def nearest(grid: GridSpec, pace: np.ndarray, led: np.ndarray, cell: int, half: int) -> int | None:
    """The slow twin: all cells of the window, the first of the grid of those at the same distance."""
    row, col = grid.row_col(cell)
    rows, cols = np.indices(pace.shape)
    near = np.isfinite(pace) & (np.maximum(abs(rows - row), abs(cols - col)) <= half)
    some = near & led if (near & led).any() else near
    away = np.where(some, (rows - row) ** 2 + (cols - col) ** 2, np.inf)
    return int(away.argmin()) if some.any() else None


@pytest.mark.parametrize("near_cells", [3, 9, 256])
@pytest.mark.parametrize("strategy", ["exact", "full"])
def test_a_target_over_water_has_the_nearest_shore_from_which_a_tree_led(
    strategy: Strategy, near_cells: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cost_grid, "NEAR_CELLS", near_cells)
    rng = np.random.default_rng(5)
    found = {"a shore": 0, "no tree leads there": 0, "none": 0, "stopped": 0}
    for n in range(40):
        pace = random_pace(rng, *rng.integers(12, 50, 2), 3.0, (0.0, 0.05, 0.4)[n % 3])
        grid = GridSpec(*pace.shape, 1.0)
        top, left = (int(rng.integers(0, side // 3 + 1)) for side in pace.shape)
        lake = pace[top : top + int(rng.integers(3, 40)), left : left + int(rng.integers(3, 40))]
        lake[:] = np.where(rng.random(lake.shape) < 0.02, 1.0, np.inf)  # with islands
        tree = TargetTree(grid, PlannerConfig(strategy=strategy))
        led, dirty = np.zeros(pace.size, np.bool_), [grid.window]
        cell = int(rng.integers(grid.cells))
        for _ in range(30):
            tree.update(pace, cell, dirty, 0)
            dirty = []
            if tree.ready:
                tree.routes(np.flatnonzero(rng.random(grid.cells) < 0.01))
                if tree._is_whole:
                    led = np.isfinite(tree.cost_to_go_at(np.arange(grid.cells)))
                else:  # to ask for more would have it grow
                    grown = tree._growth.cost.reshape(grid.rows + 2, -1)[1:-1, 1:-1].reshape(-1)
                    led = (grown >= 0) & (grown < np.inf)
                found["stopped"] += not tree._is_whole
            else:
                answer = tree.lethal_target
                assert answer is not None
                assert answer.cell == cell
                expected = nearest(grid, pace, led.reshape(pace.shape), cell, near_cells)
                assert answer.nearest == expected
                found["none" if expected is None else "a shore" if led[expected] else "no tree leads there"] += 1
            # It steps over water, jumps anywhere, and now and then the map changes where it stands.
            row, col = grid.row_col(cell)
            row, col = row + int(rng.integers(-2, 3)), col + int(rng.integers(-2, 3))
            if rng.random() < 0.4 or not grid.inside(row, col):
                row, col = int(rng.integers(grid.rows)), int(rng.integers(grid.cols))
            cell = grid.cell(row, col)
            if rng.random() < 0.15:
                window = Window(row, col, min(row + 3, grid.rows), min(col + 3, grid.cols))
                marked = np.s_[window.row0 : window.row1, window.col0 : window.col1]
                pace[marked] = random_pace(rng, *pace[marked].shape, 3.0, 0.5)
                dirty = [window]
                if not tree._is_whole:
                    led.reshape(pace.shape)[marked] = False  # of a growth that has stopped nothing is left there
    assert found["a shore"] > 20, found
    assert (found["no tree leads there"] and found["none"]) or near_cells == 256, found
    assert (found["stopped"] > 20) == (strategy == "full"), found
