"""Input that kernels could not survive is refused before the call: they check no index."""

from collections.abc import Callable

import numpy as np
import pytest

from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.routes_with_bounds import LowerBounds
from planner_service.tree.strides import find_strides
from swarm.config.scenario import PlannerConfig
from swarm.errors import OutsideGridError
from swarm.grid import GridSpec, Window

GRID = GridSpec(8, 9, 1.0)
LETHAL = GRID.cell(3, 4)
OUTSIDE = (-1, GRID.cells, 10**6, -(10**6), 2**40)


@pytest.fixture
def tree() -> CostToGoTree:
    """A grown tree on a map with one lethal cell."""
    cost_grid = CostGrid(GRID, PlannerConfig())
    pace = np.ones((GRID.rows, GRID.cols), np.float32)
    pace.flat[LETHAL] = np.inf
    cost_grid.load(pace)
    tree = CostToGoTree(cost_grid)
    tree.grow(0)
    return tree


@pytest.mark.parametrize("cell", OUTSIDE)
def test_no_tree_leads_to_a_cell_outside_the_grid(tree: CostToGoTree, cell: int) -> None:
    cost, parent = tree.cost.copy(), tree.parent.copy()
    attempts: list[Callable[[], object]] = [
        lambda: tree.grow(cell),
        lambda: tree.move(cell, GRID.window),
        lambda: tree.take(cell, cost, parent, 1.0),
        lambda: tree.cost_grid.passable(cell),
    ]
    for attempt in attempts:
        with pytest.raises(OutsideGridError):
            attempt()
    assert tree.root == 0
    np.testing.assert_array_equal(tree.cost, cost)
    np.testing.assert_array_equal(tree.parent, parent)


def test_no_tree_leads_to_a_lethal_cell(tree: CostToGoTree) -> None:
    cost = tree.cost.copy()
    with pytest.raises(ValueError, match="lethal"):
        tree.grow(LETHAL)
    with pytest.raises(ValueError, match="lethal"):
        tree.move(LETHAL, GRID.window)
    assert tree.root == 0
    np.testing.assert_array_equal(tree.cost, cost)


@pytest.mark.parametrize("cell", OUTSIDE)
def test_what_is_read_must_be_a_padded_cell(tree: CostToGoTree, cell: int) -> None:
    padded = np.array([tree.cost_grid.pad(0), cell if cell != GRID.cells else tree.cost_grid.size], np.int64)
    bounds = LowerBounds(tree.cost_grid)
    bounds.take(tree.cost.copy())
    root = tree.cost_grid.pad(tree.root)
    attempts: list[Callable[[], object]] = [
        lambda: tree.cost_at(padded),
        lambda: bounds.at(tree, padded),
        lambda: tree.cost_grid.walk(tree.parent, root, padded, 0, tree.cost_grid.cell_cost),
    ]
    tree.move(1, GRID.window)  # so that the tree is not exact, and all of them look
    for attempt in attempts:
        with pytest.raises(ValueError, match="padded cells lie outside"):
            attempt()


@pytest.mark.parametrize(
    "window",
    [Window(-1, 0, 4, 4), Window(0, -1, 4, 4), Window(0, 0, 9, 4), Window(0, 0, 4, 10), Window(4, 4, 4, 8)],
)
def test_a_window_lies_inside_the_grid(tree: CostToGoTree, window: Window) -> None:
    network = find_strides(tree.cost_grid)
    with pytest.raises(OutsideGridError):
        tree.move(1, window)
    with pytest.raises(OutsideGridError):
        tree.grow_strides(window, network, 9)


@pytest.mark.parametrize(("root", "window"), [(1, Window(0, 1, 4, 4)), (70, Window(0, 0, 4, 4))])
def test_a_window_holds_the_old_root_and_the_new_one(tree: CostToGoTree, root: int, window: Window) -> None:
    with pytest.raises(OutsideGridError):
        tree.move(root, window)


def test_a_tree_that_was_never_grown_says_so() -> None:
    tree = CostToGoTree(CostGrid(GRID, PlannerConfig()))
    for attempt in (tree.mend, lambda: tree.cost_at(np.array([12])), lambda: tree.move(0, GRID.window)):
        with pytest.raises(ValueError, match="no root"):
            attempt()
