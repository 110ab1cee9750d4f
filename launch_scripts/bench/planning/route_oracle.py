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


class Driven(NamedTuple):
    """What became of routes that were driven step by step.

    last    int64 (n,), cell; -1 where a step breaks a rule
    time_s  float64 (n,), s
    """

    last: Cells
    time_s: Seconds


class Ground:
    """All steps of a map as it is now.

    to      int64 (8, cells), where each step leads; -1 where there is none
    time_s  float64 (8, cells), s; inf where there is none
    length_m  float64 (8,)
    """

    def __init__(self, grid: GridSpec, config: PlannerConfig, pace: Floats, climb: Climb | None) -> None:
        cols = grid.cols
        row, col = np.divmod(np.arange(grid.cells), cols)
        free = np.pad(np.isfinite(pace), 1)
        of_pace = np.pad(pace.astype(np.float64), 1, constant_values=math.inf)
        self.length_weight = config.length_weight
        self.length_m = np.full(8, grid.resolution_m)
        if config.edge == "octile":
            self.length_m[1::2] *= math.sqrt(2)
        self.to = np.full((8, grid.cells), -1, np.int64)
        self.time_s = np.full((8, grid.cells), math.inf)
        for code in range(0, 8, 2 if config.neighbours == 4 else 1):
            r, c = row + STEP_ROW[code], col + STEP_COL[code]
            legal = free[row + 1, col + 1] & free[r + 1, c + 1]
            if code % 2 and not config.corner_cutting:
                legal &= free[row + 1, c + 1] & free[r + 1, col + 1]
            here, there = np.flatnonzero(legal), (r * cols + c)[legal]
            seconds = of_pace[r + 1, c + 1][legal] * self.length_m[code]
            if climb is not None:
                seconds = seconds * climb.along(here, there)
            allowed = np.isfinite(seconds)
            self.to[code, here[allowed]] = there[allowed]
            self.time_s[code, here[allowed]] = seconds[allowed]

    def best(self, target: int, length_weight: float = 0.0) -> Seconds:
        """Of each cell the least sum of time and `length_weight`, s/m, times length over all ways to the target, by
        scipy on the reversed graph; inf where there is none."""
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import dijkstra

        code, tail = np.nonzero(self.to >= 0)
        cost = self.time_s[code, tail] + length_weight * self.length_m[code]
        cells = self.to.shape[1]
        backward = csr_matrix((cost, (self.to[code, tail], tail)), shape=(cells, cells))
        found: NDArray[np.float64] = dijkstra(backward, indices=np.array([target]))
        best: Seconds = found[0]
        return best

    def drive(self, routes: RouteBatch) -> Driven:
        """Every route of a batch from its start to the end of what is given of it."""
        last, seconds = np.array(routes.starts), np.zeros(len(routes))
        begin = np.concatenate(([0], routes.ends[:-1])).astype(np.int64)
        steps = routes.ends - begin
        order = np.argsort(-steps, kind="stable")
        for n in range(int(steps.max(initial=0))):
            going = order[: np.searchsorted(-steps[order], -n, side="left")]
            going = going[last[going] >= 0]
            code, cell = routes.directions[begin[going] + n], last[going]
            seconds[going] += self.time_s[code, cell]
            last[going] = self.to[code, cell]
        return Driven(last, seconds)
