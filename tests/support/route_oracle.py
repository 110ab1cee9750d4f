"""What routes cost and what the best would, from the definitions, in float64: shares no line with the planner."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.terrain.step_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.wire.routes import RouteBatch

Cells = NDArray[np.int64]
Seconds = NDArray[np.float64]

_ROWS, _COLS = np.array(STEP_ROW), np.array(STEP_COL)


class Driven(NamedTuple):
    """What became of routes that were driven step by step.

    last    int64 (n,), cell; -1 where a step breaks a rule
    time_s  float64 (n,), s
    """

    last: Cells
    time_s: Seconds


def best_costs(
    grid: GridSpec,
    config: PlannerConfig,
    pace: Floats,
    climb: Climb | None,
    target: int,
    length_weight: float = 0.0,
) -> Seconds:
    """Of each cell the least sum of time and `length_weight`, s/m, times length over all ways to the target, by
    scipy on the reversed graph; inf where there is none."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    every = np.arange(grid.cells)
    tails, heads, costs = [], [], []
    for code in range(8):
        there, taken = _step(grid, config, pace, climb, every, np.full(grid.cells, code))
        tail = np.flatnonzero(there >= 0)
        length_m = grid.resolution_m * (math.sqrt(2) if code % 2 and config.edge == "octile" else 1.0)
        tails.append(tail)
        heads.append(there[tail])
        costs.append(taken[tail] + length_weight * length_m)
    backward = (np.concatenate(heads), np.concatenate(tails))
    graph = csr_matrix((np.concatenate(costs), backward), shape=(grid.cells, grid.cells))
    found: NDArray[np.float64] = dijkstra(graph, indices=np.array([target]))
    best: Seconds = found[0]
    return best


def drive(grid: GridSpec, config: PlannerConfig, pace: Floats, climb: Climb | None, routes: RouteBatch) -> Driven:
    """Every route of a batch, step by step from its start to the end of what is given of it."""
    last, seconds = np.array(routes.starts), np.zeros(len(routes))
    begin = np.concatenate(([0], routes.ends[:-1])).astype(np.int64)
    steps = routes.ends - begin
    order = np.argsort(-steps, kind="stable")
    for n in range(int(steps.max(initial=0))):
        going = order[: np.searchsorted(-steps[order], -n, side="left")]
        going = going[last[going] >= 0]
        code = routes.directions[begin[going] + n].astype(np.int64)
        there, taken = _step(grid, config, pace, climb, last[going], code)
        last[going] = there
        seconds[going] += taken
    return Driven(last, seconds)


def _step(
    grid: GridSpec, config: PlannerConfig, pace: Floats, climb: Climb | None, here: Cells, code: Cells
) -> tuple[Cells, Seconds]:
    """Where a step leads from each cell and what it takes, s; -1 and inf where the rules forbid it."""
    row, col = np.divmod(here, grid.cols)
    r, c = row + _ROWS[code], col + _COLS[code]
    inside = (r >= 0) & (r < grid.rows) & (c >= 0) & (c < grid.cols)
    r, c, diagonal = np.where(inside, r, row), np.where(inside, c, col), code % 2 == 1
    there = r * grid.cols + c
    length_m = np.where(diagonal & (config.edge == "octile"), math.sqrt(2), 1.0) * grid.resolution_m
    taken = pace[r, c].astype(np.float64) * length_m
    if climb is not None:
        taken = taken * climb.along(here, there)
    legal = inside & np.isfinite(pace[row, col]) & np.isfinite(taken)
    if config.neighbours == 4:
        legal &= ~diagonal
    elif not config.corner_cutting:
        legal &= ~diagonal | (np.isfinite(pace[row, c]) & np.isfinite(pace[r, col]))
    return np.where(legal, there, -1), np.where(legal, taken, math.inf)
