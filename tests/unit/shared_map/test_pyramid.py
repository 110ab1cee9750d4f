"""Levels of detail: a thin wall survives every level, a void spreads through none."""

import numpy as np
import pytest

from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.terrain import any_in_blocks, level_of, terrain_of_pace


def test_a_thin_wall_survives_every_level_and_paces_are_means_of_what_can_be_driven() -> None:
    rng = np.random.default_rng(1)
    pace = rng.uniform(0.1, 1.0, (75, 130)).astype(np.float32)
    pace[:, 61] = np.inf
    terrain = terrain_of_pace(pace, 10.0)
    for most, shape in ((9750, (75, 130)), (9749, (38, 65)), (700, (19, 33)), (200, (10, 17)), (50, (5, 9))):
        level = level_of(terrain, most)
        assert (level.grid.rows, level.grid.cols) == shape
        assert level.grid.resolution_m == 10.0 * level.side
        assert (level.lethal_share[:, 61 // level.side] > 0).all()
        assert np.isfinite(level.pace_s_per_m).all() == (level.side > 1)
        block = pace[: level.side, : level.side]
        assert level.pace_s_per_m[0, 0] == pytest.approx(block.mean(), rel=1e-5)
        assert level.lethal_share.sum() * level.side**2 == pytest.approx(75, rel=0.1)


def test_blocks_that_are_all_lethal_are_lethal() -> None:
    pace = np.ones((8, 8), np.float32)
    pace[:4, :4] = np.inf
    level = level_of(terrain_of_pace(pace), 4)
    assert np.isinf(level.pace_s_per_m).tolist() == [[True, False], [False, False]]
    assert level.lethal_share.tolist() == [[1.0, 0.0], [0.0, 0.0]]


def test_a_void_does_not_spread_through_the_levels() -> None:
    heights = np.full((16, 16), 5.0, np.float32)
    heights[3, 3] = np.nan
    heights[8:, 8:] = np.nan
    level = level_of(terrain_of_pace(np.ones((16, 16), np.float32), elevation_m=heights), 4)
    assert level.elevation_m[0, 0] == 5.0
    assert np.isnan(level.elevation_m[1, 1])
    assert (level.photo == 128).all()


@pytest.mark.parametrize("most", [2500, 50])
def test_the_commonest_class_stays_and_a_road_as_thin_as_it_is(most: int) -> None:
    terrain = terrain_of_pace(np.ones((75, 130), np.float32))
    terrain.classes[:] = np.random.default_rng(2).integers(1, TerrainClass.ROAD, terrain.classes.shape)
    terrain.classes[40, 50:] = TerrainClass.ROAD
    level = level_of(terrain, most)
    for row, col in np.ndindex(level.classes.shape):
        counts = np.bincount(
            terrain.classes[row * level.side :, col * level.side :][: level.side, : level.side].flat
        )
        expected = (
            {TerrainClass.ROAD} if len(counts) > TerrainClass.ROAD else np.flatnonzero(counts == counts.max())
        )
        assert level.classes[row, col] in expected


def test_a_mark_on_one_cell_is_seen_from_afar() -> None:
    marks = np.zeros((5, 7), np.bool_)
    marks[4, 6] = True
    assert any_in_blocks(marks, 1) is marks
    assert any_in_blocks(marks, 4).tolist() == [[False, False], [False, True]]
