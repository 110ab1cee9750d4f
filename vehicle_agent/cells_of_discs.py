"""Cells touched by a disc that moves along a straight line. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm.grid import GridSpec, Window

_MOST = 1 << 31
"""Cells from the grid: what lies further is as far."""
_LEAST = 1e-12
"""Cells to one side: less is straight."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """All points within `radius_m` of a line from (x_m, y_m), of this length to the east and to the north."""

    x_m: float
    y_m: float
    east_m: float
    north_m: float
    radius_m: float

    def window(self, grid: GridSpec) -> Window:
        """The cells of the box around it, clipped to the grid; empty if it lies outside."""
        u0, v0, u1, v1, radius = self._in_cells(grid)
        row0, row1 = _clipped(min(v0, v1) - radius, max(v0, v1) + radius, grid.rows)
        col0, col1 = _clipped(min(u0, u1) - radius, max(u0, u1) + radius, grid.cols)
        return Window(row0, col0, row1, col1)

    def cells(self, grid: GridSpec) -> list[int]:
        """The cells whose square, border included, it touches."""
        window = self.window(grid)
        if window.empty:
            return []
        *line, radius = self._in_cells(grid)
        cols = np.arange(window.col0, window.col1, dtype=np.float64)[None, :]
        rows = np.arange(window.row0, window.row1, dtype=np.float64)[:, None]
        near = _from_squares(cols, rows, line)
        found_rows, found_cols = np.nonzero(near <= radius + 1e-9)
        flat: list[int] = ((found_rows + window.row0) * grid.cols + found_cols + window.col0).tolist()
        return flat

    def depth(self, grid: GridSpec, cell: int) -> float:
        """Returns the depth of a cell's middle in it, widened by half a cell's diagonal: 0 outside, 1 on its
        line."""
        u0, v0, u1, v1, radius = self._in_cells(grid)
        row, col = divmod(cell, grid.cols)
        u, v = col + 0.5, row + 0.5
        du, dv = u1 - u0, v1 - v0
        along = du * du + dv * dv
        t = 0.0 if along == 0.0 else min(max(((u - u0) * du + (v - v0) * dv) / along, 0.0), 1.0)
        wide = radius + math.sqrt(0.5)
        return max(1.0 - math.hypot(u - u0 - t * du, v - v0 - t * dv) / wide, 0.0)

    def _in_cells(self, grid: GridSpec) -> tuple[float, float, float, float, float]:
        """(column, row) of both ends of the line, and the radius, in cells."""
        side = grid.resolution_m
        u, v = (self.x_m - grid.west_m) / side, (grid.north_m - self.y_m) / side
        return u, v, u + self.east_m / side, v - self.north_m / side, self.radius_m / side


def _clipped(low: float, high: float, side: int) -> tuple[int, int]:
    """The first cell that an interval touches, and the one after the last."""
    # A point on a border touches the cells on both sides of it.
    first = max(math.ceil(min(max(low, -1.0), _MOST)) - 1, 0)
    last = min(math.floor(max(min(high, side + 1.0), -1.0)) + 1, side)
    return first, max(last, first if first < side else last)


def _from_squares(
    cols: NDArray[np.float64], rows: NDArray[np.float64], line: Sequence[float]
) -> NDArray[np.float64]:
    """Distances of a line, from one (u, v) to another, from squares of side 1 whose north-west corners are these.

    Along a line the distance from a square is convex. It is least at an end, where the line passes a border of the
    square's row or column, or where it is nearest to a corner; so the least of all these is the distance.
    """
    u0, v0, u1, v1 = line
    du, dv = u1 - u0, v1 - v0
    shares: list[NDArray[np.float64]] = [np.zeros(1), np.ones(1)]
    along = du * du + dv * dv
    if along > 0.0:  # the square of a tiny length is 0
        shares += [((cols + e - u0) * du + (rows + s - v0) * dv) / along for e in (0, 1) for s in (0, 1)]
    for low, start, step in ((cols, u0, du), (rows, v0, dv)):
        if abs(step) > _LEAST:
            shares += [(low - start) / step, (low + 1.0 - start) / step]
    nearest = np.full((rows.size, cols.size), np.inf)
    for share in shares:
        t = share.clip(0.0, 1.0)
        u, v = u0 + t * du, v0 + t * dv
        east, south = np.maximum(cols - u, u - cols - 1.0), np.maximum(rows - v, v - rows - 1.0)
        np.minimum(nearest, np.hypot(east.clip(0.0), south.clip(0.0)), out=nearest)
    return nearest
