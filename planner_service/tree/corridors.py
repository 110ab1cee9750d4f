"""The corridor graph of the coarse strategies: which cells carry how much traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import corridor_growth
from planner_service.kernels.layout import NONE
from planner_service.tree.cost_grid import Changes, CostGrid

LEAST = 64
"""The ways of so many cells make a cell part of a corridor."""
SAMPLES = 8
"""Trees that vote. Half as many take half the time to find, and are a third further from the optimum."""
INNER = 256
"""At most so many cells from the target all corridors take part; beyond, only those of more traffic."""
AROUND = 8
"""Cells around a change that all take part from then on, so that ways around it are found."""
EVERYWHERE = 255
STALE_SHARE = 16
"""Corridors are found anew when one cell in so many takes part because of changes."""


@dataclass(eq=False)
class CorridorGraph:
    """Far cells that carry traffic: what a coarse growth is restricted to.

    Advice, not knowledge: whatever it says, costs and passability are read from the map as it is now. So marks
    never make it wrong; they let more cells take part.
    """

    level: NDArray[np.uint8]
    """uint8, padded: 0 if a cell carries no traffic, 1 from `LEAST` cells on, one more for each four times that;
    EVERYWHERE around changes. `learn` only raises it."""
    stale_cells: int = 0
    """How many cells take part because the map changed around them. Only grows; a new graph begins with 0."""

    def learn(self, cost_grid: CostGrid, changes: Changes) -> bool:
        """Let all cells around a change take part. False once the corridors should be found anew."""
        level = self.level.reshape(-1, cost_grid.stride)
        rows, cols = np.divmod(changes.cells, cost_grid.stride)
        for row, col in np.unique(np.stack((rows // AROUND, cols // AROUND), axis=1), axis=0).tolist():
            part = np.s_[
                max(AROUND * (row - 1), 0) : AROUND * (row + 2), max(AROUND * (col - 1), 0) : AROUND * (col + 2)
            ]
            self.stale_cells += int(np.count_nonzero(level[part] != EVERYWHERE))
            level[part] = EVERYWHERE
        return self.stale_cells * STALE_SHARE <= cost_grid.size


def find_corridors(cost_grid: CostGrid) -> CorridorGraph:
    """Let exact trees of cells all over the map vote: a cell's traffic is the most that passes it in any."""
    passable = np.flatnonzero(cost_grid.cell_cost < np.inf)
    level = np.zeros(cost_grid.size, np.uint8)
    cost = np.empty(cost_grid.size, np.float32)
    parent = np.full(cost_grid.size, NONE, np.uint8)
    children, traffic = np.empty(cost_grid.size, np.uint8), np.empty(cost_grid.size, np.uint32)
    for root in passable[np.linspace(0, passable.size - 1, SAMPLES + 2).astype(np.int64)[1:-1]].tolist():
        cost_grid.grow(root, cost, parent)
        corridor_growth.mark_levels(parent, cost_grid.padded[1], LEAST, level, children, traffic)
    return CorridorGraph(level)
