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


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Square blocks of cells, row by row from the north-west; those at the south and east border may be smaller.

    side_cells   cells of a side
    side_m       metres of it
    share        float32 (rows, cols), passable share of the cells; 0 where all is lethal
    pace_s_per_m float32 (rows, cols), mean pace of as many of its quickest cells as cross it; 1 where all is
                 lethal
    places       int64 (rows, cols), the passable cell nearest to the middle of the block; -1 where there is none
    steps        float32 (8, rows, cols), 1 where the neighbour in that direction has a passable cell, else 0
    """

    grid: GridSpec
    side_cells: int
    side_m: float
    share: Floats
    pace_s_per_m: Floats
    places: NDArray[np.int64]
    steps: Floats

    @property
    def shape(self) -> tuple[int, int]:
        rows, cols = self.share.shape
        return rows, cols

    @property
    def open(self) -> Bools:
        """bool (rows, cols): the blocks with a passable cell."""
        opened: Bools = self.places >= 0
        return opened

    def of_cell(self, cell: int) -> tuple[int, int]:
        """(row, col) of the block of a cell of the grid."""
        row, col = divmod(cell, self.grid.cols)
        return row // self.side_cells, col // self.side_cells

    def within(self, east_m: float, south_m: float, radius_m: float) -> tuple[slice, slice, Bools] | None:
        """The blocks whose middle lies within a radius of a place: rows, cols, and which of these (bool). None for
        a place that is no number or too far outside of the map to see any of it."""
        if not (math.isfinite(east_m) and math.isfinite(south_m)):
            return None
        rows, cols = self.shape
        side_m, reach = self.side_m, radius_m / self.side_m
        at_row, at_col = south_m / side_m - 0.5, east_m / side_m - 0.5
        if not (-reach <= at_row <= rows - 1 + reach and -reach <= at_col <= cols - 1 + reach):
            return None
        row0, row1 = max(math.ceil(at_row - reach), 0), min(math.floor(at_row + reach), rows - 1) + 1
        col0, col1 = max(math.ceil(at_col - reach), 0), min(math.floor(at_col + reach), cols - 1) + 1
        if row0 >= row1 or col0 >= col1:
            return None
        down = np.arange(row0, row1)[:, None] - at_row
        right = np.arange(col0, col1)[None, :] - at_col
        return slice(row0, row1), slice(col0, col1), down**2 + right**2 <= reach**2


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
    passable = np.isfinite(cells)
    many = passable.sum(axis=2, dtype=np.int64)
    # A target crosses a block along its cheapest lane, as on a road: a row of cells, not all of them.
    lane = np.sort(cells, axis=2)[:, :, :side]
    in_lane = np.isfinite(lane)
    means = np.where(in_lane, lane, 0).sum(axis=2, dtype=np.float64) / np.maximum(in_lane.sum(axis=2), 1)
    down, right = np.divmod(np.arange(side * side), side)
    middle = (side - 1) / 2
    off = (down - middle) ** 2 + (right - middle) ** 2
    nearest = np.where(passable, off.astype(np.float32), np.inf).argmin(axis=2)
    block_rows, block_cols = np.mgrid[0:rows, 0:cols]
    places = (block_rows * side + nearest // side) * grid.cols + block_cols * side + nearest % side
    opened = many > 0
    framed = np.zeros((rows + 2, cols + 2), np.float32)
    framed[1:-1, 1:-1] = opened
    ways = zip(STEP_ROW, STEP_COL, strict=True)
    return Blocks(
        grid=grid,
        side_cells=side,
        side_m=side * grid.resolution_m,
        share=(many / (side * side)).astype(np.float32),
        pace_s_per_m=np.where(opened, means, 1.0).astype(np.float32),
        places=np.where(opened, places, -1).astype(np.int64),
        steps=np.stack([framed[1 + r : 1 + r + rows, 1 + c : 1 + c + cols] for r, c in ways]),
    )
