"""A map of which patches change, and a tree that is repaired, held to the one that grows on the new map."""

from __future__ import annotations

from typing import Any

import numpy as np
from support.kernel_oracle import inner
from support.planner_strategies import random_pace

from planner_service.kernels import repair as kernels
from planner_service.tree.cost_changes import Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.array_files import Floats
from shared_map.terrain.step_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window

FACTORS = (0.3, 0.7, 1.5, 3.0, np.inf, 0.0)
"""Changes of the paces of a patch: times the factor; 0 draws them again, lethal ones too."""
NO_LIMIT = 10**9
"""Bound on cells, edges and steps of a repair."""


class Patchwork:
    """The tree is repaired or, where that gives way, grown. `mended` counts the repairs.

    climb  of a map where uphill is not downhill
    """

    def __init__(
        self, rng: np.random.Generator, pace: Floats, rules: dict[str, Any], climb: Climb | None = None
    ) -> None:
        self.rng = rng
        self.pace = pace
        self.grid = GridSpec(*pace.shape, 1.0)
        self.climb = climb
        self.config = PlannerConfig(**rules)
        self.costs = self._fresh()
        self.tree = CostToGoTree(self.costs)
        self.tree.grow(int(rng.choice(np.flatnonzero(np.isfinite(pace)))))
        self.mended = 0

    @property
    def root(self) -> int:
        return self.tree.root

    def _fresh(self) -> CostGrid:
        costs = CostGrid(self.grid, self.config, self.climb)
        costs.load(self.pace)
        return costs

    def change(self, factor: float, side: int, near_root: bool = False) -> Window:
        """Changes a square somewhere, or around the root. The root stays passable."""
        rows, cols = self.grid.rows, self.grid.cols
        row, col = int(self.rng.integers(rows)), int(self.rng.integers(cols))
        if near_root:
            row, col = (max(at - side // 2, 0) for at in self.grid.row_col(self.root))
        window = Window(row, col, min(row + side, rows), min(col + side, cols))
        patch = self.pace[window.row0 : window.row1, window.col0 : window.col1]
        if factor == 0.0:
            patch[:] = random_pace(self.rng, *patch.shape, 5.0, 0.3)
        else:
            patch *= np.float32(factor)
        if not np.isfinite(self.pace.flat[self.root]):
            self.pace.flat[self.root] = 1.0
        return window

    def mend(self, windows: list[Window]) -> None:
        if self.tree.repair(self.costs.apply(self.pace, windows)) < 0:
            self.tree.grow(self.root)
        else:
            self.mended += 1

    def repair_at_any_price(self, changes: Changes, buckets: tuple[float, int] | None = None) -> int:
        """Calls the kernel without a limit. Returns how many cells it took."""
        labels, most = (self.tree.cost, self.tree.parent, self.costs.pad(self.root)), 3 * (NO_LIMIT,)
        taken, highest = kernels.repair(*self._given(labels, changes), buckets or self.costs.buckets, most,
                                        self.costs.repair_scratch)  # fmt: skip
        self.tree.reach = max(self.tree.reach, float(highest))
        return int(taken)

    def _given(self, labels: tuple[Any, ...], changes: Changes) -> tuple[Any, ...]:
        return self.costs.padded, self.costs.climbs, labels, changes.cells, changes.before

    def check(self) -> None:
        fresh = CostToGoTree(self._fresh())
        fresh.grow(self.root)
        np.testing.assert_array_equal(inner(self.tree, self.tree.cost), inner(fresh, fresh.cost))
        np.testing.assert_array_equal(inner(self.tree, self.tree.parent), inner(fresh, fresh.parent))
        assert self.tree.reach >= fresh.cost[np.isfinite(fresh.cost)].max()

    def check_lowered(self) -> int:
        """A heuristic without parents that is lowered is the tree of the map that got cheaper. Returns how many
        cells changed."""
        changes = self.costs.apply(self.pace, [self.change(factor, 6) for factor in (0.5, 0.25, 0.9)])
        heuristic = self.tree.cost.copy()
        given = self._given((heuristic, np.empty(0, np.uint8), 0), changes)
        done, _ = kernels.repair(*given, self.costs.buckets, (0, 0, NO_LIMIT), self.costs.repair_scratch)
        self.tree.grow(self.root)
        np.testing.assert_array_equal(inner(self.tree, heuristic), inner(self.tree, self.tree.cost))
        return int(done)
