"""Planners' claims about their routes hold under every rule, strategy and history; the checks find a false
claim."""

import math
import time

import numpy as np
import pytest
from numpy.typing import NDArray
from support.broken_rules import Broken, in_place_of
from support.effort import few
from support.kernel_oracle import grown, inner, loaded
from support.planner_strategies import random_pace
from support.slow_twins import lower_bound
from support.tree_lives import Findings, Life, lives

from planner_service.kernels.layout import NONE
from planner_service.kernels.tile_pieces import MOST_SLACK
from planner_service.target_tree import TargetTree
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.partitioned_tree import PartitionedTree
from planner_service.tree.routes_with_bounds import LowerBounds, read_routes
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window, walk
from swarm.wire.route_columns import Route, RouteStatus

GRID = GridSpec(40, 60, 2.0)


def checked(seeds: range) -> Findings:
    findings = Findings()
    for seed in seeds:
        Life(seed, findings).live()
    return findings


def test_no_life_breaks_a_law() -> None:
    findings = checked(range(few(4)))
    assert findings.checks > few(4) * 6_000
    assert {law for law, many in findings.violations.items() if many} == set()


@pytest.mark.thorough
def test_no_life_of_many_breaks_a_law() -> None:
    until_s = time.monotonic() + 300
    found = next(each for each in lives(1000) if each.checks >= 3_000_000 or time.monotonic() > until_s)
    assert not any(found.violations.values())


@in_place_of(CostGrid, "walk")
def states_more_than_is_driven(walk, *asked):
    walks = walk(*asked)
    return walks._replace(driven=walks.driven * (1 + 1e-5) + 1e-5)


@in_place_of(LowerBounds, "at")
def proves_too_much(at, *asked):
    return at(*asked) * 1.01


@in_place_of(CostToGoTree, "time_at")
def answers_by_who_else_asks(time_at, tree, cells):
    return np.nextafter(time_at(tree, cells), np.inf if cells.size > 1 else 0.0)


@pytest.mark.parametrize(
    ("broken", "laws"),
    [
        (states_more_than_is_driven, {"stated", "cut"}),
        (proves_too_much, {"bound"}),
        (answers_by_who_else_asks, {"batch"}),
    ],
    ids=lambda each: getattr(each, "__name__", ""),
)
def test_a_false_claim_is_counted_and_its_life_named(
    broken: Broken, laws: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    broken(monkeypatch)
    findings = checked(range(3, 5))
    for law in laws:
        assert findings.violations[law] > 0
        assert findings.example[law] in (3, 4)
    if broken is proves_too_much:
        assert 0.009 < findings.worst["bound"] <= 0.01


def slow_rest(tree: CostToGoTree, cell: int) -> float:
    """From the cell on, step by step, in float64."""
    grid, total = tree.cost_grid, 0.0
    steps = np.array((-grid.stride, 1 - grid.stride, 1, grid.stride + 1, grid.stride, grid.stride - 1, -1))
    steps = np.append(steps, -grid.stride - 1)
    while tree.parent[cell] != NONE:
        code = tree.parent[cell]
        cell += int(steps[code])
        total += float(grid.cell_cost[cell]) * (np.sqrt(2.0) if code % 2 else 1.0)
    return total if cell == grid.pad(tree.root) else np.inf


def a_tree(seed: int, length_weight: float = 0.0) -> tuple[CostToGoTree, NDArray[np.float32]]:
    pace = random_pace(np.random.default_rng(seed), GRID.rows, GRID.cols, 30.0, 0.25)
    pace[20, 30] = 1.0
    return grown(loaded(pace, GRID, length_weight=length_weight), GRID.cell(20, 30)), pace


@pytest.mark.parametrize("seed", range(3))
def test_costs_asked_of_a_tree_are_those_of_its_parents_and_to_the_bit_the_same_alone(seed: int) -> None:
    tree, _ = a_tree(seed)
    tree.move(GRID.cell(20, 30), GRID.around(GRID.cell(20, 30), 5))
    cells = tree.cost_grid.pad_all(np.random.default_rng(seed).permutation(GRID.cells)[:700])
    together = tree.cost_at(cells)
    np.testing.assert_allclose(together, [slow_rest(tree, cell) for cell in cells.tolist()], rtol=1e-13)
    alone = [tree.cost_at(cells[n : n + 1])[0] for n in range(0, cells.size, 7)]
    np.testing.assert_array_equal(together[::7], alone)
    assert np.isinf(together).any()
    assert tree.cost_at(np.array([tree.cost_grid.pad(tree.root)]))[0] == 0


@pytest.mark.parametrize("length_weight", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_bounds_are_what_their_slow_twin_proves(seed: int, length_weight: float) -> None:
    tree, _ = a_tree(seed, length_weight)
    cells = tree.cost_grid.pad_all(np.arange(GRID.cells))
    known, bounds = tree.cost.copy(), LowerBounds(tree.cost_grid)

    def holds(heuristic: NDArray[np.float32] | None) -> bool:
        costs = tree.cost_at(cells)
        proven = [lower_bound(tree, heuristic, *each) for each in zip(cells.tolist(), costs.tolist(), strict=True)]
        assert np.isinf(costs).any()
        np.testing.assert_array_equal(bounds.at(tree, cells), proven)
        return bool(np.any(proven))

    assert holds(None)
    near = [GRID.cell(20 + south, 30 + east) for south, east in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1))]
    root = next(at for at in near if known[tree.cost_grid.pad(at)] < np.inf)
    assert tree.move(root, GRID.around(root, 6))
    assert holds(None)
    bounds.take(known)
    assert holds(known)
    tree.window_bound = None
    assert holds(known)
    bounds.forget()
    assert not holds(None)


def test_an_exact_tree_in_pieces_proves_all_but_what_its_pieces_may_lack() -> None:
    tree, _ = a_tree(1)
    costs = tree.cost_grid
    pieces = PartitionedTree(costs)
    pieces.grow(tree.root)
    cells = costs.pad_all(np.arange(GRID.cells))
    cells = cells[np.isfinite(pieces.cost_at(cells))]
    cost = pieces.cost_at(cells)
    share = np.minimum(2.0**-21 + costs.rounding.at(cost) * 2.0**24 * MOST_SLACK, 1.0)
    np.testing.assert_allclose(LowerBounds(costs).at(pieces, cells), cost * (1.0 - share), rtol=1e-15)


@pytest.mark.parametrize("most", [0, 1, 7])
@pytest.mark.parametrize("seed", range(3))
def test_of_any_cells_it_is_said_whether_there_is_a_route_and_each_is_read_as_alone(seed: int, most: int) -> None:
    tree, pace = a_tree(seed)
    bounds, cost = LowerBounds(tree.cost_grid), inner(tree, tree.cost).reshape(-1)
    asked = np.random.default_rng(seed).integers(-9, GRID.cells + 9, 300)
    asked[-1] = tree.root
    batch = read_routes(tree, bounds, asked, most)
    seen = set()
    for cell, route in zip(asked.tolist(), batch, strict=True):
        if not 0 <= cell < GRID.cells:
            status = RouteStatus.OUTSIDE
        elif not np.isfinite(pace.flat[cell]):
            status = RouteStatus.LETHAL_START
        else:
            status = RouteStatus.OK if np.isfinite(cost[cell]) else RouteStatus.UNREACHABLE
        seen.add(status)
        assert route.status is status
        assert route == read_routes(tree, bounds, np.array([cell]), most)[0]
        if status is not RouteStatus.OK:
            assert route == Route(status=status, start=cell)
            continue
        way = walk(GRID, cell, route.directions)
        diagonal = sum(code % 2 for code in route.directions)
        assert route.length_m == pytest.approx(2 * (len(way) - 1 + diagonal * (math.sqrt(2) - 1)), rel=1e-13)
        assert route.remaining_s == tree.time_at(tree.cost_grid.pad_all(np.array(way[-1:])))[0]
        assert way[-1] == tree.root or len(way) == most + 1
    assert seen == {RouteStatus.OK, RouteStatus.UNREACHABLE, RouteStatus.LETHAL_START, RouteStatus.OUTSIDE}


def test_a_tree_with_a_cycle_is_told_of_and_walked_no_further() -> None:
    tree, _ = a_tree(1)
    here = tree.cost_grid.pad(GRID.cell(5, 5))
    tree.parent[here], tree.parent[here + 1] = 2, 6
    with pytest.raises(AssertionError, match="broken"):
        tree.cost_at(np.array([here]))


def test_time_is_told_where_the_price_of_length_rounds_it_away() -> None:
    """A metre costs a million times what a cell's time does: float32 sums of both hold no digit of the time."""
    tree, pace = a_tree(2, length_weight=1e8)
    costs = tree.cost_grid
    cells = costs.pad_all(np.flatnonzero(np.isfinite(pace)))
    cells = cells[np.isfinite(tree.cost_at(cells))]
    walks = costs.walk(tree.parent, costs.pad(tree.root), cells, 0, costs.time_cost)
    np.testing.assert_allclose(tree.time_at(cells), walks.driven, rtol=1e-13)
    np.testing.assert_array_equal(costs.time_cost[costs.pad_all(np.arange(GRID.cells))], pace.reshape(-1) * 2)
    assert costs.time_share == pytest.approx(2 * pace.min() / (2 * pace.min() + 2e8), rel=1e-6)


def most_steps(costs: CostGrid, cost_s: float) -> int:
    """By the definition: the cheapest cells, one after the other, as long as they cost no more together."""
    return int((np.cumsum(np.sort(costs.cell_cost).astype(np.float64)) <= cost_s).sum())


@pytest.mark.parametrize("seed", range(3))
def test_no_way_is_taken_for_shorter_than_it_may_be_nor_for_much_longer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pace = random_pace(rng, 30, 30, 1e4, 0.2)
    costs = loaded(pace)
    for _ in range(6):
        for cost_s in (0.5, 3.0, 40.0, 1e3, 1e9):
            steps = costs.rounding.at(np.array([cost_s]))[0] * 2**24 - 8
            assert most_steps(costs, cost_s) <= steps <= most_steps(costs, cost_s * 1.13) + 1
        row, col = (int(at) for at in rng.integers(0, 25, 2))
        pace[row : row + 5, col : col + 5] *= np.float32(rng.choice([0.3, 7.0, np.inf]))
        snapshot, before = costs.snapshot(), costs.rounding.at(np.array([40.0]))
        costs.apply(pace, [Window(row, col, row + 5, col + 5)])
        np.testing.assert_array_equal(snapshot.rounding.at(np.array([40.0])), before)
        anew = loaded(pace)
        np.testing.assert_array_equal(anew.rounding.classes, costs.rounding.classes)


def test_one_cheap_cell_leaves_certificates_as_tight_as_they_were() -> None:
    grid = GridSpec(200, 200, 1.0)
    pace = np.ones((200, 200), np.float32)
    tree = TargetTree(grid, PlannerConfig(strategy="full"))
    tree.update(pace, 0, [], 0)
    before = tree.routes([grid.cells - 1])[0].gap
    pace[7, 90] = 1e-6
    tree.update(pace, 0, [Window(7, 90, 8, 91)], 1)
    assert tree.routes([grid.cells - 1])[0].gap - 1 < 1.02 * (before - 1) < 1e-4
