"""The terrain as arrays that the live view shows: no rerun, no bus, no clock.

The view's metres: x to the east and y to the north of the grid's north-west corner, so y is never positive; z up,
stretched so that gentle land still looks like land.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from shared_map.terrain.terrain import Terrain, level_of
from swarm.grid import Window

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

MESH_TILE = 64
"""Side of a mesh tile in texels. A changed mark sends the texture of one tile again."""
_MOST_TEXELS = 1 << 20
_MOST_VERTICES = 1 << 17
_RELIEF = 0.09
"""Height of the view, from the lowest to the highest cell, as a share of the terrain's width."""


class MeshTile(NamedTuple):
    """A piece of the terrain's mesh: vertices float32 (n, 3), triangles uint32 (m, 3), and texcoords float32
    (n, 2), 0..1 over the photo of the piece's window."""

    vertices: Floats
    triangles: NDArray[np.uint32]
    texcoords: Floats


class TerrainMesh:
    """The terrain as the view has it: of a large one, the finest level of its pyramid with at most `_MOST_TEXELS`.

    seen       that level
    texel      cells of the terrain along one pixel of the photo
    stretch    how many times as high as they are heights are drawn
    heights_m  float32, of that level, stretched; over the lowest
    aloft_m    class that flies -> how high over each cell of the terrain, float32 (rows, cols), stretched
    """

    def __init__(
        self,
        terrain: Terrain,
        height_factor: float | None = None,
        aloft: Mapping[str, Terrain] = MappingProxyType({}),
    ) -> None:
        self.grid = terrain.grid
        self.seen = seen = level_of(terrain, _MOST_TEXELS)
        self.texel = seen.side
        heights = np.array(seen.elevation_m, np.float32)
        voids = ~np.isfinite(heights)
        lowest = float(heights[~voids].min()) if not voids.all() else 0.0
        heights[voids] = lowest
        heights -= lowest
        self.width_m = self.grid.cols * self.grid.resolution_m
        self.depth_m = self.grid.rows * self.grid.resolution_m
        relief_m = float(heights.max())
        wanted = _RELIEF * max(self.width_m, self.depth_m) / relief_m if relief_m > 0 else 1.0
        self.stretch = height_factor or min(max(wanted, 1.0), 8.0)
        self.heights_m = heights * np.float32(self.stretch)
        self.aloft_m: dict[str, Floats] = {}
        for name, own in aloft.items():
            assert own.flight_m is not None
            over_m = np.nan_to_num(own.flight_m - terrain.elevation_m)
            self.aloft_m[name] = (over_m * np.float32(self.stretch)).astype(np.float32)
        self.step = self.texel * max(2, math.ceil(math.sqrt(seen.grid.cells / _MOST_VERTICES)))
        self.tile_cells = max(MESH_TILE * self.texel // self.step, 1) * self.step
        self.tile_cols = -(-self.grid.cols // self.tile_cells)
        self.tile_rows = -(-self.grid.rows // self.tile_cells)

    @property
    def scale_m(self) -> float:
        """Length in metres which is the same share of any terrain's width."""
        return max(self.width_m, self.depth_m) / 100

    @property
    def heights_text(self) -> str:
        """Returns the exaggeration of heights, in words."""
        return "heights to scale" if self.stretch == 1 else f"heights x {self.stretch:.2g}"

    def place(self, east_m: Floats, south_m: Floats, above_m: float = 0.0) -> Floats:
        """Points on the terrain, float32 (n, 3), lifted by some metres of the view. Outside, the ground is as high
        as at its border."""
        east_m, south_m = np.asarray(east_m, np.float32), np.asarray(south_m, np.float32)
        row_col = np.stack([south_m, east_m]) / self.seen.grid.resolution_m - 0.5
        up = map_coordinates(self.heights_m, row_col, order=1, mode="nearest") + above_m
        return np.stack([east_m, -south_m, up], axis=-1).astype(np.float32)

    def place_cells(self, cells: NDArray[np.integer], above_m: float = 0.0) -> Floats:
        """Centres of cells on the terrain, float32 (n, 3)."""
        south_east = np.stack(np.divmod(np.asarray(cells, np.int64), self.grid.cols)) + 0.5
        south_m, east_m = (south_east * self.grid.resolution_m).astype(np.float32)
        return self.place(east_m, south_m, above_m)

    @property
    def tiles(self) -> int:
        return self.tile_rows * self.tile_cols

    def mesh_tiles(self, coarser: int = 1) -> list[MeshTile]:
        """Returns all tiles of the terrain's mesh, with vertices `every` cells apart."""
        step = coarser * self.step
        windows = [self.tile_window(index) for index in range(self.tiles)]
        return [
            self._piece(
                window,
                _stepped(window.row0, window.row1, step, self.tile_cells),
                _stepped(window.col0, window.col1, step, self.tile_cells),
            )
            for window in windows
        ]

    def whole(self, side: int) -> MeshTile:
        """Returns the terrain in one piece, with a bounded number of vertices along a side."""
        rows, cols = (
            np.unique(np.linspace(0, count - 1, min(side, count)).astype(np.int64))
            for count in (self.grid.rows, self.grid.cols)
        )
        return self._piece(Window(0, 0, self.grid.rows, self.grid.cols), rows, cols)

    def tile_window(self, index: int) -> Window:
        """The cells whose photo covers a tile: a step more than its own, so that tiles join without seams."""
        tile_row, tile_col = divmod(index, self.tile_cols)
        row0, col0 = tile_row * self.tile_cells, tile_col * self.tile_cells
        return Window(
            row0,
            col0,
            min(row0 + self.tile_cells + self.step, self.grid.rows),
            min(col0 + self.tile_cells + self.step, self.grid.cols),
        )

    def tiles_touching(self, window: Window) -> list[int]:
        """Indices of the tiles whose photo shows cells of a window."""
        reach = self.step
        rows = range(max(window.row0 - reach, 0) // self.tile_cells, (window.row1 - 1) // self.tile_cells + 1)
        cols = range(max(window.col0 - reach, 0) // self.tile_cells, (window.col1 - 1) // self.tile_cells + 1)
        return [row * self.tile_cols + col for row in rows for col in cols]

    def _piece(self, window: Window, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> MeshTile:
        grid_rows, grid_cols = (each.reshape(-1) for each in np.meshgrid(rows, cols, indexing="ij"))
        height, width = (
            -(-side // self.texel) * self.texel for side in (window.row1 - window.row0, window.col1 - window.col0)
        )
        across = [(grid_cols - window.col0 + 0.5) / width, (grid_rows - window.row0 + 0.5) / height]
        return MeshTile(
            self.place_cells(grid_rows * self.grid.cols + grid_cols),
            _triangles(len(rows), len(cols)),
            np.stack(across, axis=-1).astype(np.float32),
        )


def _stepped(first: int, end: int, step: int, tile_cells: int) -> NDArray[np.int64]:
    """Every step-th index from `first` to the next tile's first, or to the last before `end` at the border."""
    last = min(first + tile_cells, end - 1)
    indices = np.arange(first, last + 1, step)
    return indices if indices[-1] == last else np.append(indices, last)


def _triangles(rows: int, cols: int) -> NDArray[np.uint32]:
    corner = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)[None, :]).reshape(-1)
    north_west, north_east, south_west, south_east = corner, corner + 1, corner + cols, corner + cols + 1
    faces = np.concatenate(
        [np.stack([north_west, south_west, north_east], 1), np.stack([north_east, south_west, south_east], 1)]
    )
    return faces.astype(np.uint32)
