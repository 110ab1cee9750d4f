"""Interest: which squares of the grid are near some cells. Pure.

The squares are regions, the unit of subscription, or others of one size.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from swarm.grid import REGION_CELLS, GridSpec


class Interest:
    """The squares within `enter_cells` of any cell, and of the squares before those still within `leave_cells`.

    The hysteresis keeps a vehicle at a border from subscribing anew with every crossing. Squares are numbered row
    by row, as regions are. Raises ValueError if squares are left nearer than they are entered.

    leave_cells   default: twice `enter_cells`
    square_cells  side of a square; default: that of a region
    squares       the result of the last `update`
    """

    def __init__(
        self,
        grid: GridSpec,
        enter_cells: int,
        leave_cells: int | None = None,
        square_cells: int = REGION_CELLS,
    ) -> None:
        self._grid = grid
        self._side = square_cells
        self._across = -(-grid.cols // square_cells)
        self._enter = enter_cells
        self._leave = 2 * enter_cells if leave_cells is None else leave_cells
        if self._leave < self._enter:
            raise ValueError(f"left at {self._leave} cells, which is nearer than entered at {self._enter}")
        self.squares: frozenset[int] = frozenset()

    def update(self, cells: Iterable[int]) -> frozenset[int]:
        """The squares of interest around these cells (flat indices in the grid)."""
        rows, cols = np.divmod(np.fromiter(cells, np.int64), self._grid.cols)
        near = self._within(rows, cols, self._enter)
        if not self.squares <= near:
            near |= self.squares & self._within(rows, cols, self._leave)
        self.squares = frozenset(near)
        return self.squares

    def _within(self, rows: NDArray[np.int64], cols: NDArray[np.int64], reach: int) -> set[int]:
        """The squares that are at most `reach` cells away from any of these cells, by row or column."""
        grid, side = self._grid, self._side
        north = np.maximum(rows - reach, 0) // side
        south = np.minimum(rows + reach, grid.rows - 1) // side
        west = np.maximum(cols - reach, 0) // side
        east = np.minimum(cols + reach, grid.cols - 1) // side
        blocks = set(zip(north.tolist(), south.tolist(), west.tolist(), east.tolist(), strict=True))
        return {
            row * self._across + col
            for top, bottom, left, right in blocks
            for row in range(top, bottom + 1)
            for col in range(left, right + 1)
        }
