"""Lines over the terrain: poles, rings, trails, and what is left of the routes that vehicles have begun.
No rerun."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from launch_scripts.monitor.sinks import Strips, even, ragged
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

Cells = NDArray[np.int64]
Corners = NDArray[np.float64]
"""(n, 2): rows and cols of the places between which a line is straight; whole numbers are middles of cells."""

_CIRCLE_POINTS = 33
_STEP_ROW, _STEP_COL = np.array(STEP_ROW, np.int64), np.array(STEP_COL, np.int64)


def feet(mesh: TerrainMesh, positions: Floats) -> Floats:
    """Places on the terrain below these."""
    return mesh.place(positions[:, 0], -positions[:, 1])


def poles(mesh: TerrainMesh, tops: Floats) -> Strips:
    """A line from each point, float32 (n, 3), down to the terrain."""
    return even(np.stack([feet(mesh, tops), tops], axis=1))


def rings(mesh: TerrainMesh, centres: Floats, radii_m: Floats) -> Strips:
    """A circle on the terrain around each place."""
    angle = np.linspace(0, 2 * np.pi, _CIRCLE_POINTS, dtype=np.float32)
    east_m = centres[:, :1] + radii_m[:, None] * np.cos(angle)
    south_m = -centres[:, 1:2] + radii_m[:, None] * np.sin(angle)
    return even(mesh.place(east_m, south_m, 0.25 * mesh.scale_m))


class Trails:
    """Trails since the last drawing: one line per id, which joins the one before.

    longest_m  what jumped further leaves no trail
    """

    def __init__(self, longest_m: float) -> None:
        self._longest_m = longest_m
        self._last: dict[str, Floats] = {}
        """Where each was at the end of its trail, float32 (3,)."""

    def advance(self, ids: list[str], positions: Floats) -> tuple[Strips, NDArray[np.bool_]]:
        """Lines from the last places to these, and whose they are; none for ids which stand still, are new, or
        jumped."""
        known = zip(ids, positions, strict=True)
        last = np.array([self._last.get(id, place) for id, place in known], np.float32).reshape(-1, 3)
        moved_m = np.hypot(*(positions - last)[:, :2].T)
        self._last = dict(zip(ids, np.where(moved_m[:, None] > 0, positions, last), strict=True))
        drawn = (moved_m > 0) & (moved_m <= self._longest_m)
        return even(np.stack([last[drawn], positions[drawn]], axis=1)), drawn


def cell_at(grid: GridSpec, east_m: float, south_m: float) -> int:
    """The cell at a place, the nearest one if it is outside."""
    row = min(max(int(south_m // grid.resolution_m), 0), grid.rows - 1)
    col = min(max(int(east_m // grid.resolution_m), 0), grid.cols - 1)
    return row * grid.cols + col


def cells_along(grid: GridSpec, start: int, directions: bytes) -> Cells | None:
    """The cells of a route, as `swarm.grid.walk`; None where that raises."""
    codes = np.frombuffer(directions, np.uint8)
    if not 0 <= start < grid.cells or int(codes.max(initial=0)) >= len(STEP_ROW):
        return None
    rows = start // grid.cols + np.cumsum(_STEP_ROW[codes])
    cols = start % grid.cols + np.cumsum(_STEP_COL[codes])
    if not ((rows >= 0) & (rows < grid.rows) & (cols >= 0) & (cols < grid.cols)).all():
        return None
    return np.concatenate([np.array([start], np.int64), rows * grid.cols + cols])


@dataclass(frozen=True, slots=True, eq=False)
class RouteNow:
    """A route that a vehicle has begun.

    gap       its cost over its proven lower bound; None if nothing is proven
    begun_ns  when that was heard
    turns     of a pulled route the indices of the cells in which it turns, its first and last included; else None
    """

    target: str
    cells: Cells
    gap: float | None = None
    begun_ns: int = 0
    turns: Cells | None = None

    def ahead_of(self, cell: int) -> Cells:
        """The route from a cell on; the whole route if the cell is not on it."""
        found = np.flatnonzero(self.cells == cell)
        return self.cells[found[-1] :] if len(found) else self.cells

    def corners_ahead(self, grid: GridSpec, east_m: float, south_m: float) -> Corners:
        """Of a pulled route: from where the vehicle is to where it turns, and on to the end; the whole route if
        that place is not on it."""
        assert self.turns is not None
        corners = self.cells[self.turns]
        found = np.flatnonzero(self.cells == cell_at(grid, east_m, south_m))
        if not len(found):
            return np.stack(np.divmod(corners, grid.cols), axis=1).astype(np.float64)
        ahead = corners[self.turns > found[-1]]
        place = south_m / grid.resolution_m - 0.5, east_m / grid.resolution_m - 0.5
        return np.vstack([place, np.stack(np.divmod(ahead, grid.cols), axis=1)])


class RouteLines:
    """Routes to one target as lines in which no part of the ground is drawn twice.

    Routes to one target join, as the branches of its tree do: a thousand of them have few cells more than the tree.
    Pulled ones meet where they turn.
    """

    def __init__(self, mesh: TerrainMesh, stride: int) -> None:
        self._mesh = mesh
        self._stride = stride
        self._drawn = np.zeros(mesh.grid.cells, np.bool_)

    def lines(self, routes: Iterable[Cells], pulled: Iterable[Corners] = ()) -> Strips:
        """Each route up to where it meets one that is drawn already, the longest first; of pulled ones each segment
        once."""
        pieces = list(self._pieces(sorted(routes, key=len, reverse=True)))
        for piece in pieces:
            self._drawn[piece] = False
        thin = [thinned(piece, self._stride) for piece in pieces]
        cols = self._mesh.grid.cols
        along = [np.stack(np.divmod(piece, cols), axis=1).astype(np.float64) for piece in thin]
        along += [filled(piece, self._stride) for piece in _segments_once(pulled)]
        rows_cols = np.concatenate(along) if along else np.empty((0, 2))
        south_m, east_m = ((rows_cols + 0.5) * self._mesh.grid.resolution_m).astype(np.float32).T
        return ragged(self._mesh.place(east_m, south_m, 0.2 * self._mesh.scale_m), list(map(len, along)))

    def _pieces(self, routes: Iterable[Cells]) -> Iterator[Cells]:
        drawn = self._drawn
        for cells in routes:
            met = np.flatnonzero(drawn[cells])
            piece = cells[: met[0] + 1] if len(met) else cells
            if len(piece) > 1:
                drawn[piece] = True
                yield piece


def thinned(cells: Cells, stride: int) -> Cells:
    """Every so many cells of a line, with both of its ends."""
    kept = cells[::stride]
    return kept if (len(cells) - 1) % stride == 0 else np.append(kept, cells[-1])


def _segments_once(routes: Iterable[Corners]) -> Iterator[Corners]:
    """Parts of routes of which no segment is in another one."""
    drawn: set[tuple[float, ...]] = set()
    for corners in routes:
        known = []
        for start, end in pairwise(corners.tolist()):
            segment = (*start, *end)
            known.append(segment in drawn)
            drawn.add(segment)
        borders = np.flatnonzero(np.diff(known, prepend=True, append=True))
        for begin, end in zip(borders[::2].tolist(), borders[1::2].tolist(), strict=True):
            yield corners[begin : end + 1]


def filled(corners: Corners, stride: int) -> Corners:
    """A line with a point for so many cells at least, so that it lies on the ground; its corners are among them."""
    parts = [corners[:1]]
    for start, end in pairwise(corners):
        many = max(math.ceil(np.abs(end - start).max() / stride), 1)
        parts.append(start + (end - start) * (np.arange(1, many + 1) / many)[:, None])
    return np.concatenate(parts)
