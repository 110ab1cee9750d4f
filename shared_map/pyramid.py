"""Ever coarser levels of a terrain, each half as fine: for a monitor that looks from afar and for coarse planning.

Thin walls survive: beside the cheapest pace of a block its costliest is kept, which is lethal if any cell in it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bytes, Floats
from shared_map.terrain import Terrain
from swarm.grid import GridSpec

LEVEL_TILE = 256
"""Side of a tile of a level, in cells."""


@dataclass(frozen=True, eq=False)
class Level:
    """A terrain at 1 / 2**level of its resolution; a block cut off at the border counts what is there.

    cheapest, costliest  float32  least and greatest pace of the cells below; a lower and an upper bound
    elevation_m          float32  mean height of those that have one
    photo                uint8    mean colour
    """

    level: int
    grid: GridSpec
    cheapest: Floats
    costliest: Floats
    elevation_m: Floats
    photo: Bytes

    def tile(self, row: int, col: int) -> tuple[slice, slice]:
        """Where a tile lies in the arrays of this level."""
        rows = slice(row * LEVEL_TILE, min((row + 1) * LEVEL_TILE, self.grid.rows))
        return rows, slice(col * LEVEL_TILE, min((col + 1) * LEVEL_TILE, self.grid.cols))


def pyramid(terrain: Terrain, smallest: int = LEVEL_TILE) -> list[Level]:
    """Levels from the terrain itself up to the first that is no larger than `smallest` cells on a side."""
    grid = terrain.grid
    levels = [Level(0, grid, terrain.pace_s_per_m, terrain.pace_s_per_m, terrain.elevation_m, terrain.photo)]
    while max(levels[-1].grid.rows, levels[-1].grid.cols) > smallest:
        levels.append(_coarser(levels[-1]))
    return levels


def _coarser(fine: Level) -> Level:
    grid = fine.grid
    half = GridSpec(
        -(-grid.rows // 2), -(-grid.cols // 2), 2 * grid.resolution_m, grid.west_m, grid.north_m, grid.crs
    )
    corners = _corners(fine.elevation_m)
    known = sum((~np.isnan(corner)).astype(np.float32) for corner in corners)
    total = sum(np.nan_to_num(corner) for corner in corners)
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.asarray(total / known, np.float32)
    colours = _corners(fine.photo)
    mean = sum(corner.astype(np.uint16) for corner in colours)
    return Level(
        fine.level + 1,
        half,
        np.minimum.reduce(_corners(fine.cheapest)),
        np.maximum.reduce(_corners(fine.costliest)),
        height,
        np.asarray((mean + 2) // 4, np.uint8),
    )


def _corners(values: NDArray[Any]) -> list[NDArray[Any]]:
    """The four cells of each 2 x 2 block; at an odd border the last row or column counts twice."""
    rows, cols = values.shape[:2]
    pads = [(0, rows % 2), (0, cols % 2)] + [(0, 0)] * (values.ndim - 2)
    even = np.pad(values, pads, mode="edge") if rows % 2 or cols % 2 else values
    return [even[0::2, 0::2], even[0::2, 1::2], even[1::2, 0::2], even[1::2, 1::2]]
