"""Lines over the terrain: poles, rings, trails, and what is left of the routes that vehicles have begun.
No rerun."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from launch_scripts.monitor.sinks import Strips, even, ragged
from swarm.grid import GridSpec, walk
from swarm.wire.messages.vehicles import Followed

Cells = NDArray[np.int64]

_CIRCLE_POINTS = 33


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


def cells_at(grid: GridSpec, east_m: Floats, south_m: Floats) -> Cells:
    """The cells at places, the nearest ones if they are outside."""
    rows, cols = np.floor_divide((south_m, east_m), grid.resolution_m).astype(np.int64)
    cells: Cells = np.clip(rows, 0, grid.rows - 1) * grid.cols + np.clip(cols, 0, grid.cols - 1)
    return cells


@dataclass(frozen=True, slots=True, eq=False)
class RouteNow:
    """A route that a vehicle has begun, or what is left of it.

    cells     int64 (n,)
    places    float64 (n, 2)  rows and columns that it leads over, whole numbers in the middles of cells; those of a
              pulled route lie on the straight lines between the cells in which it turns
    gap       its cost over its proven lower bound; None if nothing is proven
    begun_ns  when that was heard
    """

    target: str
    cells: Cells
    places: NDArray[np.float64]
    gap: float | None = None
    begun_ns: int = 0

    @classmethod
    def of(cls, followed: Followed, grid: GridSpec, now_ns: int) -> RouteNow:
        """The route that a vehicle told. Raises ValueError or OutsideGridError where it leaves the grid."""
        cells = np.array(walk(grid, followed.start, followed.directions), np.int64)
        places = np.stack(np.divmod(cells, grid.cols), axis=1).astype(np.float64)
        turns = np.cumsum([0, *np.frombuffer(followed.legs, "<u4")])
        if turns[-1] == len(cells) - 1:
            at = np.arange(len(cells))
            places = np.stack([np.interp(at, turns, places[turns, axis]) for axis in (0, 1)], axis=1)
        gap = followed.cost_s / followed.lower_bound_s if followed.lower_bound_s > 0 else None
        return cls(followed.target, cells, places, gap, now_ns)

    def ahead_of(self, cell: int) -> RouteNow:
        """The route from a cell on; the whole route if the cell is not on it."""
        found = np.flatnonzero(self.cells == cell)
        return self.part(slice(found[-1], None)) if len(found) else self

    def part(self, which: slice | NDArray[np.intp]) -> RouteNow:
        """Some of its places."""
        return RouteNow(self.target, self.cells[which], self.places[which], self.gap, self.begun_ns)


class RouteLines:
    """Routes to one target as lines in which no part of the ground is drawn twice.

    Routes to one target join, as the branches of its tree do: a thousand of them have few cells more than the tree.
    """

    def __init__(self, mesh: TerrainMesh, stride: int) -> None:
        """stride  a line has a point for so many cells"""
        self._mesh = mesh
        self._stride = stride
        self._drawn = np.zeros(mesh.grid.cells, np.bool_)

    def lines(self, routes: Iterable[RouteNow]) -> Strips:
        """Each route up to where it meets one that is drawn already, the longest first."""
        parts, drawn = [np.empty((0, 2))], self._drawn
        for route in sorted(routes, key=lambda route: len(route.cells), reverse=True):
            met = np.flatnonzero(drawn[route.cells])
            end = int(met[0]) if len(met) else len(route.cells) - 1
            if end > 0:
                drawn[route.cells[: end + 1]] = True
                parts.append(route.places[np.append(np.arange(0, end, self._stride), end)])
        drawn[:] = False
        south_m, east_m = ((np.concatenate(parts) + 0.5) * self._mesh.grid.resolution_m).astype(np.float32).T
        lengths = [len(part) for part in parts[1:]]
        return ragged(self._mesh.place(east_m, south_m, 0.2 * self._mesh.scale_m), lengths)
