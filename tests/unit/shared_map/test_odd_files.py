"""Files that other programs write in their own way: each is a true map, or refused by what it holds."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rasterio.enums import ColorInterp
from rasterio.shutil import copy
from rasterio.transform import Affine, from_origin
from support.height_models import SIDE, hills, is_water, load, written

from shared_map.array_files import Floats
from shared_map.importers.gdal_rasters import _HEADER_PAIR
from shared_map.importers.water_and_voids import level_ground
from shared_map.terrain.pace_layers import TerrainClass
from swarm.errors import TerrainError

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
GROUND = hills(3, 200)
PLACE = "20\n0\n0\n-20\n500010\n4999990\n"
"""A world file: that of `written`."""
SYSTEM = rasterio.CRS.from_epsg(32632).to_wkt()
COLOURS = np.dstack([GROUND + 30, GROUND * 0.8 + 40, 240 - GROUND]).astype(np.uint8)
HOLE = np.s_[40:60, 30:50]


def opaque() -> np.ndarray:
    """An alpha band: transparent in the hole."""
    alpha = np.full(GROUND.shape, 255, np.uint8)
    alpha[HOLE] = 0
    return alpha


def picture(path: Path, pixels: np.ndarray, **how: Any) -> Path:
    Image.fromarray(pixels).save(path, **how)
    for ending, text in ((f".{path.suffix[1]}{path.suffix[-1]}w", PLACE), (".prj", SYSTEM)):
        path.with_suffix(ending.upper() if path.suffix.isupper() else ending).write_text(text)
    return path


@pytest.mark.parametrize("ending", ["png", "jpg", "bmp", "PNG"])
def test_a_picture_lies_where_its_world_file_and_prj_say(tmp_path: Path, ending: str) -> None:
    dem = written(tmp_path / "dem.tif", GROUND)
    photo = load(dem, photo=str(picture(tmp_path / f"p.{ending}", COLOURS))).photo
    assert photo is not None
    assert np.abs(photo.astype(int) - COLOURS).mean() < (5 if ending == "jpg" else 0.1)
    heights = load(
        picture(tmp_path / ("h.PNG" if ending.isupper() else "h.png"), (GROUND * 10).astype(np.uint16)),
        height_scale=0.1,
    )
    assert heights.grid == load(dem).grid
    np.testing.assert_allclose(heights.elevation_m, GROUND, atol=0.1)


def test_a_picture_shows_nothing_where_it_is_transparent(tmp_path: Path) -> None:
    dem = written(tmp_path / "dem.tif", GROUND)
    for bands in (np.dstack([COLOURS, opaque()]), np.dstack([COLOURS[..., 1], opaque()])):
        source = load(dem, photo=str(picture(tmp_path / "p.png", bands)))
        assert not source.photo[HOLE].any()
        assert not source.classes[HOLE].any()


def with_alpha(path: Path, dtype: str, **profile: Any) -> Path:
    bands = np.stack([GROUND.astype(dtype), opaque().astype(dtype)])
    return written(path, bands, dtype, alpha="yes", **profile)


def lossy(path: Path) -> Path:
    copy(written(path.with_suffix(".tif"), GROUND, "int16"), path.with_suffix(".jp2"), driver="JP2OpenJPEG")
    return path.with_suffix(".jp2")


def said(path: Path, name: str, content: str | bytes) -> Path:
    (path.parent / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return path.parent / name


ASC = "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 5\nNODATA_value -9999\n1 2 3\n4 5 6\n"
REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "alpha of floats": (lambda p: with_alpha(p, "float32"), "has an alpha band of float32, expected bytes"),
    "alpha and a value": (lambda p: with_alpha(p, "uint8", nodata=0), r"a no-data value \(0\) and a mask or alpha"),
    "mask and a value": (
        lambda p: written(p, GROUND, nodata=-1.0, mask=opaque()), r"a no-data value \(-1\) and a mask",
    ),
    "lossy JPEG 2000": (lossy, "is compressed with loss, expected exact numbers"),
    "lossy LERC": (lambda p: written(p, GROUND, compress="lerc", MAX_Z_ERROR=1.0), "is compressed with loss"),
    "unknown unit": (
        lambda p: written(p, GROUND, units=("0.1 m",)), r"heights in '0\.1 m', an unknown unit; set terrain\.h",
    ),
    "colours": (lambda p: written(p, np.stack([GROUND] * 3), "uint8"), "gdal_calc.py unpacks heights from colours"),
    "no place": (
        lambda p: written(p, GROUND, transform=None), r"how large a cell is; set terrain\.resolution_m",
    ),
    "no corner": (
        lambda p: said(p, "a.asc", ASC.replace("xllcorner 0\nyllcorner 0\n", "")), "header needs xllcorner",
    ),
    "degrees and minutes": (
        lambda p: said(p, "a.asc", "north: 47:00:00N\nsouth: 46:59:59N\neast: 9:00:03E\nwest: 9:00:00E\nrows: 1\n"
                       "cols: 3\n1 2 3\n"),
        "its header says north '47:00:00N', expected a number",
    ),
    "a header alone": (lambda p: said(p, "a.csv", "x,y,z\n"), "its points have 0 different x"),
    "PCRaster": (lambda p: said(p, "a.map", b"RUU CROSS SYSTEM MAP FORMAT" + bytes(300)), "is a map of PCRaster;"),
    "UTF-16": (lambda p: said(p, "a.xyz", "1 2 3\n".encode("utf-16")), "is text in UTF-16; .* save it as UTF-8"),
    "grey levels with a place": (
        lambda p: picture(p.with_suffix(".png"), GROUND.astype(np.uint8)), "how high a grey level is; set terrain",
    ),
    "an image of a ROS map": (lambda p: said(p, "a.pgm", "P5\n2 2\n255\n1234"), r"name the \.yaml of the map"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_terrain_is_refused_by_what_it_holds(tmp_path: Path, name: str) -> None:
    make, words = REFUSED[name]
    with pytest.raises(TerrainError, match=words) as told:
        load(make(tmp_path / "a.tif"))
    assert "\n" not in str(told.value)


def test_a_setting_that_is_named_leads_to_a_load(tmp_path: Path) -> None:
    for unit, metres in (("0.1 m", 0.1), ("yards", 1.0), ("decimeters", None)):
        factor = {"yards": 0.9144, "decimeters": 0.1}.get(unit, 1.0) * (metres or 1.0)
        heights_m = load(written(tmp_path / "a.tif", GROUND, units=(unit,)), height_scale=metres).elevation_m
        np.testing.assert_allclose(heights_m, GROUND * factor, rtol=1e-5)
    source = load(written(tmp_path / "b.tif", GROUND, transform=None), resolution_m=5.0)
    np.testing.assert_array_equal(source.elevation_m, GROUND)
    assert (source.grid.crs, source.grid.resolution_m) == ("local", 5.0)
    assert any(note.startswith("! the file has a system, but no place in it") for note in source.notes)


@pytest.mark.parametrize("name", ["a.map", "a.yaml", "a.csv", "a.npz"])
def test_a_raster_of_any_name_is_known_by_its_beginning(tmp_path: Path, name: str) -> None:
    written(tmp_path / "a.tif", GROUND).rename(tmp_path / name)
    np.testing.assert_array_equal(load(tmp_path / name).elevation_m, GROUND)


@given(st.binary(max_size=12), st.sampled_from([b".", b" ", b"a", b"_", b":", b"\xff"]), st.integers(1, 5))
def test_a_word_of_a_header_has_one_reading(begin: bytes, middle: bytes, many: int) -> None:
    """Signs and letters follow each other, and no sign is a letter: a match has no two ways to try."""
    word = begin + middle * many
    is_word = re.fullmatch(rb"[\s\xef\xbb\xbf]*[A-Za-z_]+:?", word) and not re.search(
        rb"(^|[^A-Za-z_])(nan|inf|infinity):?$", word, re.IGNORECASE
    )
    assert bool(_HEADER_PAIR.fullmatch(word + b" 1")) == bool(is_word)


def test_a_row_that_begins_with_the_word_for_a_void_is_no_header(tmp_path: Path) -> None:
    head = "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 5\nNODATA_value "
    for void in ("null", "nan", "inf"):
        (tmp_path / "a.asc").write_text(f"{head}{void}\n{void} 2\n3 4\n")
        np.testing.assert_array_equal(load(tmp_path / "a.asc").elevation_m, [[np.nan, 2], [3, 4]])


def test_a_photo_that_cannot_be_meant_is_refused(tmp_path: Path) -> None:
    dem = written(tmp_path / "dem.tif", GROUND)
    bands = np.moveaxis(COLOURS, -1, 0).astype(np.int16) * 20
    bands[:, 40:60] = -9999
    turned = Image.Exif()
    turned[0x112] = 6
    Image.fromarray(COLOURS).save(tmp_path / "turned.jpg", exif=turned)
    for path, words in (
        (written(tmp_path / "void.tif", bands, "int16"), "holds -9999, no brightness: gdal_edit.py"),
        (tmp_path / "turned.jpg", "has EXIF orientation 6, expected 1"),
    ):
        with pytest.raises(TerrainError, match=words):
            load(dem, photo=str(path))
    shutil.copy(picture(tmp_path / "p.png", COLOURS), tmp_path / "bare.png")
    assert any("has no place of its own" in note for note in load(dem, photo=str(tmp_path / "bare.png")).notes)
    order = ColorInterp.blue, ColorInterp.green, ColorInterp.red
    backwards = written(tmp_path / "bgr.tif", bands.clip(0, 255), "uint8", colorinterp=order)
    photo = load(dem, photo=str(backwards)).photo
    np.testing.assert_array_equal(photo, np.moveaxis(bands.clip(0, 255)[::-1], 0, -1))


@pytest.mark.parametrize("side", [40, 60, 120])
def test_no_level_patch_of_a_small_file_becomes_ground_in_silence(side: int) -> None:
    heights_m = hills(5, 90)[:side, :side].round().astype(np.float32)
    found = level_ground(heights_m)
    assert found.mask.any() or found.uncertain > 0.001


# --- systems, units and images of others ----------------------------------------------------------------------


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
    path = written(tmp_path / "a.tif", hills(2, 500) / metres, units=(unit,))
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
