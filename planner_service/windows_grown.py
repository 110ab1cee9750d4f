"""How far a tree is grown when its target moves, and when all of it is due: the row in force says by which rule."""

from __future__ import annotations

from planner_service.growth_times import GrowthTimes
from planner_service.strategy import FullGrowth, OnMove, StrategyRow
from planner_service.tree.windows import WindowSchedule, block_half
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec


class Reach:
    """What was grown of one tree, and when.

    moves  of the target since the whole tree was last exact. The owner counts them
    """

    def __init__(self, grid: GridSpec, config: PlannerConfig, times: GrowthTimes) -> None:
        self.moves = 0
        self._grid = grid
        self._config = config
        self._times = times
        self._side = max(grid.rows, grid.cols)
        # When each width of window was grown last: every growth of a window or of the whole tree is noted there.
        self._schedule = WindowSchedule(grid, times.narrowest)

    def note_whole(self, root: int) -> None:
        """The whole tree of a root is exact."""
        self.moves = 0
        self._schedule.note_grown(root, self._side)

    def note_window(self, cell: int, half: int) -> None:
        """A window of `half` cells to every side was grown, or strides as far."""
        self._schedule.note_grown(cell, half)

    def after_move(self, row: StrategyRow, old: int, new: int, has_network: bool) -> tuple[int, int]:
        """How far to every side of the target all cells are grown now, and how far strides are: no further where
        both are the same."""
        fine = self._times.fine
        has_strides = row.thins_far_cells and has_network and 4 * fine <= self._side
        least = 2 * self._grid.distance_cells(old, new)
        if row.on_move is OnMove.BLOCK_WINDOW:
            half = block_half(self._grid, old, new, self._config.k_min)
            return (min(half, max(fine, least)) if has_strides else half), half
        widest = self._times.widest(row.widest_window)
        if has_strides and self._schedule.beyond(new, widest):
            return max(widest, fine, least), self._side
        half = max(self._schedule.half(new, widest), least)
        return half, half

    def is_whole_due(self, row: StrategyRow, costs_ns: float) -> bool:
        """Whether the whole tree is due to become exact, which takes so long."""
        within_budget = self.moves > 0 and self.moves * self._times.budget_ns >= costs_ns
        return row.full_growth is FullGrowth.WITHIN_BUDGET and within_budget
