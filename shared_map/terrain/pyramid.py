"""Levels of detail of a terrain, each at half the resolution of the one before, for pictures.

A wall or a road one cell wide is in every level, however small its share of the cell there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.terrain import Terrain
from swarm.grid import GridSpec


@dataclass(frozen=True, eq=False)
class Level:
    """A terrain at 1 / `side` of its resolution. A block which the border cuts off counts the cells that exist.

    side          cells of the terrain along one cell of this level, a power of two
    elevation_m   float32  mean of the heights that are known; NaN where none is
    photo         uint8    mean colour
    classes       uint8    the commonest class; road where there is any road
    pace_s_per_m  float32  mean of the cells that can be driven; inf where none can
    lethal_share  float32  0 to 1; of the cells below
    """

    side: int
    grid: GridSpec
    elevation_m: Floats
    photo: Bytes
    classes: Bytes
    pace_s_per_m: Floats
    lethal_share: Floats


def level_of(terrain: Terrain, most_cells: int) -> Level:
    """Returns the finest level that has at most this number of cells."""
    colours, pace = (terrain.photo, terrain.classes), terrain.pace_s_per_m
    level = Level(1, terrain.grid, terrain.elevation_m, *colours, pace, np.isinf(pace).astype(np.float32))
    while level.grid.cells > most_cells:
        level = _coarser(level)
    return level


def any_in_blocks(cells: Bools, side: int) -> Bools:
    """Returns which blocks of `side` x `side` cells contain any of these cells: bool, at the resolution of the
    level."""
    if side == 1:
        return cells
    rows, cols = cells.shape
    padded = np.pad(cells, ((0, -rows % side), (0, -cols % side)))
    blocks = padded.reshape(-(-rows // side), side, -(-cols // side), side)
    return np.asarray(blocks.any(axis=(1, 3)), np.bool_)


def _coarser(fine: Level) -> Level:
    grid = fine.grid
    half = GridSpec(
        -(-grid.rows // 2), -(-grid.cols // 2), 2 * grid.resolution_m, grid.west_m, grid.north_m, grid.crs
    )
    shares = [np.float32(1) - corner for corner in _corners(fine.lethal_share)]
    driven = np.asarray(sum(shares), np.float32)
    colours = sum(corner.astype(np.uint16) for corner in _corners(fine.photo))
    return Level(
        2 * fine.side,
        half,
        _mean(_corners(fine.elevation_m), np.float32(np.nan)),
        np.asarray((colours + 2) // 4, np.uint8),
        _commonest(_corners(fine.classes)),
        _mean(_corners(fine.pace_s_per_m), np.float32(np.inf), shares),
        np.float32(1) - driven / np.float32(4),
    )


def _corners(values: NDArray[Any]) -> list[NDArray[Any]]:
    """The four cells of each 2 x 2 block; at an odd border the last row or column counts twice."""
    rows, cols = values.shape[:2]
    pads = [(0, rows % 2), (0, cols % 2)] + [(0, 0)] * (values.ndim - 2)
    even = np.pad(values, pads, mode="edge") if rows % 2 or cols % 2 else values
    return [even[0::2, 0::2], even[0::2, 1::2], even[1::2, 0::2], even[1::2, 1::2]]


def _mean(corners: list[Floats], without: np.float32, weights: list[Floats] | None = None) -> Floats:
    """Weighted mean of the finite corners; `without` where none is finite."""
    total, weight = (np.zeros(corners[0].shape, np.float32) for _ in range(2))
    for number, corner in enumerate(corners):
        share = np.isfinite(corner).astype(np.float32)
        if weights is not None:
            share *= weights[number]
        total += np.where(share > 0, corner, np.float32(0)) * share
        weight += share
    mean = np.full_like(total, without)
    np.divide(total, weight, out=mean, where=weight > 0)
    return mean


def _commonest(corners: list[Bytes]) -> Bytes:
    """Returns the most common of four classes: one that occurs twice, else the first; road beats all."""
    a, b, c, d = corners
    common = np.where((b == c) | (b == d), b, np.where(c == d, c, a))
    road = np.uint8(TerrainClass.ROAD)
    return np.where((a == road) | (b == road) | (c == road) | (d == road), road, common)
