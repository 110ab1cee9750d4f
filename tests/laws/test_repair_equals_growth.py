"""A repaired tree is the one that would have grown on the new map: every cost, every parent, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
from support.planner_strategies import RULES, random_pace

from planner_service.kernels import repair as kernels
from planner_service.tree.changes import Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window

FACTORS = (0.3, 0.7, 1.5, 3.0, np.inf, 0.0)
"""What happens to the paces of a patch: times so much; 0 draws them anew, lethal ones too."""


class Patchwork:
    """A map of which patches change, and a tree that is repaired or, where that gives way, grown."""

    def __init__(self, pace: np.ndarray, rules: dict, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.pace = pace
        self.grid = GridSpec(*pace.shape, 1.0)
        self.config = PlannerConfig(**rules)
        self.ground = CostGrid(self.grid, self.config)
        self.ground.load(pace)
        self.tree = CostToGoTree(self.ground)
        self.root = int(self.rng.choice(np.flatnonzero(np.isfinite(pace))))
        self.tree.grow(self.root)
        self.mended = 0

    def change(self, factor: float, side: int, near_root: bool) -> Window:
        rows, cols = self.grid.rows, self.grid.cols
        row, col = int(self.rng.integers(rows)), int(self.rng.integers(cols))
        if near_root:
            row, col = (max(at - side // 2, 0) for at in self.grid.row_col(self.root))
        window = Window(row, col, min(row + side, rows), min(col + side, cols))
        patch = self.pace[window.row0 : window.row1, window.col0 : window.col1]
        if factor == 0.0:
            patch[:] = random_pace(self.rng, *patch.shape, 5.0, 0.3)
        else:
            patch *= np.float32(factor)
        if not np.isfinite(self.pace.flat[self.root]):
            self.pace.flat[self.root] = 1.0
        return window

    def mend(self, windows: list[Window]) -> None:
        self.mended += 1
        if self.tree.repair(self.ground.apply(self.pace, windows)) < 0:
            self.mended -= 1
            self.tree.grow(self.root)

    def check(self) -> None:
        ground = CostGrid(self.grid, self.config)
        ground.load(self.pace)
        fresh = CostToGoTree(ground)
        fresh.grow(self.root)
        np.testing.assert_array_equal(self.tree.inner(self.tree.cost), fresh.inner(fresh.cost))
        np.testing.assert_array_equal(self.tree.inner(self.tree.parent), fresh.inner(fresh.parent))
        assert self.tree.reach >= fresh.cost[np.isfinite(fresh.cost)].max()


def trials(count: int, seed: int, shape: tuple[int, int], most_side: int) -> int:
    """How many of so many changes, to maps of all kinds, were repaired without giving way."""
    mended = 0
    for n in range(0, count, 12):
        rng = np.random.default_rng([seed, n])
        ratio, walls = (1.0, 4.0, 30.0, 1000.0)[n // 12 % 4], (0.0, 0.15, 0.35)[n // 48 % 3]
        work = Patchwork(random_pace(rng, *shape, ratio, walls), RULES[n // 12 % 5], n)
        for m in range(12):
            # Every other time several patches at once, of different kinds and sizes.
            parts = [FACTORS[(m + part) % 6] for part in range(1 if m % 2 else 3)]
            windows = [
                work.change(factor, int(rng.integers(1, most_side + 1)), bool(rng.random() < 0.2))
                for factor in parts
            ]
            work.mend(windows)
            work.check()
        mended += work.mended
    return mended


def test_six_hundred_repaired_trees_are_those_that_would_have_grown() -> None:
    assert trials(600, 1, (48, 53), 9) > 200


@pytest.mark.slow
def test_two_thousand_four_hundred_repaired_trees_are_those_that_would_have_grown() -> None:
    assert trials(2400, 2, (64, 61), 17) > 1000


@pytest.mark.parametrize("rules", RULES)
def test_a_repair_may_concern_the_whole_map(rules: dict) -> None:
    rng = np.random.default_rng(3)
    work = Patchwork(random_pace(rng, 40, 45, 6.0, 0.2), rules, 3)
    for factor in (2.0, 0.5):
        work.pace *= np.float32(factor)
        changes = work.ground.apply(work.pace, [work.grid.window])
        tree, ground = work.tree, work.ground
        labels = (tree.cost, tree.parent, ground.pad(work.root))
        most = (10**9, 10**9, 10**9)
        given = (ground.padded, None, labels, changes.cells, changes.before, ground.buckets, most)
        taken, highest = kernels.repair(*given, ground.repair_scratch)
        assert taken > 1000
        tree.reach = float(highest)
        work.check()


def test_a_wall_across_the_map_takes_the_way_from_all_behind_it_and_a_door_gives_it_back() -> None:
    work = Patchwork(np.ones((30, 30), np.float32), RULES[0], 1)
    work.root = work.grid.cell(2, 2)
    work.tree.grow(work.root)
    work.pace[15] = np.inf
    work.mend([Window(15, 0, 16, 30)])
    work.check()
    assert np.isinf(work.tree.inner(work.tree.cost)[16:]).all()
    work.pace[15, 29] = 1.0
    work.mend([Window(15, 29, 16, 30)])
    work.check()
    assert np.isfinite(work.tree.inner(work.tree.cost)[16:]).all()


def test_a_repair_that_concerns_too_much_gives_way() -> None:
    work = Patchwork(np.ones((60, 60), np.float32), RULES[0], 1)
    work.pace[:] = 2.0
    assert work.tree.repair(work.ground.apply(work.pace, [work.grid.window])) == -1
    work.tree.grow(work.root)
    work.pace[:] = 1.0
    assert work.tree.repair(work.ground.apply(work.pace, [work.grid.window])) == -1


@pytest.mark.parametrize("width", [0.01, 1.0, 40.0])
def test_costs_do_not_depend_on_the_width_or_number_of_buckets(width: float) -> None:
    for count in (4, 512):
        rng = np.random.default_rng(5)
        work = Patchwork(random_pace(rng, 40, 45, 30.0, 0.2), RULES[0], 5)
        work.pace[10:30, 10:30] *= np.float32(3)
        work.pace[20:25, 20:40] *= np.float32(0.5)
        changes = work.ground.apply(work.pace, [Window(10, 10, 30, 40)])
        tree, ground = work.tree, work.ground
        labels = (tree.cost, tree.parent, ground.pad(work.root))
        buckets, most = (width, count), (10**9, 10**9, 10**9)
        given = (ground.padded, None, labels, changes.cells, changes.before, buckets, most)
        taken, highest = kernels.repair(*given, ground.repair_scratch)
        assert taken > 0
        tree.reach = max(tree.reach, float(highest))
        work.check()


@pytest.mark.parametrize("rules", RULES)
def test_a_lowered_heuristic_is_the_tree_of_a_map_that_got_cheaper(rules: dict) -> None:
    rng = np.random.default_rng(6)
    for _ in range(20):
        work = Patchwork(random_pace(rng, 40, 45, 6.0, 0.2), rules, 6)
        windows = [work.change(factor, 6, False) for factor in (0.5, 0.25, 0.9)]
        changes: Changes = work.ground.apply(work.pace, windows)
        ground, heuristic = work.ground, work.tree.cost.copy()
        labels = (heuristic, np.empty(0, np.uint8), 0)
        given = (ground.padded, None, labels, changes.cells, changes.before, ground.buckets, (0, 0, 10**9))
        done, _ = kernels.repair(*given, ground.repair_scratch)
        assert done > 0
        work.tree.grow(work.root)
        np.testing.assert_array_equal(work.tree.inner(heuristic), work.tree.inner(work.tree.cost))
