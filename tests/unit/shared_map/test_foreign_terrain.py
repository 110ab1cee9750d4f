"""Files of others: systems, units, kinds of rasters, images. Unknown input is reported."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine, from_origin
from support.height_models import SIDE, hills, is_water, load, written

from shared_map.array_files import Floats
from shared_map.terrain.pace_layers import TerrainClass


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


def test_a_map_whose_metres_are_not_true_is_put_on_true_ones(tmp_path: Path) -> None:
    place = from_origin(0, 6_700_000, 100, 100)  # latitude 60: a metre of the map to the east is half a true one
    system = "+proj=eqc +lat_ts=0 +lon_0=0 +datum=WGS84 +units=m"
    source = load(written(tmp_path / "a.tif", hills(1, 500), crs=system, transform=place))
    assert source.grid.cols * source.grid.resolution_m == pytest.approx(SIDE * 50, rel=0.03)


def test_pixels_that_are_square_but_for_a_rounding_are_not_resampled(tmp_path: Path) -> None:
    ground = hills(2, 500)
    place = Affine(20, 0, 500_000, 0, -20.00001, 5_000_000)
    source = load(written(tmp_path / "a.tif", ground, transform=place))
    np.testing.assert_array_equal(source.elevation_m, ground)


@pytest.mark.parametrize(
    ("unit", "metres"), [("cm", 0.01), ("[m]", 1), ("US_survey_foot", 1200 / 3937), ("ft (US)", 1200 / 3937)]
)
def test_units_are_known_however_they_are_written(tmp_path: Path, unit: str, metres: float) -> None:
    path = written(tmp_path / "a.tif", hills(2, 500) / metres)
    with rasterio.open(path, "r+") as file:
        file.units = (unit,)
    np.testing.assert_allclose(load(path).elevation_m, hills(2, 500), atol=1e-3)
    notes = load(written(tmp_path / "ft.tif", hills(2, 500), crs="EPSG:2264")).notes
    assert any("terrain.height_scale = 0.3048" in note for note in notes)


# --- photos that are none -----------------------------------------------------------------------------------


def photo_of(ground: Floats) -> Any:
    """A painted true-colour photo, uint8 (rows, cols, 3)."""
    from shared_map.terrain.synthetic import paint_photo

    return paint_photo(ground, np.full(ground.shape, TerrainClass.GRASS, np.uint8), 20.0, 1)


@pytest.mark.parametrize("kind", ["infrared", "legend"])
def test_nothing_is_read_from_an_image_that_is_no_true_colour_photo(tmp_path: Path, kind: str) -> None:
    ground = np.maximum(hills(13, 900) - 300, 0).astype(np.float32)
    true = photo_of(ground)
    red, green = true[..., 0].astype(float), true[..., 1].astype(float)
    infrared = np.stack([np.clip(green * 1.6, 0, 255), red * 0.7, red * 0.75], axis=-1)
    legend = np.array([(255, 255, 100), (0, 100, 0), (0, 100, 200)])[np.digitize(ground, [1, 200])]
    shown = {"infrared": infrared, "legend": legend}[kind].astype(np.uint8)
    terrain = written(tmp_path / "dem.tif", ground)
    for name, image in (("true", true), ("other", shown)):
        written(tmp_path / f"{name}.tif", np.moveaxis(image, -1, 0), "uint8")
    good = load(terrain, photo=str(tmp_path / "true.tif"))
    assert not any("the photo is" in note for note in good.notes)
    other = load(terrain, photo=str(tmp_path / "other.tif"))
    assert any("no classes are read from it" in note for note in other.notes)
    assert set(np.unique(other.classes)) <= {TerrainClass.UNKNOWN, TerrainClass.WATER}
    assert is_water(other).mean() == pytest.approx((ground == 0).mean(), abs=0.03)
