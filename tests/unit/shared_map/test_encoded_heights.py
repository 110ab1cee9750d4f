"""Terrain-RGB and Terrarium tiles give the heights that were stored, and colours are never interpolated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from support.height_models import SIDE, hills, load, written

from shared_map.importers.rasters import ENCODINGS, contents_of, decoded, is_plausible
from shared_map.terrain.layers import TerrainClass
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError

STEP_M = {"terrain-rgb": 0.1, "terrarium": 1 / 256}
PLACE = {"crs": "EPSG:32632", "transform": from_origin(500_000, 5_000_000, 20, 20)}


def encoded(heights: Any, encoding: str) -> Any:
    """uint8 (3, rows, cols); NaN is black."""
    filled = np.nan_to_num(heights.astype(np.float64))
    number = (filled + 10_000) * 10 if encoding == "terrain-rgb" else (filled + 32_768) * 256
    number = np.where(np.isnan(heights), 0, np.rint(number)).astype(np.int64)
    return np.stack([number >> 16, number >> 8 & 255, number & 255]).astype(np.uint8)


def tile(path: Path, image: Any, driver: str = "GTiff", crs: Any = None, transform: Any = None, **how: Any) -> Path:
    return written(path, image, None, driver=driver, crs=crs, transform=transform, **how)


def test_the_published_examples() -> None:
    assert decoded(np.array([[[1]], [[134]], [[160]]], np.uint8), "terrain-rgb")[0, 0] == 0.0
    assert decoded(np.array([[[128]], [[0]], [[0]]], np.uint8), "terrarium")[0, 0] == 0.0
    assert decoded(np.array([[[162]], [[144]], [[200]]], np.uint8), "terrarium")[0, 0] == 8848.78125


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_height_of_the_earth_survives_to_the_last_step(encoding: str) -> None:
    steps = np.arange(-9999, 9000, 0.37)[None, :]
    found = decoded(encoded(steps, encoding), encoding)
    assert np.abs(found - steps).max() <= STEP_M[encoding] / 2 + 1e-3


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("name", "driver"), [("a.tif", "GTiff"), ("a.png", "PNG"), ("a.webp", "WEBP")])
def test_a_tile_gives_what_the_plain_heights_give(tmp_path: Path, encoding: str, name: str, driver: str) -> None:
    ground = np.round(hills(1, 900) - 150, 1)
    ground[ground < 0] = 0
    ground[100:104, 50:60] = np.nan
    known = ~np.isnan(ground)
    profile: dict[str, Any] = {"LOSSLESS": "YES"} if driver == "WEBP" else {}
    keys: dict[str, Any] = {"resolution_m": 20.0}
    if driver == "GTiff":
        profile, keys = PLACE, {}
    found = load(tile(tmp_path / name, encoded(ground, encoding), driver, **profile), **keys)
    plain = load(written(tmp_path / "plain.tif", ground), **keys)
    np.testing.assert_array_equal(np.isnan(found.elevation_m), ~known)
    assert np.abs(found.elevation_m - plain.elevation_m)[known].max() <= STEP_M[encoding] / 2 + 1e-4
    np.testing.assert_array_equal(found.classes == TerrainClass.WATER, plain.classes == TerrainClass.WATER)
    assert (found.classes == TerrainClass.WATER).any()
    title = {"terrain-rgb": "Terrain-RGB", "terrarium": "Terrarium"}[encoding]
    assert any(f"heights are stored as colours, {title}, as only so" in note for note in found.notes)
    assert any("0.1% of the image is black or transparent: no height" in note for note in found.notes)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("keys", [{}, {"resolution_m": 31.0}, {"resolution_m": 90.0}])
def test_warping_happens_to_heights_and_not_to_colours(tmp_path: Path, encoding: str, keys: dict[str, Any]) -> None:
    ground = hills(2, 4000) - 500
    place = {"crs": "EPSG:4326", "transform": from_origin(9, 46, 0.0002, 0.0002)} if not keys else PLACE
    plain = load(written(tmp_path / "plain.tif", ground, **place), **keys)
    found = load(tile(tmp_path / "a.tif", encoded(ground, encoding), **place), **keys)
    assert found.grid == plain.grid
    assert np.nanmax(np.abs(found.elevation_m - plain.elevation_m)) <= STEP_M[encoding] / 2 + 2e-3


def test_a_tile_of_the_web_lies_where_its_path_says(tmp_path: Path) -> None:
    import rasterio.warp

    zoom, col, row = 12, 2170, 1434
    folder = tmp_path / str(zoom) / str(col)
    folder.mkdir(parents=True)
    ground = hills(1, 900) + 600
    source = load(tile(folder / f"{row}.png", encoded(ground, "terrarium"), "PNG"))
    (lon,), (lat,) = rasterio.warp.transform(
        source.grid.crs,
        "EPSG:4326",
        [source.grid.west_m + source.grid.cols * source.grid.resolution_m / 2],
        [source.grid.north_m - source.grid.rows * source.grid.resolution_m / 2],
    )
    # From the formula of slippy maps.
    n = 2**zoom
    assert (lon + 180) / 360 * n == pytest.approx(col + 0.5, abs=0.01)
    assert (1 - np.arcsinh(np.tan(np.radians(lat))) / np.pi) / 2 * n == pytest.approx(row + 0.5, abs=0.01)
    assert any("tile x 2170, y 1434 (from the north) of zoom 12" in note for note in source.notes)
    assert np.nanmax(source.elevation_m) == pytest.approx(1500, abs=5)


def test_transparent_cells_are_voids(tmp_path: Path) -> None:
    ground = hills(1, 900)
    alpha = np.full((1, SIDE, SIDE), 255, np.uint8)
    alpha[:, :20] = 0
    image = np.concatenate([encoded(ground, "terrarium"), alpha])
    found = load(tile(tmp_path / "a.png", image, "PNG"), resolution_m=20.0)
    assert np.isnan(found.elevation_m[:20]).all()
    assert not np.isnan(found.elevation_m[20:]).any()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_only_the_right_encoding_is_plausible(encoding: str) -> None:
    shown = np.ones((SIDE, SIDE), np.bool_)
    for low_m, relief_m in ((0, 40), (-400, 900), (2900, 500), (-9000, 17_000)):
        image = encoded(hills(3, relief_m) + low_m, encoding)
        assert [each for each in ENCODINGS if is_plausible(image, shown, each)] == [encoding]


def test_a_photo_is_no_height_model_in_any_encoding(tmp_path: Path) -> None:
    from shared_map.terrain.synthetic.landscape import paint_photo

    photo = paint_photo(hills(1, 300), np.full((SIDE, SIDE), TerrainClass.GRASS, np.uint8), 20.0, 1)
    noise = np.random.default_rng(1).integers(0, 256, photo.shape)
    shown = np.ones((SIDE, SIDE), np.bool_)
    for image in (photo, noise, noise // 100, noise // 8 + 110, np.full_like(photo, 128)):
        bands = np.moveaxis(image, -1, 0).astype(np.uint8)
        assert not any(is_plausible(bands, shown, encoding) for encoding in ENCODINGS)
    path = tile(tmp_path / "photo.tif", np.moveaxis(photo, -1, 0), **PLACE)
    with pytest.raises(
        TerrainError, match=r"a photo\? Name it in terrain\.photo; .* 'terrain-rgb' or .* 'terrarium'"
    ):
        load(path)


def test_the_setting_wins_and_what_it_cannot_mean_is_refused(tmp_path: Path) -> None:
    image = encoded(hills(1, 300), "terrarium")
    path = tile(tmp_path / "a.tif", image, **PLACE)
    with rasterio.open(path) as dataset:
        given = contents_of(dataset, "a", TerrainConfig(elevation_encoding="terrain-rgb"))
    assert given.encoding == "terrain-rgb"
    assert "terrain.elevation_encoding = 'terrain-rgb' says" in given.how
    with pytest.raises(TerrainError, match="has 3 bands"):
        load(path, elevation_encoding="metres")
    grey = written(tmp_path / "grey.tif", hills(1, 300))
    with pytest.raises(TerrainError, match="has 1 bands of float32; Terrarium has three of uint8"):
        load(grey, elevation_encoding="terrarium")
    png = tile(tmp_path / "a.png", image, "PNG")
    with pytest.raises(TerrainError, match=r"does not say how large a cell is; set terrain\.resolution_m"):
        load(png)
    black = tile(tmp_path / "black.tif", np.zeros((3, 40, 40), np.uint8), **PLACE)
    with pytest.raises(TerrainError, match="no heights at all"):
        load(black, elevation_encoding="terrarium")


@pytest.mark.parametrize(("name", "driver"), [("a.jpg", "JPEG"), ("a.webp", "WEBP")])
def test_what_was_compressed_with_loss_is_refused(tmp_path: Path, name: str, driver: str) -> None:
    path = tile(tmp_path / name, encoded(hills(1, 300), "terrarium"), driver)
    with pytest.raises(TerrainError, match="compressed with loss, which spoils heights stored as colours"):
        load(path, elevation_encoding="terrarium", resolution_m=20.0)
