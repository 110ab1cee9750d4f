"""Outlines of the windows that planners grew, laid over the terrain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from swarm.grid import Window

SIDE_POINTS = 33
"""Points along each side of a window: its outline follows the terrain."""


def window_outlines(mesh: TerrainMesh, windows: Sequence[Window]) -> Floats:
    """The border of each window, laid over the terrain."""
    sides = np.array([(w.row0, w.row1 - 1, w.col0, w.col1 - 1) for w in windows], np.int64).reshape(-1, 4).T
    north, south = np.clip(sides[:2], 0, mesh.grid.rows - 1)[..., None]
    west, east = np.clip(sides[2:], 0, mesh.grid.cols - 1)[..., None]
    along = np.linspace(0, 1, SIDE_POINTS)
    down, across = (north + (south - north) * along).astype(int), (west + (east - west) * along).astype(int)
    flat = np.zeros(SIDE_POINTS, int)
    rows = np.concatenate([north + flat, down, south + flat, down[:, ::-1]], axis=1)
    cols = np.concatenate([across, east + flat, across[:, ::-1], west + flat], axis=1)
    return mesh.place_cells(rows * mesh.grid.cols + cols, 0.25 * mesh.scale_m)
