"""A tree made exact through its parents, or repaired after marks, equals the one grown from scratch on the new map:
every cost, every parent, to the last bit."""

from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import slow_twins as naive
from support.effort import few
from support.kernel_oracle import grown, inner, loaded
from support.planner_play import Play
from support.planner_strategies import (
    RULES,
    Job,
    Marks,
    Move,
    cell_near,
    change,
    happenings,
    inside,
    open_cell,
    random_climb,
    random_pace,
    random_window,
)

from planner_service import target_tree
from planner_service.kernels import repair as kernels
from planner_service.tree.cost_changes import Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.strides import find_strides
from shared_map.array_files import Floats
from shared_map.terrain.slope_and_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window

FACTORS = (0.3, 0.7, 1.5, 3.0, np.inf, 0.0)
"""Changes of the paces of a patch: times the factor; 0 draws them again, lethal ones too."""
NO_LIMIT = 10**9
"""Bound on cells, edges and steps of a repair."""


class Patchwork:
    """The tree is repaired or, where that gives way, grown. `mended` counts the repairs.

    climb  of a map where uphill is not downhill
    """

    def __init__(
        self, rng: np.random.Generator, pace: Floats, rules: dict[str, Any], climb: Climb | None = None
    ) -> None:
        self.rng = rng
        self.pace = pace
        self.grid = GridSpec(*pace.shape, 1.0)
        self.climb = climb
        self.rules = rules
        self.costs = self._fresh()
        self.tree = grown(self.costs, open_cell(rng, pace))
        self.mended = 0

    @property
    def root(self) -> int:
        return self.tree.root

    def _fresh(self) -> CostGrid:
        return loaded(self.pace, self.grid, self.climb, **self.rules)

    def change(self, factor: float, side: int, near_root: bool = False) -> Window:
        """Changes a square somewhere, or around the root. The root stays passable."""
        window = random_window(self.rng, self.pace, side, side)
        if near_root:
            window = self.grid.around(self.root, side // 2)
        change(self.rng, inside(self.pace, window), factor)
        if not np.isfinite(self.pace.flat[self.root]):
            self.pace.flat[self.root] = 1.0
        return window

    def mend(self, windows: list[Window]) -> None:
        if self.tree.repair(self.costs.apply(self.pace, windows)) < 0:
            self.tree.grow(self.root)
        else:
            self.mended += 1

    def repair_at_any_price(self, changes: Changes, buckets: tuple[float, int] | None = None) -> int:
        """Calls the kernel without a limit. Returns how many cells it took."""
        labels, most = (self.tree.cost, self.tree.parent, self.costs.pad(self.root)), 3 * (NO_LIMIT,)
        taken, highest = kernels.repair(*self._given(labels, changes), buckets or self.costs.buckets, most,
                                        self.costs.repair_scratch)  # fmt: skip
        self.tree.reach = max(self.tree.reach, float(highest))
        return int(taken)

    def _given(self, labels: tuple[Any, ...], changes: Changes) -> tuple[Any, ...]:
        return self.costs.padded, self.costs.climbs, labels, changes.cells, changes.before

    def check(self) -> None:
        fresh = grown(self._fresh(), self.root)
        np.testing.assert_array_equal(inner(self.tree, self.tree.cost), inner(fresh, fresh.cost))
        np.testing.assert_array_equal(inner(self.tree, self.tree.parent), inner(fresh, fresh.parent))
        assert self.tree.reach >= fresh.cost[np.isfinite(fresh.cost)].max()

    def lower(self) -> None:
        """A heuristic without parents that is lowered is the tree of the map that got cheaper."""
        changes = self.costs.apply(self.pace, [self.change(factor, 6) for factor in (0.5, 0.25, 0.9)])
        heuristic = self.tree.cost.copy()
        given = self._given((heuristic, np.empty(0, np.uint8), 0), changes)
        kernels.repair(*given, self.costs.buckets, (0, 0, NO_LIMIT), self.costs.repair_scratch)
        self.tree.grow(self.root)
        np.testing.assert_array_equal(inner(self.tree, heuristic), inner(self.tree, self.tree.cost))


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
        cell = cell_near(self.rng, self.grid, self.root, far)
        window = self.grid.around(cell, far + int(self.rng.integers(0, 4)))
        if np.isfinite(self.pace.flat[cell]) and self.tree.move(cell, window):
            self.done += 1
            if self.rng.integers(4) == 0:
                self.tree.grow_strides(window, self.strides, 64)

    def check_mended(self) -> None:
        self.tree.mend()
        if self.tree.exact:
            self.exact += 1
            assert self.tree.offset == 0.0
            self.check()
            return
        fresh = grown(self.costs, self.root)
        finite = np.isfinite(fresh.cost)
        assert (self.tree.cost[finite] >= fresh.cost[finite]).all()
        self.tree.grow(self.root)


@pytest.mark.parametrize("priced", WAYS_TO_PRICE, ids=str)
def test_after_windows_jumps_marks_and_strides_a_repaired_tree_is_a_grown_one_bit_for_bit(
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
    costs, root = loaded(pace), open_cell(rng, pace)
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


def test_a_tree_whose_costs_are_too_large_for_its_parents_to_be_trusted_is_not_repaired() -> None:
    pace = np.ones((30, 30), np.float32)
    pace[:, 15] = 1e9
    with pytest.raises(ValueError, match="grow the tree"):
        grown(loaded(pace), 0).mend()


@given(st.integers(0, 2**32 - 1), st.sampled_from(WAYS_TO_PRICE), happenings(14))
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


def patchwork(rng: np.random.Generator, pace: Floats, n: int, directed: bool) -> Patchwork:
    """A map by the nth rules, directed or not."""
    grid = GridSpec(*pace.shape, 1.0)
    climb = random_climb(rng, grid, (0.0, 0.1, 0.4)[n % 3], (0.3, 0.6)[n % 2]) if directed else None
    return Patchwork(rng, pace, RULES[n % 5], climb)


@pytest.mark.parametrize(
    ("count", "shape", "most_side", "directed"),
    [
        (180, (48, 53), 9, True),
        (1200, (64, 61), 17, False),
        pytest.param(2400, (48, 53), 9, False, marks=pytest.mark.thorough),
    ],
)
def test_repaired_trees_are_those_that_would_have_grown_in_every_cost_and_parent(
    count: int, shape: tuple[int, int], most_side: int, directed: bool
) -> None:
    """On maps of all kinds; a third of all changes is repaired without a fallback."""
    mended = 0
    for n in range(count // 12):
        rng = np.random.default_rng([1, 12 * n])
        pace = random_pace(rng, *shape, (1.0, 4.0, 30.0, 1000.0)[n % 4], (0.0, 0.15, 0.35)[n // 4 % 3])
        work = patchwork(rng, pace, n, directed)
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
    assert mended > count // 3


@pytest.mark.parametrize("rules", RULES)
def test_a_repair_may_concern_the_whole_map(rules: dict) -> None:
    rng = np.random.default_rng(3)
    work = Patchwork(rng, random_pace(rng, 40, 45, 6.0, 0.2), rules)
    for factor in (2.0, 0.5):
        work.pace *= np.float32(factor)
        assert work.repair_at_any_price(work.costs.apply(work.pace, [work.grid.window])) > 1000
        work.check()


def test_a_repair_that_concerns_too_much_gives_way() -> None:
    work = Patchwork(np.random.default_rng(1), np.ones((60, 60), np.float32), RULES[0])
    work.pace[:] = 2.0
    assert work.tree.repair(work.costs.apply(work.pace, [work.grid.window])) == -1
    work.tree.grow(work.root)
    work.pace[:] = 1.0
    assert work.tree.repair(work.costs.apply(work.pace, [work.grid.window])) == -1


@pytest.mark.parametrize("count", [4, 512])
@pytest.mark.parametrize("width", [0.01, 1.0, 40.0])
def test_costs_do_not_depend_on_the_width_or_number_of_buckets(width: float, count: int) -> None:
    rng = np.random.default_rng(5)
    work = Patchwork(rng, random_pace(rng, 40, 45, 30.0, 0.2), RULES[0])
    work.pace[10:30, 10:30] *= np.float32(3)
    work.pace[20:25, 20:40] *= np.float32(0.5)
    changes = work.costs.apply(work.pace, [Window(10, 10, 30, 40)])
    assert work.repair_at_any_price(changes, (width, count)) > 0
    work.check()


@pytest.mark.parametrize("directed", [False, True])
def test_a_lowered_heuristic_is_the_tree_of_a_map_that_got_cheaper(directed: bool) -> None:
    rng = np.random.default_rng(6)
    for n in range(60):
        patchwork(rng, random_pace(rng, 40, 45, 6.0, 0.2), n, directed).lower()
