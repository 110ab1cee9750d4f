"""The statements of docs/method/paper.md about the paper's printed rules hold."""

import math

import numpy as np
import pytest

from docs.generate import method_pictures, route_pictures
from docs.generate.printed import lattice_route, printed_costs, printed_range
from planner_service.target_tree import TargetTree
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec


def test_the_printed_condition_never_widens_the_window_of_a_target_that_moves_along_an_axis():
    assert {printed_range(n, 0, k_min=2) for n in range(-300, 300)} == {9}
    assert {printed_range(0, n, k_min=2) for n in range(-300, 300)} == {9}


@pytest.mark.parametrize("n", range(1, 33))
def test_on_a_diagonal_from_the_corner_of_a_block_printed_condition_and_blocks_agree(n):
    grid = GridSpec(257, 257, 1.0)
    tree = TargetTree(grid, PlannerConfig(strategy="variable_range", k_min=2))
    pace = np.ones((257, 257), np.float32)
    tree.update(pace, grid.cell(128 + n - 1, 128 + n - 1), [], 0)
    window = tree.update(pace, grid.cell(128 + n, 128 + n), [], 0).window
    assert window.row1 - window.row0 == printed_range(n, n, k_min=2)


def test_grown_along_the_edges_a_unit_route_costs_the_vehicles_cell_instead_of_the_targets():
    pace = np.array([[3.0, 1.0, 1.0, 7.0]], np.float32)
    assert printed_costs(pace, (0, 3))[0, 0] == 1 + 1 + 3
    grid = GridSpec(1, 4, 1.0)
    tree = TargetTree(grid, PlannerConfig(strategy="full"))
    tree.update(pace, 3, [], 0)
    assert tree.cost_to_go_at([0])[0] == 1 + 1 + 7


def test_strides_jump_over_a_wall_thinner_than_a_stride():
    pace = np.ones((9, 9), np.float32)
    pace[:, 5] = np.inf
    route = lattice_route(pace, (4, 0), (4, 8), stride=4)
    assert route.tolist() == [[4, 0], [4, 4], [4, 8]]
    grid = GridSpec(9, 9, 1.0)
    tree = TargetTree(grid, PlannerConfig(strategy="full"))
    tree.update(pace, grid.cell(4, 8), [], 0)
    assert math.isinf(tree.cost_to_go_at([grid.cell(4, 0)])[0])


@pytest.mark.parametrize("name", [*method_pictures.PICTURES, *route_pictures.PICTURES])
def test_a_picture_is_there_small_and_shown_on_a_page(name):
    images = method_pictures.IMAGES
    assert (images / f"{name}.png").stat().st_size < 160_000
    assert any(f"images/{name}.png" in page.read_text(encoding="utf-8") for page in images.parent.rglob("*.md"))
