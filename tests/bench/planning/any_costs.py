"""Growths where costs differ by any ratio, beside one of the field as it is."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec

Paces = NDArray[np.float32]


def paces_of_any_ratio(pace: Paces, rng: np.random.Generator) -> Iterator[tuple[str, Paces]]:
    """What is met on real maps, and what is made against a queue of buckets. Lethal cells stay so."""
    rows, cols = pace.shape
    usual = np.float32(np.median(pace[np.isfinite(pace)]))
    middle = int(np.flatnonzero(np.isfinite(pace))[np.isfinite(pace).sum() // 3])
    for name, value in (("one dear cell, x 1e5", 1e5), ("one cheap cell, x 1e-5", 1e-5)):
        marked = pace.copy()
        marked.flat[middle] = usual * np.float32(value)
        yield name, marked
    marked = pace.copy()
    marked[rows // 2] = usual * np.float32(1e-3)
    yield "a road, x 1e-3", marked
    yield "one cell in 35, x 30,000", pace * np.where(rng.random(pace.shape) < 1 / 35, 30_000, 1).astype(np.float32)
    for value in (1e-3, 1e-5):
        yield (
            f"the left half, x {value:g}",
            pace * np.where(np.arange(cols) < cols // 2, value, 1).astype(np.float32),
        )
        yield (
            f"every other cell, x {value:g}",
            pace * np.where(rng.random(pace.shape) < 0.5, value, 1).astype(np.float32),
        )
    for ratio in (1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7):
        random = (ratio ** rng.random(pace.shape)).astype(np.float32)
        yield f"log-uniform, 1 to {ratio:g}", np.where(np.isfinite(pace), random, pace)


def growths_of_any_ratio(pace: Paces, repeats: int, seed: int) -> list[dict[str, Any]]:
    """A row per kind of costs: medians over `repeats` roots, in turn with growths of `pace` itself.

    growth_ms     CPU time of a whole tree
    over_usual    the same over that of `pace`
    """
    rng = np.random.default_rng(seed + 2)
    roots = rng.choice(np.flatnonzero(np.isfinite(pace)), repeats).tolist()
    usual = _tree(pace)
    rows = []
    for name, paces in paces_of_any_ratio(pace, rng):
        took: tuple[list[float], list[float]] = [], []
        other = _tree(paces)
        for root in (roots[0], *roots):
            for tree, times_ms in zip((usual, other), took, strict=True):
                begin = time.thread_time_ns()
                tree.grow(root)
                times_ms.append((time.thread_time_ns() - begin) / 1e6)
        usual_ms, other_ms = (float(np.median(times_ms[1:])) for times_ms in took)
        rows.append({"costs": name, "growth_ms": round(other_ms, 3), "over_usual": round(other_ms / usual_ms, 2)})
    return rows


def _tree(pace: Paces) -> CostToGoTree:
    cost_grid = CostGrid(GridSpec(pace.shape[0], pace.shape[1], 1.0), PlannerConfig())
    cost_grid.load(pace)
    return CostToGoTree(cost_grid)
