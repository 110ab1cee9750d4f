"""Rasters that would have ended in a traceback, at a web server, in a wait for ever, or as a lake that is none."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from support.height_models import load, written

from shared_map.importers.water_and_voids import level_ground, undeclared_voids
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError

HEIGHTS = np.add.outer(np.arange(40) * 2.0, np.arange(40) * 1.0).astype(np.float32)


def dem(path: Path, heights=HEIGHTS, crs="EPSG:32632", where=(500_000.0, 5_000_000.0)) -> Path:
    return written(path, heights, crs=crs, transform=from_origin(*where, 30, 30))


def test_a_slope_too_gentle_to_see_between_two_cells_is_no_lake() -> None:
    slope = np.add.outer(np.arange(200) * 0.002, np.arange(200) * 0.001).astype(np.float32)
    assert not level_ground(slope).mask.any()
    slope[60:100, 60:100] = slope.min() - 1
    assert np.count_nonzero(level_ground(slope).mask) == 1600


def test_a_file_of_one_code_only_has_no_heights() -> None:
    assert undeclared_voids(np.full((9, 9), -9999, np.float32)) == (-9999,)
    assert undeclared_voids(np.zeros((9, 9), np.float32)) == ()


def test_a_map_in_metres_may_lie_across_180_degrees(tmp_path: Path) -> None:
    path = dem(tmp_path / "fiji.tif", crs="EPSG:3832", where=(3_339_000.0, -1_800_000.0))
    raster = load(path)
    assert raster.grid.rows in range(37, 42)
    assert raster.grid.cols in range(37, 42)
    path = dem(tmp_path / "edge.tif", crs="EPSG:3857", where=(20_037_000.0, -1_800_000.0))
    with pytest.raises(TerrainError, match="beyond the edge of EPSG:3857"):
        load(path)


@pytest.mark.parametrize("west", [179.99, 350.0, -180.02])
def test_degrees_which_go_on_beyond_180_are_the_same_ground_as_elsewhere(tmp_path: Path, west: float) -> None:
    places = {lon: from_origin(lon, 50, 0.001, 0.001) for lon in (10.0, west)}
    files = [written(tmp_path / f"{lon}.tif", HEIGHTS, crs="EPSG:4326", transform=places[lon]) for lon in places]
    np.testing.assert_allclose(*(load(file).elevation_m for file in files), atol=0.01)


@pytest.mark.parametrize(("right", "down"), [(1, 1), (-1, -1), (-1, 1)])
def test_a_file_which_begins_in_the_south_or_east_is_turned(tmp_path: Path, right: int, down: int) -> None:
    place = rasterio.Affine(30 * right, 0, 500_000, 0, 30 * down, 5_000_000)
    turned = HEIGHTS[:: -1 if down > 0 else 1, ::right]
    np.testing.assert_array_equal(load(written(tmp_path / "a.tif", HEIGHTS, transform=place)).elevation_m, turned)


def test_level_ground_of_a_large_file_is_looked_for_in_some_of_its_cells(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("shared_map.importers.height_rasters.MOST_SAMPLED", 2000)
    heights = np.add.outer(np.arange(101) * 2.0, np.arange(83) * 1.0).astype(np.float32) + 50
    heights[20:60, 20:60] = 40
    level = load(dem(tmp_path / "large.tif", heights)).level
    assert level.shape == heights.shape
    assert (level != (heights == 40)).mean() < 0.03


def test_a_sparse_file_is_read_and_a_cut_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "sparse.tif"
    kind = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": -1.0, "tiled": True, "sparse_ok": True}
    place = {"crs": "EPSG:32632", "transform": from_origin(500_000, 5_000_000, 30, 30)}
    with rasterio.open(path, "w", width=512, height=512, blockxsize=256, blockysize=256, **kind, **place) as file:
        file.write(
            np.add.outer(np.arange(256.0), np.arange(256.0)).astype(np.float32)[None], window=((0, 256), (256, 512))
        )
    found = load(path).elevation_m
    assert np.isnan(found).mean() == 0.75
    assert found[0, 256:].tolist() == list(range(256))
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(TerrainError, match="is truncated"):
        load(path)


def test_a_sea_floor_is_doubted(tmp_path: Path) -> None:
    from shared_map.terrain.terrain import build_terrain
    from shared_map.terrain.terrain_report import doubts_about, facts_of
    from swarm.config.scenario import Scenario

    path = str(dem(tmp_path / "deep.tif", HEIGHTS * 8 - 600))
    for water_below_m, told in ((None, 1), (0.0, 0)):
        terrain = build_terrain(Scenario(terrain=TerrainConfig(source=path, water_below_m=water_below_m)))
        assert sum("a sea floor" in doubt for doubt in doubts_about(facts_of(terrain))) == told


def test_a_setting_that_contradicts_the_file_is_said_aloud(tmp_path: Path) -> None:
    path = dem(tmp_path / "dem.tif")
    said = "terrain.crs = 'EPSG:32633' counts, though the file says EPSG:32632: every place follows from it"
    notes = {crs: load(path, crs=crs).notes for crs in (None, "EPSG:32632", "EPSG:32633")}
    assert {crs for crs, told in notes.items() if said in told} == {"EPSG:32633"}
    bare = dem(tmp_path / "bare.tif", crs=None)
    told = load(bare, crs="EPSG:32633").notes
    assert not any("counts" in note for note in told)
