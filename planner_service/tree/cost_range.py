"""The lowest and highest cell cost of a map, kept block by block, so that a change looks at its own blocks only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.cell_costs import BLOCK, block_ranges
from planner_service.tree.changes import Cells
from shared_map.arrays import Floats


class CostRange:
    """Of cell costs, or of what cells cost to the root: float32, none of them negative.

    ranges  int32 (3, n), of each block what the properties say of all, as bits
    """

    def __init__(self, costs: Floats) -> None:
        self._ranges: NDArray[np.int32] = np.empty((3, -(-costs.size // BLOCK)), np.int32)
        block_ranges(costs.view(np.int32), np.arange(self._ranges.shape[1]), self._ranges)

    def change(self, costs: Floats, cells: Cells) -> None:
        """Become the range of the array after these cells of it have changed."""
        block_ranges(costs.view(np.int32), np.unique(cells // BLOCK), self._ranges)

    @property
    def lowest(self) -> float:
        """inf if there is no finite one."""
        return float(self._ranges[0].view(np.float32).min())

    @property
    def highest(self) -> float:
        """Of the finite ones; 0 if there is none."""
        return float(self._ranges[1].view(np.float32).max())

    @property
    def last(self) -> float:
        """The highest, inf with them; NaN is beyond that."""
        return float(self._ranges[2].max().view(np.float32))
