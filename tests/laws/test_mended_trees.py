"""A tree made exact through its parents equals the one grown from scratch, whatever was done to it before."""

from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import slow_twins as naive
from support.effort import few
from support.kernel_oracle import inner
from support.planner_play import Play
from support.planner_strategies import RULES, Job, Marks, Move, random_climb, random_pace
from support.repaired_tree import FACTORS, Patchwork

from planner_service import target_tree
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.strides import find_strides
from shared_map.terrain.step_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec

WAYS_TO_PRICE: tuple[dict[str, Any], ...] = (*RULES, {"length_weight": 0.5}, {"directional": True})
SMALL = mock.patch.object(target_tree, "exact_half", lambda grid, old, new: max(1, grid.distance_cells(old, new)))
"""Windows so narrow that small maps have exact moves, too, and most of the work is left to the mending."""


def steep_climb(rng: np.random.Generator, rows: int, cols: int) -> Climb:
    return random_climb(rng, GridSpec(rows, cols, 1.0), 0.15, 0.5)


class Mended(Patchwork):
    """A tree that is damaged and repaired, on a map that changes."""

    def __init__(self, seed: int, priced: dict[str, Any], rows: int = 45, cols: int = 52) -> None:
        rng, rules = np.random.default_rng(seed), dict(priced)
        climb = steep_climb(rng, rows, cols) if rules.pop("directional", False) else None
        pace = random_pace(rng, rows, cols, (1.0, 3.0, 60.0)[seed % 3], (0.0, 0.2, 0.35)[seed // 3 % 3])
        super().__init__(rng, pace, rules, climb)
        self.strides = find_strides(self.costs)
        self.exact = self.done = 0

    def mistreat(self) -> None:
        """Moves, of one cell or several, by windows that are narrow; marks; strides; marks beyond repair."""
        for _ in range(int(self.rng.integers(1, 6))):
            what = int(self.rng.integers(5))
            if what < 3:
                self._move(int(self.rng.choice([1, 1, 1, 5, 12])))
            else:
                factors, side = self.rng.choice(FACTORS, self.rng.integers(1, 6)), int(self.rng.integers(1, 4))
                self.mend([self.change(factor, side) for factor in factors])

    def _move(self, far: int) -> None:
        grid, tree = self.costs.grid, self.tree
        row, col = grid.row_col(tree.root)
        row = int(np.clip(row + self.rng.integers(-far, far + 1), 0, grid.rows - 1))
        col = int(np.clip(col + self.rng.integers(-far, far + 1), 0, grid.cols - 1))
        window = grid.around(grid.cell(row, col), far + int(self.rng.integers(0, 4)))
        if np.isfinite(self.pace[row, col]) and tree.move(grid.cell(row, col), window):
            self.done += 1
            if self.rng.integers(4) == 0:
                tree.grow_strides(window, self.strides, 64)

    def check_mended(self) -> None:
        self.tree.mend()
        if self.tree.exact:
            self.exact += 1
            assert self.tree.offset == 0.0
            self.check()
            return
        fresh = CostToGoTree(self.costs)
        fresh.grow(self.root)
        finite = np.isfinite(fresh.cost)
        assert (self.tree.cost[finite] >= fresh.cost[finite]).all()
        self.tree.grow(self.root)


@pytest.mark.parametrize("priced", WAYS_TO_PRICE, ids=str)
def test_after_windows_jumps_marks_and_strides_a_mended_tree_is_a_grown_one_bit_for_bit(
    priced: dict[str, Any],
) -> None:
    mended = done = 0
    for seed in range(9):
        tried = Mended(seed, priced)
        for _ in range(8):
            tried.mistreat()
            tried.check_mended()
        mended, done = mended + tried.exact, done + tried.done
    assert mended > 60
    assert done > 40


def test_where_nothing_is_left_of_the_old_order_mending_gives_up_and_says_so() -> None:
    """Every cell's cost is drawn again, as no repair would leave it: parents lead anywhere but along the best
    way."""
    rng = np.random.default_rng(3)
    pace = random_pace(rng, 60, 60, 100.0, 0.1)
    costs = CostGrid(GridSpec(60, 60, 1.0), PlannerConfig())
    costs.load(pace)
    root = int(rng.choice(np.flatnonzero(np.isfinite(pace))))
    tree = CostToGoTree(costs)
    given_up = 0
    for _ in range(6):
        tree.grow(root)
        pace[np.isfinite(pace)] = np.exp(rng.random(int(np.isfinite(pace).sum())) * 9).astype(np.float32)
        costs.load(pace)
        tree.mend()
        best = naive.cost_to_go(pace, root)
        best[~np.isfinite(pace)] = np.inf
        given_up += not tree.exact
        if tree.exact:
            np.testing.assert_allclose(inner(tree, tree.cost), best, rtol=3e-6)
        starts = np.flatnonzero(np.isfinite(tree.cost) & (np.arange(costs.size) != costs.pad(root)))
        driven = costs.walk(tree.parent, costs.pad(root), starts, 0, costs.cell_cost)
        assert (driven.ends >= 0).all()
        assert (tree.cost[starts] >= driven.driven * (1 - 1e-5)).all()
        assert (inner(tree, tree.cost) >= best * (1 - 1e-5)).all()
    assert given_up


def test_a_tree_whose_costs_are_too_large_for_its_parents_to_be_trusted_is_not_mended() -> None:
    pace = np.ones((30, 30), np.float32)
    pace[:, 15] = 1e9
    costs = CostGrid(GridSpec(30, 30, 1.0), PlannerConfig())
    costs.load(pace)
    tree = CostToGoTree(costs)
    tree.grow(0)
    with pytest.raises(ValueError, match="grow the tree"):
        tree.mend()


MANY = st.lists(
    st.one_of(
        st.builds(Move, st.integers(-1, 1), st.integers(-1, 1)),
        st.builds(Move, st.integers(-9, 9), st.integers(-9, 9)),
        st.builds(Marks, st.integers(0, 2**31), st.integers(1, 6)),
        st.builds(Job, st.sampled_from(["begin", "end", "force"])),
    ),
    min_size=4,
    max_size=14,
)


@given(st.integers(0, 2**32 - 1), st.sampled_from(WAYS_TO_PRICE), MANY)
@settings(max_examples=few(40), deadline=None)
def test_under_exact_every_update_leaves_the_tree_that_would_have_grown(
    seed: int, priced: dict[str, Any], events: list[Move | Marks | Job]
) -> None:
    rng = np.random.default_rng(seed)
    rules = dict(priced)
    climb = steep_climb(rng, 24, 27) if rules.pop("directional", False) else None
    with SMALL:
        play = Play(random_pace(rng, 24, 27, 5.0, 0.15), PlannerConfig(strategy="exact", **rules), climb=climb)
        for event in events:
            play.happen(event)
            if play.tree.ready:
                play.check_equals_a_growth()


@SMALL
def test_exact_moves_are_what_happens_on_a_walk() -> None:
    play = Play(random_pace(np.random.default_rng(1), 40, 40, 5.0, 0.1), PlannerConfig(strategy="exact"))
    kinds = [play.last.kind]
    for step in range(30):
        play.happen(Move(1 - 2 * (step // 7 % 2), 1))
        kinds.append(play.last.kind)
    play.check()
    assert kinds.count("exact") > 20, kinds
