"""The routes that vehicles have begun, and what is left of them, as lines. No rerun, no bus, no clock."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import TerrainMesh
from launch_scripts.monitor.movers.strips import Strips, ragged
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

Cells = NDArray[np.int64]

_STEP_ROW, _STEP_COL = np.array(STEP_ROW, np.int64), np.array(STEP_COL, np.int64)


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
    """

    target: str
    cells: Cells
    gap: float | None = None
    begun_ns: int = 0

    def ahead_of(self, cell: int) -> Cells:
        """The route from a cell on; the whole route if the cell is not on it."""
        found = np.flatnonzero(self.cells == cell)
        return self.cells[found[-1] :] if len(found) else self.cells


class RouteLines:
    """Routes to one target as lines in which no part of the ground is drawn twice.

    Routes to one target join, as the branches of its tree do: a thousand of them have few cells more than the tree.
    """

    def __init__(self, mesh: TerrainMesh, stride: int) -> None:
        self._mesh = mesh
        self._stride = stride
        self._drawn = np.zeros(mesh.grid.cells, np.bool_)

    def lines(self, routes: Iterable[Cells]) -> Strips:
        """Each route up to where it meets one that is drawn already, the longest first."""
        pieces = list(self._pieces(sorted(routes, key=len, reverse=True)))
        for piece in pieces:
            self._drawn[piece] = False
        thin = [thinned(piece, self._stride) for piece in pieces]
        cells = np.concatenate(thin) if thin else np.empty(0, np.int64)
        return ragged(self._mesh.place_cells(cells, 0.2 * self._mesh.scale_m), list(map(len, thin)))

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
