"""Trees, windows and repairs with directional costs, beside those with symmetric costs on the same terrain."""

from __future__ import annotations

import statistics
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from support.kernel_oracle import loaded

from bench.harness import Seed, benchmark, cpu_ms, numbers_of, track
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.scenario import Scenario
from swarm.grid import Window

_HALVES = (16, 32, 64)
"""Cells to every side of the windows."""
_PATCHES = (0, 4, 8)
"""The same for patches that become twice as expensive and then return; 0 is a mark of one cell."""
_MOVES = 6
"""There and back, in each window."""
_PLACES = 3
"""Windows and patches of each kind for each tree."""


@benchmark()
def directed(
    sizes: Annotated[str, typer.Option(help="Cells a side, several with commas.")] = "512,1024,2048",
    repeats: Annotated[int, typer.Option(min=1, help="Roots, the same for both.")] = 7,
    seed: Seed = 1,
) -> dict[str, Any]:
    """Trees, windows and repairs where uphill is not downhill (cost.directional), beside those where it is.

    ./launch_scripts/bench directed --json

    CPU milliseconds, in pairs: the same roots, windows and patches, in turn; the first pair is not counted.
    """
    sources = {"jacksboro": TerrainConfig()}
    for size in numbers_of(sizes, "sizes", 16):
        sources[f"synthetic {size} x {size}"] = TerrainConfig(
            source="synthetic", rows=size, cols=size, resolution_m=30, relief_m=2.0 * size, roads=6
        )
    rows = [row for name, source in track(sources.items()) for row in _rows(name, source, repeats, seed)]
    return {"slope_rule": "energy", "repeats": repeats, "rows": rows}


class _Side:
    """One of the two, on its terrain."""

    def __init__(self, terrain: Terrain) -> None:
        self.pace = terrain.pace_s_per_m.copy()
        self.costs = loaded(self.pace, terrain.grid, terrain.climb)
        self.tree = CostToGoTree(self.costs)
        self.took_ms = 0.0

    def change(self, window: Window, factor: float) -> bool:
        """True if the tree was repaired; `took_ms` gives the time."""
        self.pace[window.row0 : window.row1, window.col0 : window.col1] *= np.float32(factor)
        changes = self.costs.apply(self.pace, [window])
        done = []
        self.took_ms = cpu_ms(lambda: done.append(self.tree.repair(changes) >= 0))
        return done[0]


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
        _note(took, "full tree", [cpu_ms(side.tree.grow, root) for side in sides])
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
    """Moves of one cell, there and back, by windows that lie on the map as a whole. The first is not counted: the
    growth before it has evicted the caches of the other side."""
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
            pair = [cpu_ms(side.tree.move, cell, window) for side in sides]
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
