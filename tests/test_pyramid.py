from __future__ import annotations

import numpy as np

from shared_map.pyramid import LEVEL_TILE, pyramid
from shared_map.terrain import terrain_of_pace


def test_a_thin_wall_survives_every_level_and_bounds_hold() -> None:
    rng = np.random.default_rng(1)
    pace = rng.uniform(0.1, 1.0, (75, 130)).astype(np.float32)
    pace[:, 61] = np.inf
    levels = pyramid(terrain_of_pace(pace, 10.0), smallest=8)
    assert [(level.grid.rows, level.grid.cols) for level in levels] == [
        (75, 130), (38, 65), (19, 33), (10, 17), (5, 9), (3, 5),
    ]  # fmt: skip
    for level in levels:
        side = 2**level.level
        assert level.grid.resolution_m == 10.0 * side
        assert np.isinf(level.costliest[:, 61 // side]).all()
        for row, col in ((0, 0), (level.grid.rows - 1, level.grid.cols - 1)):
            block = pace[row * side : (row + 1) * side, col * side : (col + 1) * side]
            assert level.cheapest[row, col] == block.min()
            assert level.costliest[row, col] == block.max()


def test_a_void_does_not_spread_through_the_levels() -> None:
    heights = np.full((16, 16), 5.0, np.float32)
    heights[3, 3] = np.nan
    levels = pyramid(terrain_of_pace(np.ones((16, 16), np.float32), elevation_m=heights), smallest=4)
    assert (levels[-1].elevation_m == 5).all()
    assert (levels[-1].photo == 128).all()


def test_tiles_cover_a_level() -> None:
    level = pyramid(terrain_of_pace(np.ones((LEVEL_TILE + 9, 20), np.float32)), smallest=10_000)[0]
    assert level.tile(1, 0) == (slice(LEVEL_TILE, LEVEL_TILE + 9), slice(0, 20))
