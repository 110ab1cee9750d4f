"""Routes of an air class beside the best way through a stack of levels over the same terrain."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from support.kernel_oracle import loaded

from bench.harness import Seed, benchmark, track
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.array_files import Floats
from shared_map.terrain.terrain import build_terrain
from shared_map.vehicle_class_grounds import AirGround, air_ground, clearance_floor
from swarm.config.ground import TerrainConfig
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import AirConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

LEVELS = 64
"""Levels of the stack, the lowest flight first."""
_STEPS = tuple(zip(STEP_ROW, STEP_COL, strict=True))
_EVERY = 2
"""Every second cell of the terrain is used, because flights are long."""


_ROOTS, _STARTS = 2, 150
"""Trees, and routes of each, that are held against the stack."""


@benchmark(fails=("clearance_broken",))
def air(
    dem: Annotated[str, typer.Option(help="A built-in terrain, or an elevation file.")] = "jacksboro",
    cells: Annotated[int, typer.Option(min=16, max=160, help="A side of the crop.")] = 100,
    grade: Annotated[
        float | None, typer.Option(min=0.001, max=2.0, help="Steepest rise of the surface; by relief if not given.")
    ] = None,
    routes: Annotated[int, typer.Option(min=1, help="Routes whose clearance is looked at.")] = 100_000,
    seed: Seed = 1,
) -> dict[str, Any]:
    """Flights over a surface that follows the terrain, beside the best way through 64 levels.

    \b
    ./launch_scripts/bench air
    ./launch_scripts/bench air --dem ridge.tif --grade 0.2

    Costs of routes over those of the stack, and the clearance along many. The status is 1 where a flight comes
    nearer to the ground than its clearance.
    """
    terrain = build_terrain(Scenario(seed=seed, terrain=TerrainConfig(source=dem)))
    heights: Floats = terrain.elevation_m[: _EVERY * cells : _EVERY, : _EVERY * cells : _EVERY].copy()
    heights[np.isnan(heights)] = np.nanmax(heights)
    rows, cols = heights.shape
    grid = GridSpec(rows, cols, terrain.grid.resolution_m * _EVERY)
    flight = AirConfig(descent_m_per_s=50.0, grade=grade)
    flown = air_ground(grid, heights, flight)
    rng = np.random.default_rng(seed)
    ratios = np.concatenate(
        [
            _over_stack(grid, heights, flown, flight, int(root), rng.choice(grid.cells, _STARTS))
            for root in track(rng.choice(grid.cells, _ROOTS))
        ]
    )
    seen, lowest_m = _clearance(grid, heights, flown, routes, rng)
    return {
        "source": dem,
        "rows": grid.rows,
        "cols": grid.cols,
        "resolution_m": grid.resolution_m,
        "relief_m": round(float(heights.max() - heights.min())),
        "levels": LEVELS,
        "grade": flown.grade,
        "routes": len(ratios),
        "over_stack_mean": round(float(ratios.mean()), 4),
        "over_stack_p95": round(float(np.quantile(ratios, 0.95)), 4),
        "clearance_routes": seen,
        "clearance_m": flight.clearance_m,
        "lowest_m": round(lowest_m, 4),
        "clearance_broken": int(lowest_m < flight.clearance_m),
    }


def _neighbours(grid: GridSpec, south: int, east: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Flat cells that have a neighbour in a direction, and those neighbours."""
    index = np.arange(grid.cells).reshape(grid.rows, grid.cols)
    rows, cols = grid.rows, grid.cols
    tails = index[max(-south, 0) : rows - max(south, 0), max(-east, 0) : cols - max(east, 0)]
    heads = index[max(south, 0) : rows + min(south, 0), max(east, 0) : cols + min(east, 0)]
    return tails.ravel(), heads.ravel()


def _over_stack(
    grid: GridSpec, heights: Floats, flown: AirGround, flight: AirConfig, root: int, starts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Both ways go from the floor to the floor: to climb to the surface or a level counts."""
    floor = clearance_floor(heights, flight.clearance_m).ravel()
    surface = flown.height_m.astype(np.float64).ravel()
    up, down = 1 / flight.climb_m_per_s, 1 / flight.descent_m_per_s
    tree = _grown(grid, flown, root)
    ours = tree.cost_at(tree.cost_grid.pad_all(starts))
    ours = ours + (surface - floor)[starts] * up + (surface - floor)[root] * down
    levels = np.linspace(floor.min(), floor.max(), LEVELS)
    lowest = np.searchsorted(levels, floor - 1e-6)
    best = _stack(grid, levels, lowest, flight, root)[lowest[starts] * grid.cells + starts]
    best = best + (levels[lowest] - floor)[starts] * up + (levels[lowest] - floor)[root] * down
    away = starts != root
    ratios: NDArray[np.float64] = ours[away] / best[away]
    return ratios


def _stack(
    grid: GridSpec, levels: NDArray[np.float64], lowest: NDArray[np.intp], flight: AirConfig, root: int
) -> NDArray[np.float64]:
    """Costs to the root from every cell of every level, by scipy: 26 neighbours."""
    apart_m = float(levels[1] - levels[0])
    tails, heads, seconds = [], [], []
    for south, east in [*_STEPS, (0, 0)]:
        below, ahead = _neighbours(grid, south, east)
        level_s = grid.resolution_m * math.hypot(south, east) / flight.speed_m_per_s
        for rise in (-1, 0, 1):
            if not (south or east or rise):
                continue
            cost_s = level_s + apart_m * (0.0, 1 / flight.climb_m_per_s, 1 / flight.descent_m_per_s)[rise]
            for level in range(max(-rise, 0), LEVELS - max(rise, 0)):
                free = (lowest[below] <= level) & (lowest[ahead] <= level + rise)
                tails.append((level * grid.cells + below[free]).astype(np.int32))
                heads.append(((level + rise) * grid.cells + ahead[free]).astype(np.int32))
                seconds.append(np.full(int(free.sum()), cost_s, np.float32))
    size = LEVELS * grid.cells
    graph = csr_array((np.concatenate(seconds), (np.concatenate(heads), np.concatenate(tails))), shape=(size, size))
    found: NDArray[np.float64] = dijkstra(
        graph, directed=True, indices=np.asarray(lowest[root] * grid.cells + root)
    )
    return found


def _grown(grid: GridSpec, flown: AirGround, root: int) -> CostToGoTree:
    tree = CostToGoTree(loaded(flown.pace_s_per_m, grid, flown.climb))
    tree.grow(root)
    return tree


def _clearance(
    grid: GridSpec, heights: Floats, flown: AirGround, routes: int, rng: np.random.Generator
) -> tuple[int, float]:
    """Number of routes, and the least height over ground: along each step, over the highest cell that it touches.

    Every cell of a tree is the start of one route, and each step of a route is the first step of another: so of a
    tree every step is looked at once.
    """
    lowest_m, seen = math.inf, 0
    while seen < routes:
        tree = _grown(grid, flown, int(rng.choice(grid.cells)))
        parents = tree.parent[tree.cost_grid.pad_all(np.arange(grid.cells))]
        for code, (south, east) in enumerate(_STEPS):
            tails, heads = _neighbours(grid, south, east)
            taken = parents[tails] == code
            under = heights.ravel()[tails[taken]]
            for beside in (heads, tails + south * grid.cols, tails + east):
                under = np.maximum(under, heights.ravel()[beside[taken]])
            flown_m = np.minimum(flown.height_m.ravel()[tails[taken]], flown.height_m.ravel()[heads[taken]])
            if taken.any():
                lowest_m = min(lowest_m, float((flown_m.astype(np.float64) - under).min()))
        seen += grid.cells
    return seen, lowest_m
