"""Calls every kernel once, so that compiling or loading them from numba's cache is over before time counts."""

from __future__ import annotations

import functools
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from planner_service.target_tree import TargetTree
from planner_service.tree.corridors import find_corridors
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.terrain.step_climb import climb_of
from swarm.config.scenario import CostConfig, PlannerConfig, Strategy
from swarm.grid import GridSpec, Window

RULES: tuple[tuple[Literal["octile", "paper"], Literal[4, 8]], ...] = (("octile", 8), ("paper", 8), ("paper", 4))
_SIDE = 40


@functools.cache  # a process forked from a warm one has nothing to do
def warm_up() -> None:
    """Grow, move, repair, force and read small trees: slow the first time ever, a moment once they are cached."""
    grid = GridSpec(_SIDE, _SIDE, 10.0)
    configs = [
        PlannerConfig(strategy=strategy, edge=edge, neighbours=neighbours, k_min=1, full_every=2)
        for strategy in get_args(Strategy)
        for edge, neighbours in RULES
    ]
    for config in configs:
        for dearest in (0.2, 1e4):  # beyond this ratio of cell costs, growth takes a radix heap
            pace = np.full((_SIDE, _SIDE), 0.1, np.float32)
            pace[0, 0] = dearest
            _live(TargetTree(grid, config), pace)
    level = climb_of(grid, np.zeros_like(pace), CostConfig(directional=True))
    _live(TargetTree(grid, configs[0], level), pace)
    cost_grid = CostGrid(grid, configs[0])
    cost_grid.load(pace)
    tree = CostToGoTree(cost_grid)
    tree.grow(_SIDE)
    tree.relabel()
    window = grid.around(_SIDE + 1, 4)
    tree.move(_SIDE + 1, window)
    tree.grow_corridors(window, find_corridors(cost_grid))
    tree.tighten(np.array([cost_grid.pad(0)]))


def _live(tree: TargetTree, pace: NDArray[np.float32]) -> None:
    """What happens to a tree in its life."""
    middle = _SIDE // 2 * (_SIDE + 1)
    tree.update(pace, middle, [], 0)
    for version in range(1, 4):
        tree.update(pace, middle + version, [], version)
    for version, change in ((4, np.inf), (5, 0.05)):
        pace[3:5, 3:5] = change
        tree.update(pace, middle + 3, [Window(3, 3, 5, 5)], version)
    tree.force([0, 1])
    grown = tree.full_job(middle + 3)()
    tree.update(pace, middle + 4, [], 6)
    tree.adopt(grown, pace, middle + 5, [], 6, np.array([0, 1]))
    tree.routes([0, 1, -1], 0)
    tree.cost_to_go_at([0, 1])
