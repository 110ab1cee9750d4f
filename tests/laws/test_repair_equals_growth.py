"""A repaired tree is the one that would have grown on the new map: every cost, every parent, to the last bit."""

import numpy as np
import pytest
from support.kernel_oracle import inner
from support.planner_strategies import RULES, random_climb, random_pace
from support.repaired_tree import FACTORS, Patchwork

from shared_map.array_files import Floats
from swarm.grid import GridSpec, Window


def patchwork(rng: np.random.Generator, pace: Floats, n: int, directed: bool) -> Patchwork:
    """A map by the nth rules, directed or not."""
    grid = GridSpec(*pace.shape, 1.0)
    climb = random_climb(rng, grid, (0.0, 0.1, 0.4)[n % 3], (0.3, 0.6)[n % 2]) if directed else None
    return Patchwork(rng, pace, RULES[n % 5], climb)


def trials(count: int, seed: int, shape: tuple[int, int], most_side: int, directed: bool = False) -> int:
    """Number of changes, on maps of all kinds, that were repaired without a fallback."""
    mended = 0
    for n in range(0, count, 12):
        rng = np.random.default_rng([seed, n])
        ratio, walls = (1.0, 4.0, 30.0, 1000.0)[n // 12 % 4], (0.0, 0.15, 0.35)[n // 48 % 3]
        work = patchwork(rng, random_pace(rng, *shape, ratio, walls), n // 12, directed)
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


@pytest.mark.parametrize(("count", "directed"), [(600, False), (180, True)])
def test_repaired_trees_are_those_that_would_have_grown_in_every_cost_and_parent(
    count: int, directed: bool
) -> None:
    assert trials(count, 1, (48, 53), 9, directed) > count // 3


@pytest.mark.slow
def test_two_thousand_four_hundred_repaired_trees_are_those_that_would_have_grown() -> None:
    assert trials(2400, 2, (64, 61), 17) > 1000


@pytest.mark.parametrize("rules", RULES)
def test_a_repair_may_concern_the_whole_map(rules: dict) -> None:
    rng = np.random.default_rng(3)
    work = Patchwork(rng, random_pace(rng, 40, 45, 6.0, 0.2), rules)
    for factor in (2.0, 0.5):
        work.pace *= np.float32(factor)
        assert work.repair_at_any_price(work.costs.apply(work.pace, [work.grid.window])) > 1000
        work.check()


def test_a_wall_across_the_map_takes_the_way_from_all_behind_it_and_a_door_gives_it_back() -> None:
    work = Patchwork(np.random.default_rng(1), np.ones((30, 30), np.float32), RULES[0])
    work.tree.grow(work.grid.cell(2, 2))
    work.pace[15] = np.inf
    work.mend([Window(15, 0, 16, 30)])
    work.check()
    assert np.isinf(inner(work.tree, work.tree.cost)[16:]).all()
    work.pace[15, 29] = 1.0
    work.mend([Window(15, 29, 16, 30)])
    work.check()
    assert np.isfinite(inner(work.tree, work.tree.cost)[16:]).all()


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
        patchwork(rng, random_pace(rng, 40, 45, 6.0, 0.2), n, directed).check_lowered()
