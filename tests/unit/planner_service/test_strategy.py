"""The table of strategies: every name has a row, and the row alone says what a tree and its planner do."""

import itertools
from collections.abc import Iterator
from dataclasses import fields
from itertools import product
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from support.planner_play import Play
from support.planner_strategies import Job, Marks, Move, random_pace

from planner_service import strategy as strategies
from planner_service.growth_times import (
    MODEL_EXACT_NS_PER_CELL,
    MODEL_NEAR_NS_PER_CELL,
    NEAR_CELLS,
    TRIED_AFTER,
    GrowthTimes,
)
from planner_service.target_tree import TargetTree
from planner_service.tree import partitioned_tree
from swarm.config.plugin_names import PLUGIN_KINDS, NamedPlugin
from swarm.config.scenario import PlannerConfig, Strategy
from swarm.grid import GridSpec, Window
from swarm.plugins import Plugin

GRID = GridSpec(96, 96, 1.0)
row_of: Any = strategies.StrategyRow


def kinds_of_moves(config: PlannerConfig, row: strategies.StrategyRow, moves: int) -> list[str]:
    """The growth at each move of one cell to the east; "!" if a full growth, "~" if strides were asked for."""
    pace = np.ones((GRID.rows, GRID.cols), np.float32)
    tree = TargetTree(GRID, config, chosen_by=row)
    tree.update(pace, GRID.cell(48, 20), [], 0)
    updates = [tree.update(pace, GRID.cell(48, 21 + n), [], 0) for n in range(moves)]
    asked = "~" if tree.wants_strides else ""
    return [update.kind + ("!" if update.wants_full else "") + asked for update in updates]


def test_every_strategy_of_the_scenario_has_a_row_and_every_row_a_name() -> None:
    assert set(strategies.STRATEGIES) == {*strategies.ROWS, "auto"} == set(get_args(Strategy))
    assert set(strategies.STAGES) == set(get_args(strategies.Stage))


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (row_of(strategies.OnMove.WHOLE_TREE), ["full"] * 5),
        (row_of(strategies.OnMove.BLOCK_WINDOW), ["window"] * 5),
        (row_of(strategies.OnMove.BLOCK_WINDOW, thins_far_cells=True), ["window~"] * 5),
        (row_of(strategies.OnMove.SCHEDULED_WINDOW), ["window"] * 5),
        (row_of(strategies.OnMove.EXACT_MOVE), ["exact"] * 5),
        (row_of(strategies.OnMove.SCHEDULED_WINDOW, renews_within_budget=True), ["window", "window", "exact"] * 2),
    ],
)
def test_a_tree_does_what_its_row_says_whatever_the_strategy_is_called(row, expected):
    exact_s = GRID.cells * MODEL_EXACT_NS_PER_CELL * 1e-9
    config = PlannerConfig(k_min=0, cpu_budget=exact_s / 2.5 * PlannerConfig().tick_hz)
    assert kinds_of_moves(config, row, len(expected)) == expected


def test_until_all_kernels_are_compiled_every_row_grows_whole_trees() -> None:
    for row in every_row():
        whole = strategies.whole_trees_only(row)
        assert whole.on_move is strategies.OnMove.WHOLE_TREE
        assert not whole.thins_far_cells
        assert whole.renews_loose_bounds == row.renews_loose_bounds


def every_row() -> list[strategies.StrategyRow]:
    hints = get_type_hints(strategies.StrategyRow)
    values = [
        (False, True) if hints[field.name] is bool else tuple(hints[field.name])
        for field in fields(strategies.StrategyRow)
    ]
    return [strategies.StrategyRow(*each) for each in product(*values)]


ASKED_TIMES = 7
"""Number of calls of a strategy in one history."""


class AnyRow:
    """Another row each time: of all histories together, every row."""

    def __init__(self, seed: int) -> None:
        rows = every_row()
        order = np.random.default_rng(1).permutation(len(rows))
        self.rows = [rows[order[(seed * ASKED_TIMES + n) % len(rows)]] for n in range(ASKED_TIMES)]

    def row(self, growths: strategies.Growths) -> strategies.StrategyRow:
        return self.rows.pop() if len(self.rows) > 1 else self.rows[0]


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=[pytest.mark.thorough] if seed % 4 else []) for seed in range(11)]
)
def test_whatever_rows_a_strategy_chooses_routes_keep_the_laws(seed: int) -> None:
    chance = np.random.default_rng(seed)
    pace = random_pace(chance, 40, 37, 10.0, 0.15)
    play = Play(pace, PlannerConfig(k_min=1, cpu_budget=1e-9), chosen_by=AnyRow(seed))
    for step in range(60):
        play.happen(Move(int(chance.integers(-1, 2)), int(chance.integers(-1, 2))))
        if step % 3 == 0:
            play.happen(Marks(step, 2))
        if step % 10 == 5:
            play.happen(Job("begin"))
        if step % 10 == 8:
            play.happen(Job("end"))
            play.tree.times.observe_full_ns(int(chance.integers(1, 10**8)))
        play.check()
    assert len(play.tree.times._chosen_by.rows) == 1  # type: ignore[attr-defined]


# --- plug-ins ---------------------------------------------------------------------------------------------------


def plugged(answer: Any) -> tuple[Any, list[str]]:
    """A strategy whose plug-in gives this answer, its messages."""

    class Answers:
        def row(self, growths: strategies.Growths) -> Any:
            return answer() if callable(answer) else answer

    named = NamedPlugin(PLUGIN_KINDS["strategy"], "planner.strategy", "my:Own", {})
    told: list[str] = []
    plugin = Plugin(named, lambda world, options: Answers(), {})
    return strategies.strategy_of(plugin, strategies.StrategyWorld("t", GRID, PlannerConfig()), told.append), told


ASKED = strategies.Growths(1e6, 1e7, 64, GRID.cells, 4e5)


def test_a_plugins_row_is_in_force() -> None:
    row = strategies.StrategyRow(strategies.OnMove.BLOCK_WINDOW, renews_within_budget=True)
    strategy, told = plugged(row)
    assert strategy.row(ASKED) == row
    assert TargetTree(GRID, PlannerConfig(strategy="my:Own"), chosen_by=strategy).strategy == row
    assert not told


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda: 1 / 0, "raised ZeroDivisionError"),
        (None, "returned NoneType, expected a StrategyRow"),
        ("full", "returned str, expected a StrategyRow"),
        (row_of("whole tree"), "on_move is 'whole tree', expected a OnMove"),
        (row_of(strategies.OnMove.WHOLE_TREE, thins_far_cells=1), "thins_far_cells is 1, expected a bool"),
    ],
)
def test_a_strategy_that_fails_is_named_and_trees_stay_exact(answer: object, said: str) -> None:
    strategy, told = plugged(answer)
    assert strategy.row(ASKED).on_move is strategies.OnMove.EXACT_MOVE
    assert strategy.row(ASKED).on_move is strategies.OnMove.EXACT_MOVE
    (fault,) = told
    assert "strategy plug-in 'my:Own' of planner.strategy: row r" in fault
    assert said in fault
    assert fault.endswith("this planner keeps exact trees now")


@pytest.mark.parametrize("took_ms", [[500], [1000], [1500], [5000], [5000, 1000, 4000]])
def test_growths_that_took_long_as_they_were_cut_up_do_not_leave_a_large_tree_to_windows(took_ms):
    times = GrowthTimes(GridSpec(4096, 4096, 10.0), PlannerConfig(cpu_budget=0.05, tick_hz=5.0), True, False, None)
    for each in took_ms:  # 5,000 where ten planners grow at once on a busy machine
        times.observe_full_ns(each * 1_000_000)
    assert times.exact_ns < 20e6  # `bench moves --size 4096` measures 10 ms, where a growth takes 30 times as long
    for tick in range(200):
        times.note_tick(tick % 16 == 0)
    assert times.row.on_move is strategies.OnMove.EXACT_MOVE
    for _ in range(2):
        assert times.row.on_move is strategies.OnMove.EXACT_MOVE  # one slow move may have had cold caches
        times.observe_exact_ns(200_000_000)
    assert not times.mends_quickly
    assert times.row.on_move is not strategies.OnMove.EXACT_MOVE


def dear_tree(full_ns: int) -> GrowthTimes:
    """Growths of such a time, and exact moves of three times what a tick may take."""
    times = GrowthTimes(GridSpec(2048, 2048, 10.0), PlannerConfig(cpu_budget=0.1), True, False, None)
    times.observe_full_ns(full_ns)
    for _ in range(3):
        times.observe_exact_ns(30_000_000)
    return times


def test_auto_keeps_a_costly_tree_exact_for_a_target_that_moves_seldom() -> None:
    for every, stage in ((20, strategies.OnMove.EXACT_MOVE), (1, strategies.OnMove.SCHEDULED_WINDOW)):
        times = dear_tree(150_000_000)
        for tick in range(200):
            times.note_tick(tick % every == 0)
        assert times.row.on_move is stage


@pytest.mark.parametrize("side", [128, 256, 512, 1024, 2048, 4096])
def test_auto_takes_the_cheaper_of_a_growth_to_the_askers_and_an_exact_move_and_stays_with_it(side: int) -> None:
    """On a machine no faster than the one of the models, with times that vary by a tenth."""
    chance, grid = np.random.default_rng(side), GridSpec(side, side, 10.0)
    for _ in range(20):
        times, whole = GrowthTimes(grid, PlannerConfig(cpu_budget=1.0), False, False, None), False
        per_cell_ns, exact_ns = chance.uniform(1, 4, 2) * (MODEL_NEAR_NS_PER_CELL, times.exact_ns)
        for half in chance.integers(4, side // 2, 4).tolist():
            times.note_near((2 * half) ** 2)
            taken, costs_ns = [], {"bounded": ((2 * half) ** 2 + NEAR_CELLS) * per_cell_ns, "exact": exact_ns}
            for _ in range(30):
                taken.append("bounded" if times.stops(whole) else "exact")
                times.observe(taken[-1], int(costs_ns[taken[-1]] * chance.uniform(0.9, 1.1)))
                whole = taken[-1] == "exact"
            assert sum(before != after for before, after in itertools.pairwise(taken)) <= 2, taken
            assert costs_ns[taken[-1]] <= 1.25 / strategies.HYSTERESIS * min(costs_ns.values())


@pytest.mark.parametrize(
    ("better", "near", "took_ns"), [("exact", 170_000, 2_400_000), ("bounded", 10_000, 100_000)]
)
def test_auto_returns_to_the_better_way_to_follow_a_target_after_it_was_slow_on_a_busy_machine(
    better: str, near: int, took_ns: int
) -> None:
    times = GrowthTimes(GridSpec(512, 512, 10.0), PlannerConfig(cpu_budget=1.0), False, False, None)
    costs_ns = {"exact": times.exact_ns, "bounded": took_ns}
    times.note_near(near)
    for _ in range(5):
        times.observe(better, 20 * costs_ns[better])
    taken = []
    for _ in range(2 * TRIED_AFTER):
        taken.append("bounded" if times.stops(is_whole=taken[-1:] == ["exact"]) else "exact")
        times.observe(taken[-1], costs_ns[taken[-1]])
    assert taken[0] != better
    assert taken[-1] == better
    assert sum(before != after for before, after in itertools.pairwise(taken)) == 1


def test_growths_that_are_quick_again_tell_that_those_which_stop_are_too() -> None:
    times = GrowthTimes(GridSpec(4096, 4096, 10.0), PlannerConfig(cpu_budget=0.1), True, False, None)
    times.note_near(40_000)
    times.observe_full_ns(3_000_000_000)
    for kind in ["exact", "bounded"] * 5:
        times.observe(kind, 70_000_000)
    times.note_near(40_000)
    assert times.row.on_move is strategies.OnMove.SCHEDULED_WINDOW
    for _ in range(5):
        times.observe_full_ns(300_000_000)
    assert times.near_ns < times.budget_ns
    assert times.row.on_move is strategies.OnMove.EXACT_MOVE


def large_tree(clock: Iterator[int] | None = None) -> tuple[TargetTree, np.ndarray, GridSpec]:
    """An exact tree in pieces that only a worker may grow again, and the paces that it was given."""
    grid = GridSpec(512, 512, 1.0)
    stopwatch = (lambda: 0) if clock is None else clock.__next__
    tree = TargetTree(grid, PlannerConfig(cpu_budget=0.1), has_worker=True, stopwatch=stopwatch)
    pace = np.ones((grid.rows, grid.cols), np.float32)
    tree._askers.note(np.array([0]), grid.cells)  # from everywhere: a growth that stops would save nothing
    tree.update(pace, grid.cell(100, 100), [], 0)
    for kind in ("full", *["bounded"] * 3):
        tree.times.observe(kind, 10**9)
    assert tree.strategy.on_move is strategies.OnMove.EXACT_MOVE
    return tree, pace, grid


def leave_to_windows(tree: TargetTree) -> None:
    """Exact moves take longer than a tick may."""
    for _ in range(3):
        tree.times.observe_exact_ns(300_000_000)
    assert tree.strategy.on_move is strategies.OnMove.SCHEDULED_WINDOW


def test_what_a_repair_took_is_not_taken_for_the_move_that_follows_it() -> None:
    tree, pace, grid = large_tree(itertools.count(0, 7))
    pace[200, 200] = 5.0
    update = tree.update(pace, grid.cell(100, 101), [Window(200, 200, 201, 201)], 1)
    assert (update.kind, update.repair_ns) == ("exact", 7)
    assert tree.update(pace, grid.cell(100, 102), [], 1).repair_ns == 0


def test_a_large_tree_in_pieces_is_not_turned_into_one_with_all_costs_between_two_answers() -> None:
    tree, pace, grid = large_tree()
    leave_to_windows(tree)
    update = tree.update(pace, grid.cell(100, 101), [], 0)
    assert (update.kind, update.cells, update.wants_full) == ("none", 0, True)
    assert (tree.ready, tree.target_cell) == (True, grid.cell(100, 100))  # and it says where it leads meanwhile
    tree.adopt(tree.full_job(grid.cell(100, 101))(), pace, grid.cell(100, 101), [], 0, np.empty(0, np.int64))
    assert tree.target_cell == grid.cell(100, 101)
    assert tree.update(pace, grid.cell(100, 102), [], 0).kind == "window"


def test_a_tree_in_pieces_that_a_worker_brings_late_is_not_turned_into_one_with_all_costs(monkeypatch):
    tree, pace, grid = large_tree()
    grown = tree.full_job(grid.cell(100, 101))()  # asked for while the row in force was exact
    leave_to_windows(tree)
    monkeypatch.setattr(partitioned_tree, "in_cells", lambda each: pytest.fail("turned into one with all costs"))
    update = tree.adopt(grown, pace, grid.cell(100, 102), [], 0, np.empty(0, np.int64))
    assert (tree.target_cell, update.wants_full) == (grid.cell(100, 101), True)


@pytest.mark.parametrize("tick_hz", [1.0, 5.0, 20.0])
@pytest.mark.parametrize("cpu_budget", [0.05, 0.5, 1.0])
def test_work_and_the_rest_after_it_keep_to_the_share_of_a_core_whatever_the_ticks(tick_hz, cpu_budget):
    config = PlannerConfig(cpu_budget=cpu_budget, tick_hz=tick_hz)
    times = GrowthTimes(GridSpec(64, 64, 10.0), config, True, False, None)
    assert times.rest_ns(10_000_000) == pytest.approx(10_000_000 / cpu_budget, abs=1)
    times.set_budget(cpu_budget / 2)
    assert times.rest_ns(10_000_000) == pytest.approx(20_000_000 / cpu_budget, abs=1)


def test_a_load_that_has_ended_brings_a_large_tree_back_to_exact_moves() -> None:
    times = dear_tree(400_000_000)
    assert times.row.on_move is strategies.OnMove.SCHEDULED_WINDOW
    for _ in range(3):
        times.observe_full_ns(70_000_000)
    assert times.row.on_move is strategies.OnMove.EXACT_MOVE


def test_windows_do_not_forget_that_vehicles_are_far_and_grow_no_tree_to_find_it_out() -> None:
    tree, pace, grid = large_tree()
    far = np.array([grid.cell(500, 500)])
    leave_to_windows(tree)
    tree.adopt(tree.full_job(grid.cell(100, 101))(), pace, grid.cell(100, 101), [], 0, far)
    kinds = set()
    for n in range(80):
        tree.routes(far)
        kinds.add(tree.update(pace, grid.cell(100, 102 + n % 2), [], 0).kind)
    assert kinds == {"window"}
