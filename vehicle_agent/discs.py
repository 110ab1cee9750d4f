"""Which cells a disc touches that is moved along a straight line. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm.grid import GridSpec, Window

_MOST = 1 << 31
_LEAST = 1e-12
"""Cells to one side: less is straight."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """All places within `radius_m` of a line from (x_m, y_m), so many metres to the east and to the north."""

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
        u0, v0, u1, v1, radius = self._in_cells(grid)
        cols = np.arange(window.col0, window.col1, dtype=np.float64)[None, :]
        rows = np.arange(window.row0, window.row1, dtype=np.float64)[:, None]
        near = np.minimum(_to_square(cols, rows, u0, v0), _to_square(cols, rows, u1, v1))
        if (u1 - u0) ** 2 + (v1 - v0) ** 2 > 0.0:  # the square of a tiny length is 0
            corners = _to_line(
                np.arange(window.col0, window.col1 + 1.0)[None, :],
                np.arange(window.row0, window.row1 + 1.0)[:, None],
                (u0, v0, u1, v1),
            )
            corners = np.minimum(corners[1:], corners[:-1])
            near = np.minimum(near, np.minimum(corners[:, 1:], corners[:, :-1]))
            near[_crossed(cols, rows, (u0, v0, u1, v1))] = 0.0
        found_rows, found_cols = np.nonzero(near <= radius + 1e-9)
        flat: list[int] = ((found_rows + window.row0) * grid.cols + found_cols + window.col0).tolist()
        return flat

    def depth(self, grid: GridSpec, cell: int) -> float:
        """How deep the middle of a cell lies in it, widened by half a cell's diagonal: 0 outside, 1 on its line."""
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


def _to_square(cols: NDArray[np.float64], rows: NDArray[np.float64], u: float, v: float) -> NDArray[np.float64]:
    """Distance of a point from squares of side 1."""
    du = np.maximum(np.maximum(cols - u, u - cols - 1.0), 0.0)
    dv = np.maximum(np.maximum(rows - v, v - rows - 1.0), 0.0)
    distance: NDArray[np.float64] = np.hypot(du, dv)
    return distance


Line = tuple[float, float, float, float]


def _to_line(u: NDArray[np.float64], v: NDArray[np.float64], line: Line) -> NDArray[np.float64]:
    """Distance of points from a line between two others."""
    u0, v0, u1, v1 = line
    du, dv = u1 - u0, v1 - v0
    t = np.clip(((u - u0) * du + (v - v0) * dv) / (du * du + dv * dv), 0.0, 1.0)
    distance: NDArray[np.float64] = np.hypot(u - u0 - t * du, v - v0 - t * dv)
    return distance


def _crossed(cols: NDArray[np.float64], rows: NDArray[np.float64], line: Line) -> NDArray[np.bool_]:
    """Which squares of side 1 a line enters."""
    u0, v0, u1, v1 = line
    enter = np.zeros(np.broadcast_shapes(cols.shape, rows.shape))
    leave = np.ones_like(enter)
    for low, start, step in ((cols, u0, u1 - u0), (rows, v0, v1 - v0)):
        if abs(step) < _LEAST:
            missed = (start < low) | (start > low + 1.0)
            enter = np.where(missed, 2.0, enter)
        else:
            one, other = (low - start) / step, (low + 1.0 - start) / step
            enter = np.maximum(enter, np.minimum(one, other))
            leave = np.minimum(leave, np.maximum(one, other))
    crossed: NDArray[np.bool_] = enter <= leave
    return crossed
