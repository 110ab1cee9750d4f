"""Belief about the position of a target that was not seen for a while. Pure.

A grid of probabilities, moved by what the target may have done and cut by what vehicles have looked at, is the
standard of the field (Bourgault, Furukawa, Durrant-Whyte 2003; Stone, *Theory of Optimal Search*). Here it is held
for each of eight headings: one that only spreads is too narrow for a target which drives straight on.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Floats
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

MOST_BLOCKS = 1 << 14
"""On a map with more blocks they are wider: a step of a belief takes a millisecond for this number."""
_WHOLE = 1.4
"""A block at most this multiple as wide as the range of a sensor is seen whole from its middle, which is seen from
every cell of it."""
_MOST_SAMPLES = 16
"""A side. A range that is smaller than an eighth of a block sees too little of it to matter."""


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
        """The blocks with a passable cell, bool (rows, cols)."""
        opened: Bools = self.share > 0.0
        return opened

    @property
    def middles(self) -> NDArray[np.int64]:
        """The cell of the grid that is nearest to the middle of each block, int64 (rows * cols,)."""
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
        """True if a sensor in the middle of a block sees all of it."""
        return self.side_cells == 1 or self.side_m <= _WHOLE * range_m

    def seen_from(self, east_m: float, south_m: float, range_m: float) -> tuple[slice, slice, Floats] | None:
        """Rows and columns of the blocks that a sensor sees, and which share of each, float32. None where it sees
        none, and from a place that is no number.

        A block that is seen whole from its middle counts as seen if its middle is. For a wider one the share in
        range counts.
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
    range_m : m, how far a sensor sees a target; a block is as wide, or wider if there were over `MOST_BLOCKS`
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


TURNS_PER_BLOCK = 0.067
"""Share of targets that take another heading while they cross a block."""
_MOST_MOVED = 0.8
"""Share of a block's mass that may leave it in one step: more of it would need blocks further on."""
_GONE = 1e-9
"""Remaining mass at which the target was nowhere in the believed area."""
_MOST_STEPS = 256
"""Limit of one update, some 0.3 s: after a long silence the belief is spread so widely that larger steps change
little."""


class Belief:
    """Probability of each block and heading, float32 (8, rows, cols); the sum is 1.

    Parameters
    ----------
    blocks : the map
    slowness : how many times as long as a vehicle the target takes for a cell; inf for one that stands still
    at : block, (row, col), where it was seen last; None if it never was, or may be anywhere
    arrival_s : (rows, cols) float, s after that when it can be in each block at the earliest; None for no limit
    elapsed_s : since it was seen there
    """

    def __init__(
        self,
        blocks: Blocks,
        slowness: float,
        at: tuple[int, int] | None = None,
        arrival_s: NDArray[np.floating] | None = None,
        elapsed_s: float = 0.0,
    ) -> None:
        if not blocks.open.any():
            raise ValueError("every block is lethal: no target can be anywhere")
        self.blocks = blocks
        self.elapsed_s = 0.0
        self._slowness = slowness
        self._arrival_s = arrival_s
        self._crossing_s = blocks.pace_s_per_m * np.float32(blocks.side_m) * np.float32(min(slowness, 1e30))
        quick, usual = np.percentile(self._crossing_s[blocks.open], (1, 50)).tolist()
        self.step_s: float = _MOST_MOVED * max(quick, 1e-9)
        """Longest step of `predict` that is a single one."""
        self._turns_per_s = TURNS_PER_BLOCK / max(usual, 1e-9)
        opened = blocks.open.astype(np.float32)
        self._goes_on = np.stack([blocks.neighbours(opened, direction, 0.0) for direction in range(8)])
        self.mass: Floats = np.zeros((8, *blocks.shape), np.float32)
        if at is None or not blocks.open[at]:
            self.elapsed_s = elapsed_s
            self._renew(np.zeros(blocks.shape, np.bool_))
        else:
            self.mass[(slice(None), *at)] = 0.125
            self.predict(elapsed_s)

    @property
    def total(self) -> Floats:
        """float32 (rows, cols): probability of each block."""
        total: Floats = self.mass.sum(axis=0)
        return total

    @property
    def reachable(self) -> Bools:
        """Returns bool (rows, cols): where the target can be by now."""
        if self._arrival_s is None:
            return self.blocks.open
        reached: Bools = self.blocks.open & (self._arrival_s <= self.elapsed_s)
        return reached

    def predict(self, seconds: float) -> None:
        """Moves the belief on by some seconds of terrain time."""
        steps = min(max(math.ceil(seconds / self.step_s), 1), _MOST_STEPS)
        for _ in range(steps):
            self._drive(seconds / steps)
        self.elapsed_s += seconds
        if self._arrival_s is not None:
            self.mass *= self.reachable
        self._normalise(np.zeros(self.blocks.shape, np.bool_))

    def _drive(self, seconds: float) -> None:
        mass, blocks = self.mass, self.blocks
        rows, cols = blocks.shape
        leaving = np.minimum(np.float32(seconds) / self._crossing_s, np.float32(_MOST_MOVED))
        stuck = np.zeros(blocks.shape, np.float32)
        driven = np.empty_like(mass)
        for heading, (row, col) in enumerate(zip(STEP_ROW, STEP_COL, strict=True)):
            away = mass[heading] * leaving
            if heading % 2:
                away *= np.float32(math.sqrt(0.5))
            moved = away * self._goes_on[heading]
            np.subtract(mass[heading], away, out=driven[heading])
            away -= moved
            stuck += away
            driven[heading, max(row, 0) : rows + min(row, 0), max(col, 0) : cols + min(col, 0)] += moved[
                max(-row, 0) : rows + min(-row, 0), max(-col, 0) : cols + min(-col, 0)
            ]
        # Blocked mass turns, and so does a share of all.
        turning = np.float32(min(seconds * self._turns_per_s, 1.0))
        stuck += turning * driven.sum(axis=0)
        driven *= np.float32(1.0) - turning
        driven += stuck * np.float32(0.125)
        self.mass = driven

    def seen(self, places_m: Iterable[tuple[float, float]], range_m: float) -> None:
        """Removes the belief from all that vehicles see, because the target is not there.

        places_m  (east, south) from the grid's corner; one that is no number or outside sees nothing
        range_m   m, range of their sensors
        """
        left = np.ones(self.blocks.shape, np.float32)
        for east_m, south_m in places_m:
            found = self.blocks.seen_from(east_m, south_m, range_m)
            if found is not None:
                rows, cols, share = found
                left[rows, cols] *= np.float32(1.0) - share
        looked = left < 1.0
        if looked.any():
            self.mass *= left
            self._normalise(looked)

    def _normalise(self, looked: Bools) -> None:
        mass = float(self.mass.sum(dtype=np.float64))
        if mass > _GONE:
            self.mass *= np.float32(1.0 / mass)
        else:
            self._renew(looked)

    def _renew(self, looked: Bools) -> None:
        """Resets the belief to uniform over all blocks that the target may have reached, except those in view now.
        If there is no such block the last sighting was wrong, and it may be anywhere."""
        for where in (self.reachable & ~looked, self.blocks.open & ~looked, self.blocks.open):
            weights = np.where(where, self.blocks.share, np.float32(0.0))
            total = float(weights.sum(dtype=np.float64))
            if total > 0.0:
                if not (where <= self.reachable).all():
                    self._arrival_s = None
                self.mass[:] = weights * np.float32(0.125 / total)
                return

    def near(self, block: tuple[int, int]) -> float:
        """Probability of a block and the eight around it."""
        row, col = block
        return float(self.mass[:, max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2].sum(dtype=np.float64))
