"""Exact moves beside full growths of the same roots: by the tree's parents, and by its pieces."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from bench.machine import machine
from bench.planning.fields import Field, make_field
from bench.tables import Progress, number, table, times
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.pieces import PieceTree
from planner_service.tree.windows import exact_half
from swarm.config.scenario import PlannerConfig

Course = Literal["random", "straight"]
COURSES: tuple[Course, ...] = ("random", "straight")
RUN_IN = 3
"""Moves that are not measured: caches fill, scratch is made."""


class _Walk:
    """One target's walk over a field: a tree kept by its parents, one kept by its pieces, one that is grown.

    took_ms  CPU time of each, move by move
    """

    def __init__(self, field: Field, course: Course, rng: np.random.Generator) -> None:
        self._field = field
        self._course = course
        self._rng = rng
        self._heading = int(rng.integers(8))
        self.costs = CostGrid(field.grid, PlannerConfig())
        self.costs.load(field.pace)
        self.mended, self.grown = CostToGoTree(self.costs), CostToGoTree(self.costs)
        self.pieces = PieceTree(self.costs)
        self.cell = int(field.draw(1, rng)[0])
        self.mended.grow(self.cell)
        self.pieces.take(self.cell, self.mended.parent.copy())
        self.took_ms: dict[str, list[float]] = {"parents": [], "pieces": [], "growth": []}
        self.gave_way = {"parents": 0, "pieces": 0}
        self.bit_equal = 0
        self.lowered: list[float] = []

    def move(self) -> None:
        """One cell further, by all three in turn."""
        before, self.cell = self.cell, self._next()
        window = self._field.grid.around(self.cell, exact_half(self._field.grid, before, self.cell))
        began = time.thread_time_ns()
        visited = self.mended.mend() if self.mended.move(self.cell, window) else 0
        exact = self.mended.root == self.cell and self.mended.exact
        if not exact:
            self.mended.grow(self.cell)
        self._note("parents", began)
        self.gave_way["parents"] += not exact
        began = time.thread_time_ns()
        if self.pieces.move(self.cell, window):
            self.pieces.mend()
        followed = self.pieces.root == self.cell and self.pieces.exact
        if not followed:
            self.grown.grow(self.cell)
            self.pieces.take(self.cell, self.grown.parent.copy())
        self._note("pieces", began)
        self.gave_way["pieces"] += not followed
        began = time.thread_time_ns()
        self.grown.grow(self.cell)
        self._note("growth", began)
        same = np.array_equal(self.mended.parent, self.grown.parent)
        self.bit_equal += same and np.array_equal(self.mended.cost, self.grown.cost)
        self.lowered.append(max(visited / self.costs.size - 1.0, 0.0))

    def _next(self) -> int:
        """A neighbour: any, or the one straight on while that can be driven."""
        legal = {direction: cell for direction, cell in self._field.grid.neighbours(self.cell) if self._free(cell)}
        if self._course == "random" or self._heading not in legal:
            self._heading = int(self._rng.choice(list(legal)))
        return legal[self._heading]

    def _free(self, cell: int) -> bool:
        (row, col), (from_row, from_col) = self._field.grid.row_col(cell), self._field.grid.row_col(self.cell)
        pace = self._field.pace
        return bool(np.isfinite([pace[row, col], pace[from_row, col], pace[row, from_col]]).all())

    def _note(self, what: str, began_ns: int) -> None:
        self.took_ms[what].append((time.thread_time_ns() - began_ns) / 1e6)


def run(size: int, field: str, moves: int, seed: int, progress: Progress | None = None) -> dict[str, Any]:
    """CPU milliseconds a move, in turn in one process, of two walks from one root each.

    lowered    share of the map whose costs fell once they had been computed along the parents, mean
    gave_way   share of the moves at which the tree was grown; that is in the times
    bit_equal  share of the moves after which costs and parents were those of the growth
    """
    stage = Field(make_field(field, size, seed))
    rows: list[dict[str, Any]] = []
    for n, course in enumerate(COURSES):
        walk = _Walk(stage, course, np.random.default_rng(seed + 1))
        for done in range(RUN_IN + moves):
            walk.move()
            if progress is not None:
                progress(n * (RUN_IN + moves) + done + 1, len(COURSES) * (RUN_IN + moves))
        took = {what: np.array(times_ms[RUN_IN:]) for what, times_ms in walk.took_ms.items()}
        for by in ("parents", "pieces"):
            rows.append(_row(course, by, took[by], took["growth"], walk.gave_way[by] / (RUN_IN + moves)))
        rows[-2] |= {
            "lowered": round(float(np.mean(walk.lowered[RUN_IN:])), 4),
            "bit_equal": walk.bit_equal / (RUN_IN + moves),
        }
    return {"field": field, "size": list(stage.pace.shape), "moves": moves, "rows": rows, **machine()}


def _row(
    course: Course, by: str, took_ms: NDArray[np.float64], growth_ms: NDArray[np.float64], gave_way: float
) -> dict[str, Any]:
    return {
        "course": course,
        "by": by,
        "p50_ms": round(float(np.median(took_ms)), 3),
        "mean_ms": round(float(took_ms.mean()), 3),
        "p95_ms": round(float(np.quantile(took_ms, 0.95)), 3),
        "growth_p50_ms": round(float(np.median(growth_ms)), 3),
        "ratio_p50": round(float(np.median(growth_ms) / np.median(took_ms)), 2),
        "ratio_mean": round(float(growth_ms.mean() / took_ms.mean()), 2),
        "gave_way": round(gave_way, 3),
        "lowered": None,
        "bit_equal": None,
    }


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    rows, cols = report["size"]
    growth = number(report["rows"][0]["growth_p50_ms"])
    yield f"{report['field']}, {rows} x {cols} cells, {report['moves']} moves; a growth takes {growth} ms."
    found = table(
        "Exact moves, CPU ms, and how many times as long a growth takes",
        *("<course", "<by", "p50", "mean", "p95", "growth /\nmove p50", "\nmean", "gave\nway", "bit-\nequal"),
    )
    for row in report["rows"]:
        found.add_row(
            *(row["course"], row["by"]),
            *(number(row[key]) for key in ("p50_ms", "mean_ms", "p95_ms")),
            *(times(row["ratio_p50"]), times(row["ratio_mean"]), f"{100 * row['gave_way']:.0f} %"),
            "" if row["bit_equal"] is None else f"{100 * row['bit_equal']:.0f} %",
        )
    yield found
