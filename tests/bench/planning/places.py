"""Routes between any two places: trees that grow as far as their askers, beside whole growths of the same goals."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from support.fields import Field, make_field
from support.kernel_oracle import loaded

from bench.harness import FieldOption, Seed, benchmark, cpu_ms, track
from planner_service.goal_tree_cache import GoalTrees
from planner_service.tree.cost_to_go import CostToGoTree
from swarm.config.scenario import PLACE_TREES_BYTES
from swarm.grid import Window
from swarm.wire.route_columns import RouteStatus

Cells = NDArray[np.int64]

WITHIN = (20, 60, 200, 0)
"""Largest distances between an asker and its goal, cells; 0 is anywhere."""
CHANGED = 50
"""Cells that change at random before a goal is asked for again: what a few vehicles mark within seconds."""
ROUNDS = 4
"""Rounds of changes, after each of which every goal is asked for again."""
_MANY = 1 << 30


class _Asked:
    """The trees of goals on a field, and what asking them takes."""

    def __init__(self, field: Field, rng: np.random.Generator) -> None:
        self._field, self._rng = field, rng
        self._pace = field.pace.copy()
        self._costs = loaded(self._pace)
        self._whole = CostToGoTree(self._costs)
        self.trees = GoalTrees(self._costs, PLACE_TREES_BYTES)
        self.ask(*self.pairs(1, 0)[0])  # scratch is made

    def pairs(self, many: int, within: int) -> list[tuple[int, int]]:
        """Goals and their askers: one of the cells to stand on that is near enough."""
        grid, home = self._field.grid, self._field.terrain.home
        goals = self._field.draw(many, self._rng).tolist()
        if not within:
            return list(zip(goals, self._field.draw(many, self._rng).tolist(), strict=True))
        rows, cols = np.divmod(home, grid.cols)
        pairs = []
        for goal in goals:
            row, col = grid.row_col(goal)
            near = np.flatnonzero((np.abs(rows - row) <= within) & (np.abs(cols - col) <= within))
            pairs.append((goal, int(home[self._rng.choice(near)])))
        return pairs

    def ask(self, goal: int, asker: int) -> int:
        """Returns how many cells it had to grow."""
        answer = self.trees.ask(goal, asker, _MANY)
        if answer.route.status is not RouteStatus.OK:
            raise AssertionError(f"no route between two connected cells: {answer.route.status}")
        return answer.grown_cells

    def grow_whole(self, goal: int) -> None:
        self._whole.grow(goal)

    def mark(self) -> None:
        """Some cells anywhere become half as costly again, or as cheap."""
        grid = self._field.grid
        cells = self._field.draw(CHANGED, self._rng)
        rows, cols = np.divmod(cells, grid.cols)
        self._pace[rows, cols] *= self._rng.choice(np.array((1.5, 1 / 1.5), np.float32), CHANGED)
        windows = [
            Window(row, col, row + 1, col + 1) for row, col in zip(rows.tolist(), cols.tolist(), strict=True)
        ]
        self.trees.changed(self._costs.apply(self._pace, windows))


@benchmark()
def places(
    size: Annotated[int, typer.Option(min=256, max=8192, help="Cells a side; a file has its own.")] = 1024,
    field: FieldOption = "terrain",
    goals: Annotated[int, typer.Option(min=10, max=100_000, help="Different goals of one process.")] = 1000,
    seed: Seed = 1,
) -> dict[str, Any]:
    """Routes to any place: first asks by distance, asks again, and many goals of one process.

    \b
    ./launch_scripts/bench places
    ./launch_scripts/bench places --size 2048 --goals 300

    CPU time of one thread. first: a goal without a tree; whole: the growth of the whole map in its
    place; again: the same route once more; no growth: share of asks that are answered without one after 50 cells
    anywhere have changed. Then every goal has one asker, within 200 cells or anywhere.
    """
    rng = np.random.default_rng(seed)
    asked = _Asked(Field(make_field(field, size, seed)), rng)
    rows = [_row(asked, within) for within in track(WITHIN)]
    many = [_many(asked, goals, within) for within in track((200, 0))]
    return {"field": field, "size": size, "goals": goals, "rows": rows, "many": many}


def _row(asked: _Asked, within: int) -> dict[str, Any]:
    pairs = asked.pairs(40, within)
    first_ms = np.array([cpu_ms(asked.ask, *pair) for pair in pairs])
    again_ms = np.array([cpu_ms(asked.ask, *pair) for pair in pairs])
    whole_ms = np.array([cpu_ms(asked.grow_whole, goal) for goal, _ in pairs[:10]])
    kept = []
    for _ in range(ROUNDS):
        asked.mark()
        kept += [asked.ask(*pair) == 0 for pair in pairs]
    return {
        "within": within or "anywhere",
        "first_p50_ms": round(float(np.median(first_ms)), 3),
        "first_p95_ms": round(float(np.quantile(first_ms, 0.95)), 3),
        "whole_over_first": round(float(np.median(whole_ms) / np.median(first_ms)), 1),
        "again_p50_us": round(1000 * float(np.median(again_ms)), 1),
        "no_growth": round(float(np.mean(kept)), 2),
    }


def _many(asked: _Asked, goals: int, within: int) -> dict[str, Any]:
    pairs = asked.pairs(goals, within)
    took_ms = sum(cpu_ms(asked.ask, *pair) for pair in pairs)
    return {
        "within": within or "anywhere",
        "goals": goals,
        "routes_per_s": round(1000 * goals / took_ms, 1),
        "trees_kept": asked.trees.trees,
        "kept_MB": round(asked.trees.bytes / 1e6),
    }
