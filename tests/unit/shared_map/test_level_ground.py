"""Water and undeclared voids in height models: found before any resampling, and never in silence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from shared_map.arrays import Floats
from shared_map.terrain.importers.level_ground import level_ground, undeclared_voids
from shared_map.terrain.importers.sources import Source, load_source
from shared_map.terrain.layers import TerrainClass
from swarm.config.scenario import TerrainConfig
from swarm.errors import TerrainError

SIDE = 200


def hills(seed: int, relief_m: float, smooth_cells: float = 12.0) -> Floats:
    """Heights of rounded hills, `relief_m` from the lowest to the highest."""
    rough = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), smooth_cells)
    rough -= rough.min()
    return np.asarray(rough / rough.max() * relief_m, np.float32)


def written(path: Path, heights: Any, dtype: str = "float32", **profile: Any) -> Path:
    import rasterio
    from rasterio.transform import from_origin

    place = {"crs": "EPSG:32632", "transform": from_origin(500_000, 5_000_000, 20, 20), **profile}
    rows, cols = heights.shape
    with rasterio.open(path, "w", driver="GTiff", height=rows, width=cols, count=1, dtype=dtype, **place) as file:
        file.write(heights.astype(dtype), 1)
    return path


def load(path: Path, **keys: Any) -> Source:
    return load_source(TerrainConfig(source=str(path), **keys), seed=1)


def is_water(source: Source) -> Any:
    return source.classes == TerrainClass.WATER


# --- level ground -------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(40, 600), st.floats(0.05, 0.7))
def test_the_sea_is_found_whatever_share_it_has_and_dry_hills_are_not_taken(
    seed: int, relief_m: float, share: float
) -> None:
    ground = hills(seed, relief_m)
    level_m = np.quantile(ground, share)
    sea = ground <= level_m
    found = level_ground(np.maximum(ground - level_m, 0).astype(np.float32)).mask
    missed = sea & ~ndimage.binary_dilation(found, iterations=2)
    assert missed.sum() <= 0.02 * sea.sum() + 30
    assert (found & ~sea).sum() <= 0.03 * (~sea).sum()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(2, 60), st.floats(8, 40))
def test_a_plain_in_whole_metres_is_no_lake(seed: int, relief_m: float, smooth_cells: float) -> None:
    plain = np.round(100 + hills(seed, relief_m, smooth_cells)).astype(np.float32)
    assert level_ground(plain).mask.mean() <= 0.05


def test_a_lake_among_mountains_in_whole_metres_is_found_and_a_level_top_is_not() -> None:
    ground = np.round(hills(3, 800)).astype(np.float32)
    basin = np.maximum(ground, np.float32(250))
    top = np.minimum(ground, np.float32(550))
    lake = basin == 250
    found = level_ground(basin)
    assert (found.mask & lake).sum() >= 0.9 * lake.sum()
    assert found.patches[0][0] == 250
    assert not level_ground(top).mask[top == 550].any()


def test_a_lake_that_differs_by_millimetres_is_one_lake() -> None:
    ground = hills(4, 300)
    lake = ground < 60
    noise = np.random.default_rng(1).uniform(-0.001, 0.001, ground.shape)
    heights = np.where(lake, 60 + noise, ground).astype(np.float32)
    heights[0] = 300  # a border without sea
    largest = max(height_cells[1] for height_cells in level_ground(heights).patches)
    labels, _ = ndimage.label(ndimage.binary_erosion(lake, np.ones((3, 3))), np.ones((3, 3)))
    assert largest >= 0.9 * np.bincount(labels.ravel())[1:].max()


def test_nothing_level_is_nothing() -> None:
    assert level_ground(hills(5, 300)).patches == ()
    assert level_ground(np.full((3, 3), np.nan, np.float32)).patches == ()


# --- undeclared voids ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [-32768, -9999, -999, 0, 32767])
def test_a_code_that_is_far_from_all_heights_is_a_void(code: int) -> None:
    heights = 400 + hills(6, 300)
    assert undeclared_voids(heights) == ()
    heights[:20] = code
    assert undeclared_voids(heights) == (code,)


def test_two_codes_are_both_found() -> None:
    heights = 400 + hills(6, 300)
    heights[0], heights[1] = -9999, 0
    assert undeclared_voids(heights) == (-9999, 0)


def test_a_code_among_like_heights_is_ground() -> None:
    coast = hills(7, 100)
    coast[coast < 20] = 0
    coast[coast > 0] -= 19
    assert undeclared_voids(coast.astype(np.float32)) == ()
    depths = (-1100 + hills(7, 400)).astype(np.float32)
    depths[5, 5] = -999
    assert undeclared_voids(depths) == ()


# --- in a terrain -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution_m", [None, 13.0, 45.0])
@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_water_of_a_file_is_lethal_at_every_cell_size(
    tmp_path: Path, resolution_m: float | None, dtype: str
) -> None:
    ground = np.maximum(hills(8, 900) - 300, 0)
    sea = ground == 0
    source = load(written(tmp_path / "coast.tif", ground, dtype), resolution_m=resolution_m)
    assert is_water(source).mean() == pytest.approx(sea.mean(), abs=0.03)
    (told,) = [note for note in source.notes if note.startswith("level ground")]
    assert "is taken for water" in told
    assert "terrain.level_is = 'ground'" in told
    dry = load(tmp_path / "coast.tif", resolution_m=resolution_m, level_is="ground")
    assert not is_water(dry).any()
    assert any("taken for ground" in note for note in dry.notes)


def test_water_below_a_height(tmp_path: Path) -> None:
    ground = hills(9, 100) - 30
    source = load(written(tmp_path / "polder.tif", ground), water_below_m=0.0)
    np.testing.assert_array_equal(is_water(source), ground < 0)


@pytest.mark.parametrize("resolution_m", [None, 33.0])
def test_undeclared_voids_are_no_ground_and_leave_no_slopes(tmp_path: Path, resolution_m: float | None) -> None:
    ground = 400 + hills(10, 300)
    ground[:30], ground[50:60, 50:60] = -32768, -9999
    source = load(written(tmp_path / "holes.tif", ground, "int16"), resolution_m=resolution_m)
    known = source.elevation_m[~np.isnan(source.elevation_m)]
    assert known.min() >= 399
    assert 0.1 < np.isnan(source.elevation_m).mean() < 0.25
    assert sum("is taken for no height" in note for note in source.notes) == 2
    filled = load(tmp_path / "holes.tif", resolution_m=resolution_m, nodata="fill")
    assert filled.elevation_m.min() >= 399


def test_values_that_the_scenario_names_are_voids(tmp_path: Path) -> None:
    ground = 400 + np.round(hills(11, 300))
    ground[20:40, 20:40] = 412
    source = load(written(tmp_path / "a.tif", ground, "int16"), nodata_values=(412.0,))
    assert np.isnan(source.elevation_m[20:40, 20:40]).all()


def test_a_text_grid_is_looked_at_alike(tmp_path: Path) -> None:
    ground = np.maximum(hills(12, 900) - 300, 0)
    ground[:3] = -9998
    head = f"ncols {SIDE}\nnrows {SIDE}\nxllcorner 0\nyllcorner 0\ncellsize 20\n"
    rows = "\n".join(" ".join(f"{height:.3f}" for height in row) for row in ground)
    (tmp_path / "a.asc").write_text(head + rows)
    source = load(tmp_path / "a.asc", resolution_m=30.0)
    assert np.isnan(source.elevation_m[0]).all()
    assert is_water(source).mean() == pytest.approx((ground == 0).mean(), abs=0.03)


# --- what else must not be silently wrong -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "step"),
    [
        ("+proj=longlat +R=1737400 +no_defs", 0.01),
        ("+proj=stere +lat_0=-90 +lon_0=0 +R=3376200 +units=m +no_defs", 300.0),
        ("IAU_2015:30100", 0.01),
    ],
)
def test_other_planets_have_metres_of_their_own(tmp_path: Path, system: str, step: float) -> None:
    from rasterio.transform import from_origin

    path = written(tmp_path / "moon.tif", hills(1, 500), crs=system, transform=from_origin(0, 1, step, step))
    source = load(path)
    expected_m = step if step > 1 else step * np.pi / 180 * 1_737_400
    assert source.grid.resolution_m == pytest.approx(expected_m, rel=0.02)
    assert not np.isnan(source.elevation_m).any()


def test_a_local_system_in_metres_is_as_good_as_any(tmp_path: Path) -> None:
    source = load(written(tmp_path / "site.tif", hills(1, 50), crs='LOCAL_CS["site",UNIT["metre",1]]'))
    assert (source.grid.crs, source.grid.resolution_m) == ("local", 20.0)


def test_a_map_whose_metres_are_not_true_is_put_on_true_ones(tmp_path: Path) -> None:
    from rasterio.transform import from_origin

    place = from_origin(0, 6_700_000, 100, 100)  # latitude 60: a metre of the map to the east is half a true one
    system = "+proj=eqc +lat_ts=0 +lon_0=0 +datum=WGS84 +units=m"
    source = load(written(tmp_path / "a.tif", hills(1, 500), crs=system, transform=place))
    assert source.grid.cols * source.grid.resolution_m == pytest.approx(SIDE * 50, rel=0.03)


def test_pixels_that_are_square_but_for_a_rounding_are_not_resampled(tmp_path: Path) -> None:
    from rasterio.transform import Affine

    ground = hills(2, 500)
    place = Affine(20, 0, 500_000, 0, -20.00001, 5_000_000)
    source = load(written(tmp_path / "a.tif", ground, transform=place))
    np.testing.assert_array_equal(source.elevation_m, ground)


def test_heights_in_centimetres_and_what_a_map_in_feet_does_not_say(tmp_path: Path) -> None:
    import rasterio

    path = written(tmp_path / "cm.tif", hills(2, 500) * 100)
    with rasterio.open(path, "r+") as file:
        file.units = ("cm",)
    assert load(path).elevation_m.max() == pytest.approx(500, rel=1e-3)
    notes = load(written(tmp_path / "ft.tif", hills(2, 500), crs="EPSG:2264")).notes
    assert any("terrain.height_scale = 0.3048" in note for note in notes)


# --- kinds of files -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "driver", "dtype"),
    [
        ("a.img", "HFA", "float32"),
        ("a.bil", "EHdr", "int16"),
        ("a.flt", "EHdr", "float32"),
        ("a.anything", "GTiff", "float32"),
        ("without_ending", "GTiff", "int16"),
        ("a.nc", "netCDF", "float32"),
        ("a.sdat", "SAGA", "float32"),
    ],
)
def test_rasters_of_many_kinds_are_read(tmp_path: Path, name: str, driver: str, dtype: str) -> None:
    import rasterio
    from rasterio.shutil import copy

    plain = written(tmp_path / "plain.tif", np.round(hills(1, 500)), dtype)
    copy(plain, tmp_path / name, driver=driver)
    keys = {} if driver != "SAGA" else {"crs": "EPSG:32632"}
    source = load(tmp_path / name, **keys)
    np.testing.assert_allclose(source.elevation_m, load(plain).elevation_m)
    assert rasterio.open(tmp_path / name).shape == (SIDE, SIDE)


def test_a_raster_in_a_zip_is_read_and_a_bad_zip_is_refused_in_a_sentence(tmp_path: Path) -> None:
    import zipfile

    plain = written(tmp_path / "plain.tif", hills(1, 500))
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(plain, "inside/dem.tif")
        archive.writestr("readme.txt", "heights")
    np.testing.assert_array_equal(load(tmp_path / "a.zip").elevation_m, load(plain).elevation_m)
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        archive.write(plain, "a.tif")
        archive.write(plain, "b.tif")
    with pytest.raises(TerrainError, match="holds 2 rasters"):
        load(tmp_path / "two.zip")
    (tmp_path / "no.zip").write_bytes(b"PK no")
    with pytest.raises(TerrainError, match=r"damaged or no \.zip"):
        load(tmp_path / "no.zip")
    (tmp_path / "cut.zip").write_bytes((tmp_path / "a.zip").read_bytes()[:-40000])
    with pytest.raises(TerrainError, match=r"damaged or no \.zip"):
        load(tmp_path / "cut.zip")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(TerrainError, match="a file without ending is unknown"):
        load(tmp_path / "text")
