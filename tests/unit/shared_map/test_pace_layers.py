"""Layers against independent derivatives and against numbers that one can check by eye."""

import math
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from support.height_models import written

from shared_map.importers.terrain_sources import load_source
from shared_map.terrain.pace_layers import (
    TerrainClass,
    gradient_of_padded,
    polygon_mask,
    slope_deg,
    terrain_pace,
)
from shared_map.terrain.row_bands import padded_rows
from shared_map.terrain.slope_and_climb import slope_factor
from shared_map.terrain.terrain import build_terrain
from shared_map.terrain.zones import paint_zones, zone_mask
from swarm.config.ground import CostConfig, SlopeRule, TerrainConfig, ZoneConfig
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError
from swarm.grid import GridSpec

DEM = Path(__file__).parents[4] / "shared" / "data" / "dem"
MODELS = {
    "jacksboro": "jacksboro",
    "davosdorf": str(DEM / "davosdorf/davosdorf.tif"),
    "bigtujunga": str(DEM / "bigtujunga/bigtujunga_512.tif"),
    "rmnp": str(DEM / "rmnp/rmnp-dem.tif"),
}
RULES: tuple[SlopeRule, ...] = get_args(SlopeRule)
POINTS = ((-30.0, 3.0), (0.0, 1.0), (20.0, 4.0))
"""Points of the rule `table`."""


def whole(heights_m: np.ndarray) -> np.ndarray:
    return padded_rows(heights_m, 0, len(heights_m))


@pytest.mark.parametrize("name", MODELS)
def test_slope_is_scikit_images_derivative_within_1e_5(name: str) -> None:
    from skimage.filters import sobel_h, sobel_v

    if name != "jacksboro" and not DEM.is_dir():
        pytest.skip("../shared/data is absent")
    source = load_source(TerrainConfig(source=MODELS[name]), 1)
    heights, step = source.elevation_m.astype(np.float64), source.grid.resolution_m
    theirs_east, theirs_south = sobel_v(heights) / (2 * step), sobel_h(heights) / (2 * step)
    ours_east, ours_north = gradient_of_padded(whole(source.elevation_m), step)
    inner = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(ours_east[inner], theirs_east[inner], rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours_north[inner], -theirs_south[inner], rtol=0, atol=1e-5)
    theirs = np.arctan(np.hypot(theirs_east, theirs_south))
    ours = np.radians(slope_deg(source.elevation_m, step).astype(np.float64))
    np.testing.assert_allclose(ours[inner], theirs[inner], rtol=0, atol=1e-5)


def test_a_plane_has_its_slope_everywhere_the_border_too() -> None:
    row, col = np.mgrid[:9, :7]
    east, north = gradient_of_padded(whole((100 + 3.0 * col - 4.0 * row).astype(np.float32)), 10.0)
    np.testing.assert_allclose(east, 0.3, atol=1e-6)
    np.testing.assert_allclose(north, 0.4, atol=1e-6)


def test_a_void_counts_as_level_with_its_neighbours_and_spoils_none() -> None:
    row, _ = np.mgrid[:9, :9]
    heights = (row * 2.0).astype(np.float32)
    heights[4, 4] = np.nan
    east, north = gradient_of_padded(whole(heights), 10.0)
    known = ~np.isnan(heights)
    assert np.isfinite(east[known]).all()
    np.testing.assert_allclose(north[0:3], -0.2, atol=1e-6)


def test_linear_and_quadratic_reach_the_steep_factor_at_the_limit() -> None:
    limit = np.array([math.tan(math.radians(29.999))], np.float32)
    half = np.array([math.tan(math.asin(math.sin(math.radians(30)) / 2))], np.float32)
    for rule, middle in (("linear", 3.0), ("quadratic", 2.0)):
        cost = CostConfig(slope_rule=rule, max_slope_deg=30, steep_factor=5)
        assert slope_factor(limit, cost)[0] == pytest.approx(5, rel=1e-3)
        assert slope_factor(half, cost)[0] == pytest.approx(middle, rel=1e-4)


def test_the_merge_rule_cell_by_cell() -> None:
    grid = GridSpec(1, 8, 10.0)
    kinds = ["GRASS", "FOREST", "ROAD", "WATER", "GRASS", "ROAD", "GRASS", "GRASS"]
    classes = np.array([[TerrainClass[kind] for kind in kinds]], np.uint8)
    grades = np.array([[0, 0, 0, 0, 2.0, 2.0, np.nan, 0]], np.float32)
    cost = CostConfig(flat_speed_m_per_s=10, road_speed_m_per_s=20)
    pace = terrain_pace(grades, classes, cost)
    inf = math.inf
    np.testing.assert_allclose(pace, [[0.1, 0.18, 0.05, inf, inf, inf, inf, 0.1]])

    def zone(kind: str, col0: int, col1: int) -> ZoneConfig:
        return ZoneConfig(kind=kind, polygon_m=((10 * col0, 0), (10 * col1, 0), (10 * col1, 10), (10 * col0, 10)))

    drawn = (("forbidden", 1, 2), ("rough", 0, 2), ("preferred", 7, 8), ("road", 3, 8), ("rough", 3, 4))
    paint_zones(pace, [zone(*each) for each in drawn], grid, cost, void=np.isnan(grades))
    # rough doubles; forbidden heartbeats later paint; a road bridges water and cliffs, never a void
    np.testing.assert_allclose(pace, [[0.2, inf, 0.05, 0.1, 0.05, 0.05, inf, 0.05]])


def test_a_scenario_sets_the_factor_of_a_class() -> None:
    classes = np.array([[TerrainClass.WATER, TerrainClass.FOREST]], np.uint8)
    level = np.zeros((1, 2), np.float32)
    pace = terrain_pace(level, classes, CostConfig(class_factor={"water": 4.0, "forest": "lethal"}))
    np.testing.assert_allclose(pace, [[0.4, math.inf]])
    ignored = terrain_pace(level, classes, CostConfig(classes=False))
    np.testing.assert_allclose(ignored, [[0.1, 0.1]])
    assert TerrainClass.WATER.factor == math.inf


def test_a_polygon_covers_the_cells_whose_middle_lies_in_it() -> None:
    triangle = polygon_mask(((0, 0), (50, 0), (0, 50)), GridSpec(5, 5, 10.0))
    assert triangle.tolist() == [[c + r < 4 for c in range(5)] for r in range(5)]
    hole = polygon_mask(
        ((0, 0), (50, 0), (50, 50), (0, 50), (0, 0), (20, 20), (20, 30), (30, 30), (30, 20), (20, 20)),
        GridSpec(5, 5, 10.0),
    )
    assert hole.sum() == 24
    assert not hole[2, 2]


@pytest.mark.parametrize(
    ("where", "size", "words"),
    [
        ({"mask": "none.png"}, (20, 30), r"'swamp' covers no cell of the terrain: .*none\.png is 0 everywhere"),
        ({"mask": "m.png"}, (10, 10), "20 x 30 pixels, the terrain 10 x 10"),
        ({"mask": "nowhere.png"}, (10, 10), "No such file"),
        ({"polygon_m": ((900, 900), (950, 900), (950, 950))}, (20, 30), r"'swamp' covers no cell.* 300 m x 200 m"),
    ],
)
def test_a_zone_may_be_a_painted_mask_and_one_of_no_cell_is_refused(tmp_path, monkeypatch, where, size, words):
    monkeypatch.chdir(tmp_path)
    painted = np.zeros((20, 30), np.uint8)
    for name in ("none.png", "m.png"):
        written(tmp_path / name, painted, "uint8", driver="PNG", crs=None, transform=None)
        painted[5:8, 5:8] = 255
    np.testing.assert_array_equal(
        zone_mask(ZoneConfig(kind="road", mask="m.png"), GridSpec(20, 30, 10.0)), painted > 0
    )
    zone = ZoneConfig(kind="rough", name="swamp", **where)
    with pytest.raises(TerrainError, match=words):
        zone_mask(zone, GridSpec(*size, 10.0))
    terrain = TerrainConfig(source="synthetic", rows=size[0], cols=size[1], resolution_m=10.0)
    with pytest.raises(TerrainError, match=words):
        build_terrain(Scenario(terrain=terrain, cost=CostConfig(zones=(zone,))))
