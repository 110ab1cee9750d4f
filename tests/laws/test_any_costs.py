"""Any costs of a map: a tree is exact on them, or the map is refused, and nothing overflows."""

import logging
import warnings
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import slow_twins as naive
from support.effort import few
from support.fields import make_field, paces_of_any_ratio
from support.kernel_oracle import inner, loaded
from support.planner_strategies import RULES, STRATEGIES

from planner_service.kernels.cell_costs import CHEAPEST_S, DEAREST_S
from planner_service.target_tree import TargetTree
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window

EXAMPLES = few(60)
TINY, HUGE = float(np.float32(1e-45)), float(np.finfo(np.float32).max)
PACES = st.one_of(
    st.sampled_from([TINY, 1e-38, 1e-6, 1 / 340, 1.0, 100.0, 1e7, 1e30, HUGE, float("inf")]),
    st.floats(min_value=TINY, allow_nan=False, width=32),
)
METRES = st.sampled_from([1e-30, 1e-3, 1.0, 30.0, 1e6, 1e12])
WEIGHTS = st.sampled_from([0.0, 0.0, 1e-30, 0.5, 1e12])


@pytest.fixture(scope="module", autouse=True)
def quiet() -> Iterator[None]:
    """Maps at the bounds are drawn here; the log about each is not checked."""
    log = logging.getLogger("planner_service.tree.cost_grid")
    log.setLevel(logging.ERROR)
    yield
    log.setLevel(logging.NOTSET)


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
        ground = loaded(paces, **rules)
        tree = CostToGoTree(ground)
        target = int(np.flatnonzero(np.isfinite(paces))[1500])
        tree.grow(target)
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


@pytest.mark.parametrize(
    ("metres", "weight"), [(float("inf"), 0.0), (1e200, 0.0), (1.0, -1.0), (1.0, float("nan"))]
)
def test_lengths_that_no_map_has_are_refused(metres: float, weight: float) -> None:
    with pytest.raises(ValueError, match="length_weight"):
        CostGrid(GridSpec(2, 2, metres), PlannerConfig(length_weight=weight))
