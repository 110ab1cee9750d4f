"""Exact moves beside full growths of the same roots: by the tree's parents, and by its pieces."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray
from support.fields import Field, make_field
from support.kernel_oracle import loaded

from bench.harness import FieldOption, Seed, benchmark, cpu_ms, track
from planner_service.growth_times import exact_half
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.partitioned_tree import PartitionedTree

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
        self.costs = loaded(field.pace)
        self.mended, self.grown = CostToGoTree(self.costs), CostToGoTree(self.costs)
        self.pieces = PartitionedTree(self.costs)
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
        self.took_ms["growth"].append(cpu_ms(self.grown.grow, self.cell))
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


@benchmark(
    columns=("course", "by", "p50_ms", "mean_ms", "p95_ms", "ratio_p50", "ratio_mean", "gave_way", "bit_equal")
)
def moves(
    size: Annotated[int, typer.Option(min=64, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    dem: Annotated[Path | None, typer.Option(help="An elevation file, in place of --field.")] = None,
    moves: Annotated[int, typer.Option(min=1, help="Moves of each walk, one cell each.")] = 100,
    seed: Seed = 1,
) -> dict[str, Any]:
    """Exact trees that follow a target, beside trees that are grown again.

    \b
    ./launch_scripts/bench moves
    ./launch_scripts/bench moves --size 2048 --moves 30
    ./launch_scripts/bench moves --dem ridge.tif --json

    The same roots in turn in one process, on a random walk and straight on: a tree that is made exact by its
    parents, one that lies in pieces, and a growth. CPU ms per move, and the ratio of a growth to it. gave way:
    share of moves at which the tree was grown instead, included in the times; bit equal: share after which the tree
    equals the grown one; lowered: mean share of the map whose costs fell after the computation along the parents.
    """
    stage = Field(make_field(field if dem is None else str(dem), size, seed))
    rows: list[dict[str, Any]] = []
    many = RUN_IN + moves
    for course in track(COURSES):
        walk = _Walk(stage, course, np.random.default_rng(seed + 1))
        for _ in track(range(many)):
            walk.move()
        took = {what: np.array(times_ms[RUN_IN:]) for what, times_ms in walk.took_ms.items()}
        for by in ("parents", "pieces"):
            rows.append(_row(course, by, took[by], took["growth"], walk.gave_way[by] / many))
        rows[-2] |= {"lowered": round(float(np.mean(walk.lowered[RUN_IN:])), 4), "bit_equal": walk.bit_equal / many}
    return {
        "field": field if dem is None else dem.name,
        "size": list(stage.pace.shape),
        "moves": moves,
        "rows": rows,
    }


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
