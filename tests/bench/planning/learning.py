"""What learning gains where the prior of one class of ground is wrong: error of the map, and regret of routes.

Beside what is learned stands what can be: routes by a map that has the class exactly right, and knows nothing of
how each cell differs from its class.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from bench.tables import Progress
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.arrays import Floats
from shared_map.learning.factors import Measured, factors_of, keys_of
from shared_map.terrain.terrain import Terrain
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW

_VEHICLES = 10
_LEG_CELLS = 25
_LOCAL, _NOISE = 0.2, 0.25
_PROBES = 12
LOOKS = (1, 5, 20)
"""After so many legs of every vehicle the map is judged."""
_NONE = 255

Cells = NDArray[np.int64]


def run_learning(
    terrain: Terrain, seeds: Sequence[int], agents: int, wrong: bool, progress: Progress
) -> dict[str, Any]:
    """Each seed with another class wrong, by 3 or by a third; or none, to count false alarms."""
    runs: list[list[Look]] = []
    for n, seed in enumerate(seeds):
        runs.append(LearningRun(terrain, seed, agents, wrong).looks())
        progress(n + 1, len(seeds))
    mean = np.mean([[look[:-1] for look in looks] for looks in runs], axis=0)
    moved = [max(look.moved for look in looks) for looks in runs]
    return {
        "seeds": list(seeds),
        "agents": agents,
        "wrong": wrong,
        "rows": [dict(zip(Look._fields[:-1], row, strict=True)) for row in mean.tolist()],
        "right_classes_moved": int(sum(each > 0.05 for each in moved)),
        "right_classes_moved_most": float(max(moved)),
    }


class Look(NamedTuple):
    """How good the maps are after some legs. Errors are of ln(pace), regrets driven cost over that by the true map.

    driven        share of the cells
    with_marks    regret by what is learned, and by what was measured on the very cells that were driven
    class_exact   regret by a map that has the class right, and knows no cell: what learning by classes can reach
    moved         mean |ln(factor)| of the class that was moved most of those that are right
    """

    driven: float
    error_prior: float
    error: float
    regret_prior: float
    regret: float
    with_marks: float
    class_exact: float
    moved: float


class LearningRun:
    """Ten vehicles on the terrain of one seed.

    true      float32 (rows, cols)  what is driven, s/m; lethal cells are infinite
    wrong_by  float64 (rows, cols)  by what the truth of the wrong class differs from the prior
    learned   float32 (rows, cols)  the prior times what is learned so far
    seen      the cells that were driven, a leg an entry
    """

    def __init__(self, terrain: Terrain, seed: int, agents: int, wrong: bool) -> None:
        rng = self._rng = np.random.default_rng(seed)
        self._grid = terrain.grid
        self._prior = np.array(terrain.pace_s_per_m, np.float32)
        self._classes = np.asarray(terrain.classes)
        self._keys = keys_of(terrain.classes, terrain.elevation_m, self._grid.resolution_m)
        self._ok = np.isfinite(self._prior)
        shares = {int(c): float((self._classes == c).mean()) for c in np.unique(self._classes)}
        big = [c for c, s in shares.items() if 0.1 < s < 0.6 and self._ok[self._classes == c].mean() > 0.5]
        self._wrong = big[seed % len(big)] if wrong else -1
        self.wrong_by = np.where(self._classes == self._wrong, 3.0 if seed % 2 == 0 else 1 / 3, 1.0)
        by = self.wrong_by * np.exp(_LOCAL * rng.standard_normal(self._prior.shape) - _LOCAL**2 / 2)
        self.true = (self._prior * by).astype(np.float32)
        self._home = np.flatnonzero(self._ok)
        self._places = rng.choice(self._home, _VEHICLES)
        self._authors = [Measured(self._keys) for _ in range(agents)]
        self._probes = rng.choice(self._home, (_PROBES, 2)).tolist()
        self._marked = self._prior.copy()
        """What was measured where vehicles drove; nan elsewhere."""
        self._marked.fill(np.nan)
        self.seen: list[Cells] = []

    def looks(self) -> list[Look]:
        """After so many legs as `LOOKS` says."""
        best = self._driven(self.true)
        both = np.isfinite(best) & (best > 0)

        def regret(pace: Floats) -> float:
            return float((self._driven(pace)[both] / best[both]).mean())

        prior, exact = regret(self._prior), regret((self._prior * self.wrong_by).astype(np.float32))
        found = []
        for leg in range(1, LOOKS[-1] + 1):
            self.drive()
            if leg in LOOKS:
                learned = self.learned
                marked = np.where(np.isnan(self._marked), learned, self._marked)
                driven = len(np.unique(np.concatenate(self.seen))) / self._prior.size
                errors = self._error(self._prior), self._error(learned)
                found.append(Look(driven, *errors, prior, regret(learned), regret(marked), exact, self._moved()))
        return found

    @property
    def learned(self) -> Floats:
        return np.asarray(self._prior * self._factors()[self._keys], np.float32)

    def _factors(self) -> Floats:
        return factors_of([each.said for each in self._authors])

    def _error(self, pace: Floats) -> float:
        return float(np.sqrt(np.mean(np.log(pace[self._ok] / self.true[self._ok]) ** 2)))

    def _moved(self) -> float:
        """Mean |ln factor| over the cells of the right class that was moved most."""
        off = np.abs(np.log(self._factors()[self._keys]))
        right = [c for c in np.unique(self._classes) if c != self._wrong]
        there = ((self._classes == c) & self._ok for c in right)
        return max((float(off[cells].mean()) for cells in there if cells.any()), default=0.0)

    def drive(self) -> None:
        """A leg of every vehicle, by what is learned so far."""
        pace = self.learned
        for vehicle in range(_VEHICLES):
            goal = int(self._rng.choice(self._home))
            route = self._route(pace, goal, int(self._places[vehicle]))[: _LEG_CELLS + 1]
            if len(route) < 2:
                self._places[vehicle] = goal
                continue
            self._places[vehicle] = route[-1]
            author = self._authors[vehicle % len(self._authors)]
            noise = np.exp(_NOISE * self._rng.standard_normal(len(route) - 1))
            for cell, by in zip(route[1:].tolist(), noise.tolist(), strict=True):
                measured = self.true.item(cell) * by
                author.add(cell, measured, self._prior.item(cell))
                self._marked.reshape(-1)[cell] = measured
            self.seen.append(route[1:])

    def _driven(self, pace: Floats) -> NDArray[np.float64]:
        """What the routes by this map between the probes take in truth, s: float64 (probes,)."""
        return np.array([self._time(self._route(pace, goal, start)) for start, goal in self._probes])

    def _time(self, route: Cells) -> float:
        if len(route) < 2:
            return float("inf")
        straight = np.isin(np.abs(np.diff(route)), (1, self._grid.cols))
        lengths_m = np.where(straight, 1.0, np.sqrt(2)) * self._grid.resolution_m
        return float((lengths_m * self.true.reshape(-1)[route[1:]]).sum())

    def _route(self, pace: Floats, goal: int, start: int) -> Cells:
        costs = CostGrid(self._grid, PlannerConfig())
        costs.load(np.ascontiguousarray(pace, np.float32))
        tree = CostToGoTree(costs)
        tree.grow(goal)
        parent, (row, col) = tree.inner(tree.parent), divmod(start, self._grid.cols)
        cells = [start]
        while parent[row, col] != _NONE:
            way = int(parent[row, col])
            row, col = row + STEP_ROW[way], col + STEP_COL[way]
            cells.append(row * self._grid.cols + col)
        return np.array(cells, np.int64)


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    table = Table("driven", "error: prior", "learned", title="Learning while driving")
    for heading in ("regret: prior", "learned", "and marks", "class exact"):
        table.add_column(heading)
    for row in report["rows"]:
        table.add_row(f"{row['driven']:.2%}", *(f"{row[k]:.3f}" for k in list(row)[1:]))
    yield table
    yield (
        f"{len(report['seeds'])} seeds; in {report['right_classes_moved']} of them a class that is right was moved"
        f" by more than 5 % (most: {report['right_classes_moved_most']:.1%})."
    )
