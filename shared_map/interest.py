"""Which regions concern those who stand at some cells: those around them, entered early and left late. Pure."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from swarm.grid import REGION_TILES, TILE_CELLS, GridSpec

_REGION_CELLS = REGION_TILES * TILE_CELLS


class Interest:
    """The regions within `enter_cells` of anybody, and those of before that are still within `leave_cells`.

    Whoever drives to and fro across the border of a region so does not come and go with every crossing.
    """

    def __init__(self, grid: GridSpec, enter_cells: int, leave_cells: int | None = None) -> None:
        self._grid = grid
        self._enter = enter_cells
        self._leave = 2 * enter_cells if leave_cells is None else leave_cells
        if self._leave < self._enter:
            raise ValueError(f"left at {self._leave} cells, which is nearer than entered at {self._enter}")
        self.regions: frozenset[int] = frozenset()

    def update(self, cells: Iterable[int]) -> frozenset[int]:
        """The regions that concern whoever stands at these cells (flat indices in the grid)."""
        rows, cols = np.divmod(np.fromiter(cells, np.int64), self._grid.cols)
        near = _regions_within(self._grid, rows, cols, self._enter)
        if not self.regions <= near:
            near |= self.regions & _regions_within(self._grid, rows, cols, self._leave)
        self.regions = frozenset(near)
        return self.regions


def _regions_within(grid: GridSpec, rows: NDArray[np.int64], cols: NDArray[np.int64], reach: int) -> set[int]:
    """The regions that the squares of `reach` cells to every side touch."""
    north = np.maximum(rows - reach, 0) // _REGION_CELLS
    south = np.minimum(rows + reach, grid.rows - 1) // _REGION_CELLS
    west = np.maximum(cols - reach, 0) // _REGION_CELLS
    east = np.minimum(cols + reach, grid.cols - 1) // _REGION_CELLS
    blocks = set(zip(north.tolist(), south.tolist(), west.tolist(), east.tolist(), strict=True))
    return {
        row * grid.region_cols + col
        for top, bottom, left, right in blocks
        for row in range(top, bottom + 1)
        for col in range(left, right + 1)
    }
