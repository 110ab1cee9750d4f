"""Any costs of a map: a tree is exact on them, or the map is refused, and nothing overflows.

Where uphill differs from downhill, trees are exact to the last bit as well, and grow in about the same time."""

import logging
import math
import statistics
import time
import warnings
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import slow_twins as naive
from support.effort import few
from support.fields import make_field, paces_of_any_ratio
from support.kernel_oracle import grown, inner, loaded
from support.planner_strategies import RULES, STRATEGIES, open_cell, random_climb, random_pace

from planner_service import RouteFinder
from planner_service.kernels.cell_costs import CHEAPEST_S, DEAREST_S
from planner_service.kernels.layout import NONE
from planner_service.kernels.multilevel_growth import grow_by_levels, make_scratch
from planner_service.target_tree import TargetTree
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.terrain.slope_and_climb import climb_of
from swarm.config.ground import CostConfig
from swarm.config.scenario import PlannerConfig
from swarm.errors import ConfigError
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, Window

EXAMPLES = few(60)
TINY, HUGE = float(np.float32(1e-45)), float(np.finfo(np.float32).max)
PACES = st.one_of(
    st.sampled_from([TINY, 1e-38, 1e-6, 1 / 340, 1.0, 100.0, 1e7, 1e30, HUGE, float("inf")]),
    st.floats(min_value=TINY, allow_nan=False, width=32),
)
METRES = st.sampled_from([1e-30, 1e-3, 1.0, 30.0, 1e6, 1e12])
WEIGHTS = st.sampled_from([0.0, 0.0, 1e-30, 0.5, 1e12])


def test_costs_at_the_bounds_are_said(caplog: pytest.LogCaptureFixture) -> None:
    ground = CostGrid(GridSpec(2, 2, 10.0), PlannerConfig())
    with caplog.at_level(logging.WARNING, "planner_service.tree.cost_grid"):
        ground.load(np.array([[TINY, 1.0], [HUGE, np.inf]], np.float32))
    assert caplog.messages == [
        "2 of 4 cells cost 9.1e-13 s or 1.1e+12 s, the least and the most that a cell can cost"
    ]


def said_cost(pace: np.ndarray, resolution_m: float, weight: float) -> np.ndarray:
    """float64: what cells cost by the rule."""
    cost = np.maximum(pace.astype(np.float64) * resolution_m, CHEAPEST_S) + weight * resolution_m
    return np.where(np.isfinite(pace), np.minimum(cost, DEAREST_S), np.inf)


def assert_exact(ground: CostGrid, tree: CostToGoTree, target: int, rules: dict) -> None:
    costs = inner(tree, ground.cell_cost)
    best = naive.cost_to_go(costs, target, **rules)
    # Each step is rounded by 2^-23 at most, where costs drown in others; and so is the product before.
    np.testing.assert_allclose(
        inner(tree, tree.cost), np.where(np.isfinite(costs), best, np.inf), rtol=(costs.size + 2) * 2**-23
    )


@pytest.mark.parametrize("field", ["terrain", "maze"])
def test_trees_over_costs_of_any_ratio_are_right_to_the_last_bit(field: str) -> None:
    pace = make_field(field, 64)
    for number, (_, paces) in enumerate(paces_of_any_ratio(pace, np.random.default_rng(1))):
        rules = RULES[number % len(RULES)]
        ground, target = loaded(paces, **rules), int(np.flatnonzero(np.isfinite(paces))[1500])
        tree = grown(ground, target)
        best = naive.cost_to_go_in_float32(inner(tree, ground.cell_cost), target, **rules)
        np.testing.assert_array_equal(inner(tree, tree.cost), best)
        assert tree.reach >= best[np.isfinite(best)].max()
        starts = ground.pad_all(np.flatnonzero(np.isfinite(best) & (best > 0)))
        walks = ground.walk(tree.parent, ground.pad(target), starts, 0, ground.cell_cost)
        np.testing.assert_allclose(walks.driven, tree.cost[starts], rtol=1e-4)
        assert (walks.last == ground.pad(target)).all()


@settings(max_examples=EXAMPLES, deadline=None)
@given(st.data(), st.lists(PACES, min_size=1, max_size=5), METRES, WEIGHTS, st.sampled_from(RULES))
def test_a_tree_is_exact_on_any_paces_after_any_marks(
    data: st.DataObject, palette: list[float], resolution_m: float, weight: float, rules: dict
) -> None:
    rows, cols = data.draw(st.integers(1, 12)), data.draw(st.integers(1, 12))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    pace = rng.choice(np.array(palette, np.float32), (rows, cols))
    target = int(rng.integers(rows * cols))
    with warnings.catch_warnings(), np.errstate(all="raise", under="ignore"):
        warnings.simplefilter("error")
        ground = loaded(pace, GridSpec(rows, cols, resolution_m), length_weight=weight, **rules)
        tree = CostToGoTree(ground)
        for _ in range(data.draw(st.integers(1, 4))):
            costs = inner(tree, ground.cell_cost)
            with np.errstate(all="ignore"):
                np.testing.assert_allclose(costs, said_cost(pace, resolution_m, weight), rtol=1e-6, atol=1e-38)
            finite = costs[np.isfinite(costs)]
            lowest, highest = (finite.min(), finite.max()) if finite.size else (np.inf, 0)
            assert (ground.lowest_cell_cost, ground.highest_cell_cost) == (lowest, highest)
            if ground.passable(target):
                if tree.root != target:
                    tree.grow(target)
                assert_exact(ground, tree, target, rules)
            row, col = int(rng.integers(rows)), int(rng.integers(cols))
            pace[row : row + 3, col : col + 3] = rng.choice(np.array(palette, np.float32))
            marked = Window(row, col, row + 3, col + 3), Window(row - 2, col - 2, row + 1, col + 2)
            changes = ground.apply(pace, marked)
            if not ground.passable(target) or not tree.fine or tree.root < 0 or tree.repair(changes) < 0:
                tree = CostToGoTree(ground)


@settings(max_examples=EXAMPLES, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(PACES, min_size=2, max_size=4),
    METRES,
    WEIGHTS,
    st.sampled_from(STRATEGIES),
    st.sampled_from(RULES),
)
def test_no_paces_end_a_planner(
    seed: int, palette: list[float], resolution_m: float, weight: float, strategy: str, rules: dict
) -> None:
    rng, grid = np.random.default_rng(seed), GridSpec(17, 19, resolution_m)
    pace = rng.choice(np.array(palette, np.float32), (grid.rows, grid.cols))
    config = PlannerConfig(strategy=strategy, k_min=0, length_weight=weight, **rules)  # type: ignore[arg-type]
    tree, target = TargetTree(grid, config), int(rng.integers(grid.cells))
    with warnings.catch_warnings(), np.errstate(all="raise", under="ignore"):
        warnings.simplefilter("error")
        for version in range(8):
            row, col = (int(each) for each in rng.integers(0, 17, 2))
            pace[row : row + 2, col : col + 4] = rng.choice(np.array(palette, np.float32))
            tree.update(pace, target, [Window(row, col, row + 2, col + 4)], version)
            for route in tree.routes(rng.integers(0, grid.cells, 5)):
                assert weight or route.lower_bound_s <= route.cost_s * (1 + 1e-5)
            tree.cost_to_go_at(np.arange(grid.cells))
            step = int(rng.choice([-grid.cols - 1, -grid.cols, -1, 0, 1, grid.cols]))
            target = min(max(target + step, 0), grid.cells - 1)


@settings(max_examples=EXAMPLES, deadline=None)
@given(st.lists(st.integers(0, 2**32 - 1), min_size=4, max_size=4), st.integers(0, 3))
def test_any_bits_are_taken_or_refused_and_a_refusal_changes_nothing(bits: list[int], where: int) -> None:
    grid = GridSpec(2, 2, 10.0)
    ground, pace = CostGrid(grid, PlannerConfig()), np.array(bits, np.uint32).view(np.float32).reshape(2, 2)
    good = bool((pace > 0).all())
    ground.load(np.ones((2, 2), np.float32))
    before, changed = ground.cell_cost.copy(), np.ones((2, 2), np.float32)
    changed.flat[where] = pace.flat[where]
    windows = [Window(0, 0, 1, 2), Window(1, 0, 2, 2)]
    for take, fine in (
        (lambda: ground.apply(changed, windows), changed.flat[where] > 0),
        (lambda: ground.load(pace), good),
    ):
        if fine:
            take()
            before = ground.cell_cost.copy()
            continue
        with pytest.raises(ValueError, match=r"cell \[\d, \d\] is .* expected a number above 0"):
            take()
        np.testing.assert_array_equal(ground.cell_cost, before)


@pytest.mark.parametrize("bad", [np.nan, -1.0, 0.0, 1e20])
def test_shared_cell_costs_that_no_map_has_are_refused(bad: float) -> None:
    ground = CostGrid(GridSpec(2, 2, 10.0), PlannerConfig())
    with pytest.raises(ValueError, match="cell costs lie between"):
        ground.share(np.array([1.0] * 15 + [bad], np.float32))


@pytest.mark.parametrize(("metres", "weight"), [(math.inf, 0.0), (1e200, 0.0), (1.0, -1.0), (1.0, math.nan)])
def test_lengths_that_no_map_has_are_refused(metres: float, weight: float) -> None:
    with pytest.raises(ValueError, match=r"length_weight|resolution_m"):
        CostGrid(GridSpec(2, 2, metres), PlannerConfig(length_weight=weight))


def test_a_price_of_length_does_not_go_with_climbs() -> None:
    grid = GridSpec(4, 4, 10.0)
    climb = climb_of(grid, np.eye(4, dtype=np.float32), CostConfig(directional=True, slope_rule="tobler"))
    with pytest.raises(ConfigError, match=r"length_weight 0.1; expected .* with climbs 0"):
        RouteFinder(np.ones((4, 4)), resolution_m=10.0, climb=climb, length_weight=0.1)


# --- uphill differs from downhill -----------------------------------------------------------------------------

Paces = Callable[[np.random.Generator, int, int], np.ndarray]


def marked(pace: float, share: float) -> Paces:
    """Ordinary ground on which a share of the cells, or one, has another pace."""

    def draw(rng: np.random.Generator, rows: int, cols: int) -> np.ndarray:
        found = random_pace(rng, rows, cols, 4.0, 0.1)
        free = np.flatnonzero(np.isfinite(found))
        found.flat[rng.choice(free, max(int(share * free.size), 1), replace=False)] = pace
        return found

    return draw


def spread(ratio: float) -> Paces:
    return lambda rng, rows, cols: random_pace(rng, rows, cols, ratio, 0.1)


GROUNDS: dict[str, Paces] = {
    **{f"{pace:g} on {share:g}": marked(pace, share)
       for pace in (1e-12, 1e-8, 1e-4, 1e-2, 1e2, 1e4, 1e8, 1e30) for share in (0.0, 0.03, 0.5)},
    **{f"1 to {ratio:g}": spread(ratio) for ratio in (1.0, 30.0, 1e4, 1e8, 1e16, 1e30)},
}  # fmt: skip


def planned(draw: Paces, seed: int, rows: int, cols: int) -> tuple[CostToGoTree, np.ndarray, int]:
    rng = np.random.default_rng(seed)
    climb = random_climb(rng, GridSpec(rows, cols, 1.0), (0.0, 0.1, 0.4)[seed % 3], (0.3, 10.0)[seed % 2])
    pace = draw(rng, rows, cols)
    costs, root = loaded(pace, climb.grid, climb, **RULES[seed % 5]), open_cell(rng, pace)
    tree = grown(costs, root)
    best = naive.cost_to_go_in_float32(inner(tree, costs.cell_cost), root, climb=climb, **RULES[seed % 5])
    return tree, best, root


@pytest.mark.parametrize("ground", GROUNDS)
def test_costs_are_exact_to_the_last_bit_and_parents_lead_to_the_root(ground: str) -> None:
    seed = sorted(GROUNDS).index(ground)
    tree, best, root = planned(GROUNDS[ground], seed, 19, 23)
    cost, parent, costs = inner(tree, tree.cost), inner(tree, tree.parent), tree.cost_grid
    np.testing.assert_array_equal(cost, best)
    assert tree.reach >= best[np.isfinite(best)].max()
    # Each parent offers what the cell costs, and 23 * 19 steps along them end at the root.
    led = np.flatnonzero(parent != NONE)
    assert led.size == np.isfinite(best).sum() - 1
    codes = parent.flat[led]
    rows, cols = led // 23 + np.array(STEP_ROW)[codes], led % 23 + np.array(STEP_COL)[codes]
    assert costs.climbs is not None
    driven = costs.walk(tree.parent, costs.pad(root), costs.pad_all(led), 1, costs.cell_cost).driven
    np.testing.assert_allclose(cost.flat[led], cost[rows, cols] + driven, rtol=1e-6)
    ways = np.arange(cost.size)
    ways[led] = rows * 23 + cols
    for _ in range(9):
        ways = ways[ways]
    assert (ways[led] == root).all()


@pytest.mark.parametrize("width", [1e-30, 1e-9, 1e-3, 0.7, 30.0, 1e6, 1e30])
@pytest.mark.parametrize("ground", ["1 to 30", "1 to 1e+08", "0.0001 on 0.5"])
def test_costs_are_exact_whatever_the_width_of_the_buckets(ground: str, width: float) -> None:
    tree, best, root = planned(GROUNDS[ground], 7, 17, 15)
    costs = tree.cost_grid
    cost = np.empty(costs.size, np.float32)
    scratch = make_scratch(costs.size)
    grow_by_levels(costs.padded, costs.climbs, cost, costs.pad(root), width, True, scratch)
    np.testing.assert_array_equal(inner(tree, cost), best)


@pytest.mark.parametrize("directed", [True, False])
def test_no_costs_make_a_growth_many_times_as_long(directed: bool) -> None:
    """CPU time of 64 x 64 cells, over that of ordinary ground, in turn: at most 20, measured 0.9 to 10, by
    the processor."""
    climb = random_climb(np.random.default_rng(1), GridSpec(64, 64, 1.0), 0.1, 10.0) if directed else None

    def grow(draw: Paces) -> Callable[[], float]:
        rng = np.random.default_rng(1)
        costs = loaded(draw(rng, 64, 64), climb=climb)
        labels = np.empty(costs.size, np.float32), np.full(costs.size, NONE, np.uint8)
        root = int(rng.choice(np.flatnonzero(np.isfinite(costs.cell_cost))))

        def timed() -> float:
            begun = time.thread_time()
            costs.grow(root, *labels)
            return time.thread_time() - begun

        return timed

    plain = grow(spread(4.0))
    slow = {}
    for name, draw in GROUNDS.items():
        if "e+30" not in name:  # costs whose sums leave float32
            other = grow(draw)
            slow[name] = round(statistics.median(other() / plain() for _ in range(5)), 1)
    assert max(slow.values()) < 20, slow
