"""Trees, windows and repairs with directional costs, beside those with symmetric costs on the same terrain."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.machine import machine
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.grid import Window

_HALVES = (16, 32, 64)
"""Cells to every side of the windows."""
_PATCHES = (0, 4, 8)
"""The same of patches that become twice as dear, and what they were again; 0 is a mark of one cell."""
_MOVES = 6
"""There and back, in each window."""
_PLACES = 3
"""Windows and patches of each kind for each tree."""


def run(sizes: tuple[int, ...], repeats: int, seed: int) -> dict[str, Any]:
    """CPU milliseconds, in pairs: the same roots, windows and patches, in turn; the first pair is not counted."""
    rows = _rows("jacksboro", TerrainConfig(), repeats, seed)
    for size in sizes:
        terrain = TerrainConfig(
            source="synthetic", rows=size, cols=size, resolution_m=30, relief_m=2.0 * size, roads=6
        )
        rows += _rows(f"synthetic {size} x {size}", terrain, repeats, seed)
    return {"slope_rule": "energy", "repeats": repeats, "rows": rows, **machine()}


class _Side:
    """One of the two, on its terrain."""

    def __init__(self, terrain: Terrain) -> None:
        self.pace = terrain.pace_s_per_m.copy()
        self.costs = CostGrid(terrain.grid, PlannerConfig(), terrain.climb)
        self.costs.load(self.pace)
        self.tree = CostToGoTree(self.costs)
        self.took_ms = 0.0

    def change(self, window: Window, factor: float) -> bool:
        """Whether the tree was repaired; `took_ms` says what that took."""
        self.pace[window.row0 : window.row1, window.col0 : window.col1] *= np.float32(factor)
        changes = self.costs.apply(self.pace, [window])
        began = time.thread_time()
        done = self.tree.repair(changes) >= 0
        self.took_ms = (time.thread_time() - began) * 1e3
        return done


def _rows(name: str, source: TerrainConfig, repeats: int, seed: int) -> list[dict[str, Any]]:
    alike, directed = (
        build_terrain(
            Scenario(seed=seed, terrain=source, cost=CostConfig(slope_rule="energy", directional=directional))
        )
        for directional in (False, True)
    )
    sides = (_Side(alike), _Side(directed))
    rng = np.random.default_rng(seed)
    free = np.flatnonzero(~alike.lethal & ~directed.lethal)
    took: dict[str, list[tuple[float, float]]] = {}
    for _ in range(repeats + 1):
        root = int(rng.choice(free))
        _note(took, "full tree", [_timed(side.tree.grow, root) for side in sides])
        for half in _HALVES:
            _windows(took, sides, half, rng, free)
        for side in sides:
            side.tree.grow(root)
        _patches(took, sides, rng, free)
    return [_row(name, what, pairs[1:]) for what, pairs in took.items() if len(pairs) > 1]


def _windows(
    took: dict[str, list[tuple[float, float]]],
    sides: tuple[_Side, _Side],
    half: int,
    rng: np.random.Generator,
    free: NDArray[np.int64],
) -> None:
    """Moves of one cell, there and back, by windows that lie on the map as a whole. The first does not count: what
    was grown before it has left the caches to the other side."""
    grid = sides[0].costs.grid
    passable = set(free.tolist())
    for _ in range(_PLACES):
        here = int(rng.choice(free))
        window = grid.around(here, half)
        there = [int(cell) for _, cell in grid.neighbours(here) if cell in passable]
        if window.cells < (2 * half + 1) ** 2 or not there:
            continue
        for side in sides:
            side.tree.grow(here)
        for n in range(_MOVES):
            cell = here if n % 2 else there[0]
            pair = [_timed(side.tree.move, cell, window) for side in sides]
            if n and all(side.tree.root == cell for side in sides):
                _note(took, f"window {2 * half + 1} x {2 * half + 1}", pair)


def _patches(
    took: dict[str, list[tuple[float, float]]],
    sides: tuple[_Side, _Side],
    rng: np.random.Generator,
    free: NDArray[np.int64],
) -> None:
    for half in _PATCHES * _PLACES:
        window = sides[0].costs.grid.around(int(rng.choice(free)), half)
        what = f"{2 * half + 1} x {2 * half + 1} cells" if half else "1 cell"
        for factor, becomes in ((2.0, "dearer"), (0.5, "cheaper")):
            done = [side.change(window, factor) for side in sides]
            if not all(done):
                for side in sides:
                    side.tree.grow(side.tree.root)
                continue
            side_ms = [side.took_ms for side in sides]
            _note(took, f"repair, {what} {becomes}", side_ms)


def _timed(work: Callable[..., object], *arguments: object) -> float:
    began = time.thread_time()
    work(*arguments)
    return (time.thread_time() - began) * 1e3


def _note(took: dict[str, list[tuple[float, float]]], what: str, pair: list[float]) -> None:
    took.setdefault(what, []).append((pair[0], pair[1]))


def _row(name: str, what: str, pairs: list[tuple[float, float]]) -> dict[str, Any]:
    alike, directed = (statistics.median(pair[n] for pair in pairs) for n in range(2))
    return {
        "terrain": name,
        "what": what,
        "alike_ms": round(alike, 3),
        "directed_ms": round(directed, 3),
        "ratio": round(directed / alike, 2),
        "pairs": len(pairs),
    }
