"""The coarse strategies' skeleton: which cells carry how much traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import corridor_growth
from planner_service.kernels.layout import NONE
from planner_service.tree.cost_grid import Changes, Ground

LEAST = 64
"""The ways of so many cells make a cell part of the skeleton."""
SAMPLES = 8
"""Trees that vote. Half as many take half the time to find, and are a third further from the optimum."""
INNER = 256
"""The innermost ring, where all of the skeleton takes part, reaches at most so many cells from the target."""
AROUND = 8
"""Cells around a change that all take part from then on, so that ways around it are found."""
EVERYWHERE = 255
WORN_SHARE = 16
"""A skeleton is found anew when one cell in so many takes part because of changes."""


@dataclass(eq=False)
class Skeleton:
    """Advice, not knowledge: whatever it says, costs and passability are read from the map as it is now. So marks
    never make it wrong, and only wear it.

    level  uint8, padded: 0 if a cell carries no traffic, 1 from `LEAST` cells on, one more for each four times that
    worn   cells that take part because the map changed around them
    """

    level: NDArray[np.uint8]
    worn: int = 0

    def learn(self, ground: Ground, changes: Changes) -> bool:
        """Let all cells around a change take part. False once the skeleton should be found anew."""
        level = self.level.reshape(-1, ground.stride)
        rows, cols = np.divmod(changes.cells, ground.stride)
        for row, col in np.unique(np.stack((rows // AROUND, cols // AROUND), axis=1), axis=0).tolist():
            part = np.s_[
                max(AROUND * (row - 1), 0) : AROUND * (row + 2), max(AROUND * (col - 1), 0) : AROUND * (col + 2)
            ]
            self.worn += int(np.count_nonzero(level[part] != EVERYWHERE))
            level[part] = EVERYWHERE
        return self.worn * WORN_SHARE <= ground.size


def find_skeleton(ground: Ground) -> Skeleton:
    """Let exact trees of cells all over the ground vote: a cell's traffic is the most that passes it in any."""
    passable = np.flatnonzero(ground.weight < np.inf)
    level = np.zeros(ground.size, np.uint8)
    cost = np.empty(ground.size, np.float32)
    parent = np.full(ground.size, NONE, np.uint8)
    for root in passable[np.linspace(0, passable.size - 1, SAMPLES + 2).astype(np.int64)[1:-1]].tolist():
        ground.grow(root, cost, parent)
        corridor_growth.mark_levels(parent, ground.stride, LEAST, level)
    return Skeleton(level)
