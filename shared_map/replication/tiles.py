"""Cells by tile: between flat indices in the grid and (tile, cell in the tile), and the tiles of a region."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm.config.vehicle_classes import MOST_CLASSES
from swarm.grid import REGION_TILES, TILE_CELLS, GridSpec

_TILE_BITS = TILE_CELLS.bit_length() - 1
_TILE_MASK = TILE_CELLS - 1
"""A tile's side is a power of two: row and column in it are the high and the low bits of a cell's index."""


def beyond_tile(grid: GridSpec) -> int:
    """The number after the last tile. Sets about it state nothing of cells, but what their authors have learned
    (`shared_map.pace_measurements`)."""
    return grid.tiles


def beyond_region(grid: GridSpec) -> int:
    """The number after the last region: under it go the sets about `beyond_tile`."""
    return grid.region_of_tile(grid.tiles - 1) + 1


def region_of(grid: GridSpec, tile: int) -> int:
    """The region under whose key the sets about a tile go, of whatever class."""
    return beyond_region(grid) if tile == beyond_tile(grid) else grid.region_of_tile(grid.class_of_tile(tile)[1])


def of_all_classes(grid: GridSpec, tiles: Iterable[int]) -> list[int]:
    """The numbers of these tiles for all vehicles and for each class."""
    return [grid.tile_for(tile, number) for number in range(MOST_CLASSES + 1) for tile in tiles]


def tile_corners(grid: GridSpec, tiles: ArrayLike) -> NDArray[np.uint32]:
    """Flat index (uint32) of the north-west cell of each tile, of whatever class."""
    tile_rows, tile_cols = np.divmod(np.asarray(tiles, np.int64) % (grid.tiles + 1), grid.tile_cols)
    return np.asarray(tile_rows * (TILE_CELLS * grid.cols) + tile_cols * TILE_CELLS, np.uint32)


def grid_cells(grid: GridSpec, corners: NDArray[np.uint32], cells: NDArray[np.integer]) -> NDArray[np.uint32]:
    """Flat indices in the grid.

    corners  uint32 ()   or (cells,): `tile_corners` of the tile of each cell
    cells    int (cells,)  index in the tile, row-major over 32 x 32
    """
    inner = cells.astype(np.uint32)
    return (inner >> np.uint32(_TILE_BITS)) * np.uint32(grid.cols) + (inner & np.uint32(_TILE_MASK)) + corners


def tile_cells(grid: GridSpec, cells: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.uint16]]:
    """(tile, index in the tile) of flat indices, which are inside the grid."""
    rows, cols = np.divmod(cells.astype(np.int64), grid.cols)
    tiles = (rows // TILE_CELLS) * grid.tile_cols + cols // TILE_CELLS
    inner = (rows % TILE_CELLS) * TILE_CELLS + cols % TILE_CELLS
    return tiles, inner.astype(np.uint16)


def region_tiles(grid: GridSpec, region: int) -> list[int]:
    """The tiles of a region, in increasing order."""
    region_row, region_col = divmod(region, grid.region_cols)
    rows = range(region_row * REGION_TILES, min((region_row + 1) * REGION_TILES, grid.tile_rows))
    cols = range(region_col * REGION_TILES, min((region_col + 1) * REGION_TILES, grid.tile_cols))
    return [row * grid.tile_cols + col for row in rows for col in cols]
