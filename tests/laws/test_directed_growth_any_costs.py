"""Uphill differs from downhill: for any cell costs, trees are exact to the last bit and grow in about the same
time."""

import statistics
import time
from collections.abc import Callable

import numpy as np
import pytest
from support import slow_twins as naive
from support.kernel_oracle import inner, loaded
from support.planner_strategies import RULES, random_climb, random_pace

from planner_service.kernels.layout import NONE
from planner_service.kernels.queue_directed import grow_directed_by_buckets, make_scratch
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

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
    costs = CostGrid(climb.grid, PlannerConfig(**RULES[seed % 5]), climb)
    pace = draw(rng, rows, cols)
    costs.load(pace)
    root = int(rng.choice(np.flatnonzero(np.isfinite(pace))))
    tree = CostToGoTree(costs)
    tree.grow(root)
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
    grow_directed_by_buckets(costs.padded, cost, costs.pad(root), costs.climbs, width, True, scratch)
    np.testing.assert_array_equal(inner(tree, cost), best)


def test_no_costs_make_a_growth_many_times_as_long() -> None:
    """CPU time of 64 x 64 cells, over that of ordinary ground, in turn: at most 10, measured 0.9 to 5."""
    climb = random_climb(np.random.default_rng(1), GridSpec(64, 64, 1.0), 0.1, 10.0)

    def grow(draw: Paces) -> Callable[[], float]:
        rng = np.random.default_rng(1)
        costs = loaded(draw(rng, 64, 64), climb.grid, climb)
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
    assert max(slow.values()) < 10, slow
