"""The map in blocks as wide as a sensor looks: what a belief about a target is held over. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Floats
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

MOST_BLOCKS = 1 << 14
"""Of a map with more of them blocks are wider: a step of a belief takes a millisecond for so many."""
_WHOLE = 1.4
"""A block at most so many times as wide as the range of a sensor is seen whole from its middle, which is seen from
every cell of it."""
_MOST_SAMPLES = 16


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Square blocks of cells, row by row from the north-west; those at the south and east border may be smaller.

    side_cells   cells of a side
    side_m       metres of it
    share        float32 (rows, cols), passable share of the cells; 0 where all is lethal
    pace_s_per_m float32 (rows, cols), mean pace of as many of its quickest cells as cross it; 1 where all is
                 lethal
    """

    grid: GridSpec
    side_cells: int
    side_m: float
    share: Floats
    pace_s_per_m: Floats

    @property
    def shape(self) -> tuple[int, int]:
        rows, cols = self.share.shape
        return rows, cols

    @property
    def open(self) -> Bools:
        """bool (rows, cols): the blocks with a passable cell."""
        opened: Bools = self.share > 0.0
        return opened

    @property
    def middles(self) -> NDArray[np.int64]:
        """int64 (rows * cols,): the cell of the grid that is nearest to the middle of each block."""
        rows, cols = (
            np.minimum(np.arange(many) * self.side_cells + self.side_cells // 2, last)
            for many, last in zip(self.shape, (self.grid.rows - 1, self.grid.cols - 1), strict=True)
        )
        middles: NDArray[np.int64] = (rows[:, None] * self.grid.cols + cols).reshape(-1)
        return middles

    def of_cell(self, cell: int) -> tuple[int, int]:
        """(row, col) of the block of a cell of the grid."""
        row, col = divmod(cell, self.grid.cols)
        return row // self.side_cells, col // self.side_cells

    def lowest(self, values: Floats) -> Floats:
        """float32 (rows, cols): the lowest of each block's cells, of values (grid rows, grid cols)."""
        rows, cols = (np.arange(many) * self.side_cells for many in self.shape)
        lowest: Floats = np.minimum.reduceat(np.minimum.reduceat(values, rows, axis=0), cols, axis=1)
        return lowest

    def neighbours(self, values: Floats, direction: int, outside: float) -> Floats:
        """float32 (rows, cols): for each block the value of its neighbour in one of the eight directions."""
        rows, cols = self.shape
        framed = np.full((rows + 2, cols + 2), outside, np.float32)
        framed[1:-1, 1:-1] = values
        row, col = 1 + STEP_ROW[direction], 1 + STEP_COL[direction]
        return framed[row : row + rows, col : col + cols]

    def cells_of(self, block: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns of the grid."""
        side = self.side_cells
        return tuple(slice(at * side, (at + 1) * side) for at in block)  # type: ignore[return-value]

    def seen_whole(self, range_m: float) -> bool:
        """Whether a sensor in the middle of a block sees all of it."""
        return self.side_cells == 1 or self.side_m <= _WHOLE * range_m

    def seen_from(self, east_m: float, south_m: float, range_m: float) -> tuple[slice, slice, Floats] | None:
        """Rows and columns of the blocks that a sensor sees, and which share of each, float32. None where it sees
        none, and from a place that is no number.

        A block that is seen whole from its middle counts as seen if its middle is. Of a wider one what counts is
        the share that is in range.
        """
        rows, cols = self.shape
        at_row, at_col, reach = south_m / self.side_m, east_m / self.side_m, range_m / self.side_m
        outside = not (-reach <= at_row <= rows + reach and -reach <= at_col <= cols + reach)
        if outside or not math.isfinite(reach):
            return None
        row0, row1 = max(math.floor(at_row - reach), 0), min(math.floor(at_row + reach) + 1, rows)
        col0, col1 = max(math.floor(at_col - reach), 0), min(math.floor(at_col + reach) + 1, cols)
        if row0 >= row1 or col0 >= col1:
            return None
        many = 1 if self.seen_whole(range_m) else min(math.ceil(2.0 / reach), _MOST_SAMPLES)
        down = (np.arange(row0 * many, row1 * many) + 0.5) / many - at_row
        right = (np.arange(col0 * many, col1 * many) + 0.5) / many - at_col
        inside = down[:, None] ** 2 + right[None, :] ** 2 <= reach**2
        share = inside.reshape(row1 - row0, many, col1 - col0, many).mean(axis=(1, 3), dtype=np.float32)
        own = math.floor(at_row) - row0, math.floor(at_col) - col0
        if 0 <= own[0] < row1 - row0 and 0 <= own[1] < col1 - col0:
            least = 1.0 if self.side_cells == 1 else min(reach**2, 1.0)
            share[own] = max(float(share[own]), least)
        return slice(row0, row1), slice(col0, col1), share


def blocks_of(grid: GridSpec, pace_s_per_m: Floats, range_m: float) -> Blocks:
    """The blocks of a map.

    Parameters
    ----------
    pace_s_per_m : (rows, cols) float32, s/m; inf is lethal
    range_m : how far a sensor sees a target; a block is as wide, if that makes no more than `MOST_BLOCKS`
    """
    widest = max(grid.rows, grid.cols)
    side = min(max(round(range_m / grid.resolution_m), 1), widest)
    while -(-grid.rows // side) * -(-grid.cols // side) > MOST_BLOCKS:
        side += 1
    rows, cols = -(-grid.rows // side), -(-grid.cols // side)
    padded = np.full((rows * side, cols * side), np.inf, np.float32)
    padded[: grid.rows, : grid.cols] = pace_s_per_m
    cells = padded.reshape(rows, side, cols, side).swapaxes(1, 2).reshape(rows, cols, side * side)
    many = np.isfinite(cells).sum(axis=2, dtype=np.int64)
    # A target crosses a block along its cheapest lane, as on a road: a row of cells, not all of them.
    lane = np.partition(cells, side - 1, axis=2)[:, :, :side]
    in_lane = np.isfinite(lane)
    means = np.where(in_lane, lane, 0).sum(axis=2, dtype=np.float64) / np.maximum(in_lane.sum(axis=2), 1)
    return Blocks(
        grid=grid,
        side_cells=side,
        side_m=side * grid.resolution_m,
        share=(many / (side * side)).astype(np.float32),
        pace_s_per_m=np.where(many > 0, means, 1.0).astype(np.float32),
    )
