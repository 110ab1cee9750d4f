"""The terrain as arrays that the live view shows: no rerun, no bus, no clock.

The view's metres: x to the east and y to the north of the grid's north-west corner, so y is never positive; z up,
stretched so that gentle land still looks like land.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.pyramid import level_of
from shared_map.terrain.terrain import Terrain
from swarm.grid import Window

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

MESH_TILE = 64
"""Side of a mesh tile in texels. A changed mark sends the texture of one tile again."""
_MOST_TEXELS = 1 << 20
_MOST_VERTICES = 1 << 17
_RELIEF = 0.09
"""Height of the view, from the lowest to the highest cell, as a share of the terrain's width."""


@dataclass(frozen=True, slots=True, eq=False)
class MeshTile:
    """A piece of the terrain's mesh.

    window     cells whose photo covers it, one row and column more than its own, so that pieces join without seams
    vertices   float32 (n, 3); triangles uint32 (m, 3); texcoords float32 (n, 2), 0..1 over the window's photo
    """

    index: int
    window: Window
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

    def place(self, east_m: Floats, south_m: Floats, above_m: float = 0.0) -> Floats:
        """Points on the terrain, float32 (n, 3), lifted by some metres of the view."""
        east_m, south_m = np.asarray(east_m, np.float32), np.asarray(south_m, np.float32)
        seen = self.seen.grid
        rows = np.clip(south_m / seen.resolution_m - 0.5, 0, seen.rows - 1)
        cols = np.clip(east_m / seen.resolution_m - 0.5, 0, seen.cols - 1)
        row0, col0 = rows.astype(np.intp), cols.astype(np.intp)
        row1, col1 = np.minimum(row0 + 1, seen.rows - 1), np.minimum(col0 + 1, seen.cols - 1)
        down, right = rows - row0, cols - col0
        h = self.heights_m
        upper = h[row0, col0] * (1 - right) + h[row0, col1] * right
        lower = h[row1, col0] * (1 - right) + h[row1, col1] * right
        up = upper * (1 - down) + lower * down + above_m
        return np.stack([east_m, -south_m, up], axis=-1).astype(np.float32)

    def place_cells(self, cells: NDArray[np.integer], above_m: float = 0.0) -> Floats:
        """Centres of cells on the terrain, float32 (n, 3)."""
        rows, cols = np.divmod(np.asarray(cells, np.int64), self.grid.cols)
        resolution_m = np.float32(self.grid.resolution_m)
        return self.place(
            ((cols + 0.5) * resolution_m).astype(np.float32),
            ((rows + 0.5) * resolution_m).astype(np.float32),
            above_m,
        )

    @property
    def tiles(self) -> int:
        return self.tile_rows * self.tile_cols

    def mesh_tiles(self, coarser: int = 1) -> list[MeshTile]:
        """All tiles of the terrain's mesh, with vertices so many times as far apart."""
        return [self._mesh_tile(index, coarser * self.step) for index in range(self.tiles)]

    def whole(self, side: int) -> MeshTile:
        """The terrain in one piece, with at most so many vertices along a side."""
        rows, cols = (
            np.unique(np.linspace(0, count - 1, min(side, count)).astype(np.int64))
            for count in (self.grid.rows, self.grid.cols)
        )
        return self._piece(0, Window(0, 0, self.grid.rows, self.grid.cols), rows, cols)

    def tile_window(self, index: int) -> Window:
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

    def _mesh_tile(self, index: int, step: int) -> MeshTile:
        window = self.tile_window(index)
        rows = _stepped(window.row0, window.row1, step, self.tile_cells)
        cols = _stepped(window.col0, window.col1, step, self.tile_cells)
        return self._piece(index, window, rows, cols)

    def _piece(self, index: int, window: Window, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> MeshTile:
        grid_rows, grid_cols = np.meshgrid(rows, cols, indexing="ij")
        vertices = self.place_cells((grid_rows * self.grid.cols + grid_cols).reshape(-1))
        height, width = (
            -(-side // self.texel) * self.texel for side in (window.row1 - window.row0, window.col1 - window.col0)
        )
        texcoords = np.stack(
            [(grid_cols - window.col0 + 0.5) / width, (grid_rows - window.row0 + 0.5) / height], axis=-1
        )
        return MeshTile(
            index=index,
            window=window,
            vertices=vertices,
            triangles=_triangles(len(rows), len(cols)),
            texcoords=texcoords.reshape(-1, 2).astype(np.float32),
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
