"""Lines over the terrain: float32 (n, m, 3), n strips of m points each.

rerun takes one array as it is. Of a list of strips it makes an array each, which took a third of a frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from launch_scripts.monitor.movers.points import Points

_ROUTE_POINTS = 64
"""Points of a route at most, so that a hundred routes stay cheap to draw."""


def poles(mesh: TerrainMesh, targets: Points) -> Floats:
    """A line from each target down to the terrain."""
    feet = mesh.place(targets.positions[:, 0], -targets.positions[:, 1])
    return np.stack([feet, targets.positions], axis=1)


def route_strips(mesh: TerrainMesh, routes: Sequence[NDArray[np.integer]]) -> Floats:
    """Routes over the terrain, as cells. A long one is thinned out, a short one ends in its last point repeated."""
    longest = min(max(map(len, routes), default=0), _ROUTE_POINTS)
    cells = np.zeros((len(routes), longest), np.int64)
    for row, route in zip(cells, routes, strict=True):
        if len(route) > longest:
            row[:] = route[np.linspace(0, len(route) - 1, longest).astype(int)]
        else:
            row[: len(route)], row[len(route) :] = route, route[-1]
    return mesh.place_cells(cells, 0.2 * mesh.scale_m)


class Trails:
    """Trails since the last drawing: one strip per id, which joins the one before."""

    def __init__(self, longest_m: float) -> None:
        self._longest_m = longest_m
        self._ids: list[str] = []
        self._last: Floats = np.empty((0, 3), np.float32)
        """Where each of `_ids` was at the end of its trail."""

    def advance(self, ids: list[str], positions: Floats) -> Floats:
        """Strips from the last places to these; none for ids which stand still, are new, or jumped."""
        last = positions.copy()
        if ids == self._ids:
            last = self._last
        else:
            known = {id: n for n, id in enumerate(self._ids)}
            for n, id in enumerate(ids):
                if id in known:
                    last[n] = self._last[known[id]]
        moved_m = np.hypot(*(positions - last)[:, :2].T)
        self._ids, self._last = ids, np.where(moved_m[:, None] > 0, positions, last)
        drawn = (moved_m > 0) & (moved_m <= self._longest_m)
        return np.stack([last[drawn], positions[drawn]], axis=1)
