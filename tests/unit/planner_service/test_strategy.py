"""The table of strategies: every name has a row, and the row alone says what a tree and its planner do."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from planner_service import strategy as table
from planner_service.strategy import STAGES, STRATEGIES, FullGrowth, OnMove, StrategyRow, row_of
from planner_service.target_tree import TargetTree
from swarm.config.scenario import WHOLE_TREE_STRATEGIES, PlannerConfig, Strategy
from swarm.grid import GridSpec

GRID = GridSpec(96, 96, 1.0)


def kinds_of_moves(config: PlannerConfig, moves: int) -> list[str]:
    """What each of so many moves of one cell to the east grew; "!" if a full growth, "~" if corridors were asked
    for."""
    pace = np.ones((GRID.rows, GRID.cols), np.float32)
    tree = TargetTree(GRID, config)
    tree.update(pace, GRID.cell(48, 20), [], 0)
    updates = [tree.update(pace, GRID.cell(48, 21 + n), [], 0) for n in range(moves)]
    asked = "~" if tree.wants_corridors else ""
    return [update.kind + ("!" if update.wants_full else "") + asked for update in updates]


def test_every_strategy_of_the_scenario_has_a_row_and_every_row_a_name() -> None:
    assert {*STRATEGIES, "auto"} == set(get_args(Strategy))
    assert set(STAGES) == set(get_args(table.Stage))
    exact = {name for name, row in STRATEGIES.items() if row.on_move is OnMove.WHOLE_TREE}
    assert {*exact, "auto"} == set(WHOLE_TREE_STRATEGIES)


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (StrategyRow(OnMove.WHOLE_TREE), ["full"] * 5),
        (StrategyRow(OnMove.BLOCK_WINDOW), ["window"] * 5),
        (StrategyRow(OnMove.BLOCK_WINDOW, thins_far_cells=True), ["window~"] * 5),
        (StrategyRow(OnMove.SCHEDULED_WINDOW), ["window"] * 5),
        (StrategyRow(OnMove.SCHEDULED_WINDOW, FullGrowth.EVERY_FEW_MOVES), [*["window"] * 2, *["window!"] * 3]),
    ],
)
def test_a_tree_does_what_its_row_says_whatever_the_strategy_is_called(
    row: StrategyRow, expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STRATEGIES, "rotation", row)  # type: ignore[arg-type]
    assert kinds_of_moves(PlannerConfig(strategy="rotation", k_min=0, full_every=3), 5) == expected


@pytest.mark.parametrize("strategy", get_args(Strategy))
@pytest.mark.parametrize("stage", get_args(table.Stage))
def test_where_uphill_is_not_downhill_every_strategy_grows_whole_trees(
    strategy: Strategy, stage: table.Stage
) -> None:
    row = row_of(strategy, stage, only_whole=True)
    assert row.on_move is OnMove.WHOLE_TREE
    assert not row.thins_far_cells
    assert row.renews_loose_bounds == row_of(strategy, stage, only_whole=False).renews_loose_bounds
