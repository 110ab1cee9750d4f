"""A grid comes in as it was written: every format, every cell size, every door."""

import os
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.control import GroundControlPoint
from rasterio.shutil import copy
from rasterio.transform import from_origin
from support.effort import few
from support.height_models import load, written
from support.zone_shapes import painted

from shared_map.importers.zones.zone_files import burn_zone
from swarm.config.ground import ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
UTM = "EPSG:32632"
WEST, NORTH = 500_000.0, 5_200_000.0
HEIGHTS = (300 + 8 * np.sin(np.arange(12) / 3)[:, None] + np.cos(np.arange(15) / 2)).astype(np.float32)
ROWS, COLS = HEIGHTS.shape


def rows_of(heights: np.ndarray) -> str:
    return "\n".join(" ".join(f"{height:.4f}" for height in row) for row in heights) + "\n"


def write_raster(path: Path, side_m: float, **profile: object) -> None:
    place = {"crs": UTM, "transform": from_origin(WEST, NORTH, side_m, side_m), **profile}
    written(path, HEIGHTS, **place)


def write_netcdf(path: Path, side_m: float, kind: str) -> None:
    write_raster(path.with_suffix(".tif"), side_m)
    copy(path.with_suffix(".tif"), path, driver="netCDF", FORMAT=kind)


def write_esri(path: Path, side_m: float) -> None:
    south = NORTH - ROWS * side_m
    head = f"ncols {COLS}\nnrows {ROWS}\nxllcorner {WEST!r}\nyllcorner {south!r}\ncellsize {side_m!r}\n"
    path.write_text(head + rows_of(HEIGHTS))


def write_grass(path: Path, side_m: float) -> None:
    edges = f"north: {NORTH!r}\nsouth: {NORTH - ROWS * side_m!r}\neast: {WEST + COLS * side_m!r}\nwest: {WEST!r}\n"
    path.write_text(f"{edges}rows: {ROWS}\ncols: {COLS}\n" + rows_of(HEIGHTS))


def write_surfer(path: Path, side_m: float) -> None:
    """Surfer states the middles of the outermost cells, and its rows begin in the south."""
    x, y = WEST + side_m / 2, NORTH - (ROWS - 0.5) * side_m
    edges = f"{x!r} {x + (COLS - 1) * side_m!r}\n{y!r} {y + (ROWS - 1) * side_m!r}\n"
    path.write_text(f"DSAA\n{COLS} {ROWS}\n{edges}0 999\n" + rows_of(HEIGHTS[::-1]))


def write_points(path: Path, side_m: float) -> None:
    xs, ys = WEST + (np.arange(COLS) + 0.5) * side_m, NORTH - (np.arange(ROWS) + 0.5) * side_m
    y, x = np.meshgrid(ys, xs, indexing="ij")
    lines = [
        "{!r} {!r} {:.4f}".format(*point) for point in np.stack([x, y, HEIGHTS], axis=-1).reshape(-1, 3).tolist()
    ]
    path.write_text("\n".join(lines) + "\n")


WRITERS: dict[str, Callable[[Path, float], None]] = {
    "tif": lambda path, side_m: write_raster(path, side_m),
    "img": lambda path, side_m: write_raster(path, side_m, driver="HFA"),
    "bil": lambda path, side_m: write_raster(path, side_m, driver="EHdr"),
    "dat": lambda path, side_m: write_raster(path, side_m, driver="ENVI"),
    "raw": lambda path, side_m: write_raster(path, side_m, driver="ENVI", SUFFIX="ADD"),
    "nc": lambda path, side_m: write_netcdf(path, side_m, "NC"),
    "4.nc": lambda path, side_m: write_netcdf(path, side_m, "NC4"),
    "anything": lambda path, side_m: write_raster(path, side_m, driver="GTiff"),
    "asc": write_esri,
    "grass.asc": write_grass,
    "grd": write_surfer,
    "xyz": write_points,
    "npz": lambda path, side_m: np.savez(path, elevation=HEIGHTS, resolution_m=side_m),
}


@pytest.mark.parametrize("ending", WRITERS)
@settings(max_examples=few(8))
@given(side_m=st.floats(0.02, 2000).filter(lambda side: side % 1))
def test_any_importer_keeps_a_square_metric_grid(ending, side_m, tmp_path_factory):
    path = tmp_path_factory.mktemp("kept") / f"dem.{ending}"
    WRITERS[ending](path, side_m)
    known = ("tif", "img", "bil", "dat", "raw", "nc", "4.nc", "anything", "npz")
    source = load(path, crs=None if ending in known else UTM)
    assert source.grid.shape == HEIGHTS.shape
    assert source.grid.resolution_m == pytest.approx(side_m, rel=1e-6)
    np.testing.assert_allclose(source.elevation_m, HEIGHTS, rtol=0, atol=1e-4)
    if ending != "npz":
        assert source.grid.west_m == pytest.approx(WEST, abs=side_m / 100)
        assert source.grid.north_m == pytest.approx(NORTH, abs=side_m / 100)


@pytest.mark.parametrize("ending", [each for each in WRITERS if each != "npz"])
def test_a_zone_of_factors_is_read_by_any_importer(tmp_path: Path, ending: str) -> None:
    WRITERS[ending](tmp_path / f"pace.{ending}", 10.0)
    zone = ZoneConfig(kind="factor", file=str(tmp_path / f"pace.{ending}"), crs=UTM)
    pace, _ = painted([zone], GridSpec(ROWS, COLS, 10.0, WEST, NORTH, UTM))
    np.testing.assert_allclose(pace, HEIGHTS / 10, rtol=0, atol=1e-4)


HEAD = "ncols 3\nnrows 2\nxllcorner 1000\nyllcorner 2000\ncellsize 50\n"


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "NODATA_value null\n1.5 2 null\n4 5 6\n",
        HEAD + "NODATA_value -9999\n1.5 2 -9999 4\n5\n6\n",
        HEAD + "nodata_value nan\n1.5 2 nan 4 5 6",
        HEAD.upper() + "NODATA_VALUE -1\r\n1.5 2 -1\r\n4 5 6\r\n",
        HEAD.replace("cellsize 50", "dx 50\ndy 50") + "NODATA_value -9999\n1.5 2 -9999\n4 5 6\n",
        HEAD.replace("corner 1000", "center 1025").replace("corner 2000", "center 2025") + "1,5 2 -9999 4 5 6",
        HEAD.replace("\n", "\r") + "NODATA_value -9999\r1.5 2 -9999\r4 5 6\r",
        HEAD.replace("\n", " ") + "\n1.5 2 nan 4 5 6",
        HEAD.replace("000\n", "000,000\n") + "1,5 2 nan 4 5 6",
        "\ufeff" + HEAD + "NODATA_value -9999\n1.5 2 -9999\n4 5 6\n",
        "north: 2100\nsouth: 2000\neast: 1150\nwest: 1000\nrows: 2\ncols: 3\nnull: *\n1.5 2 *\n4 5 6\n",
    ],
)  # fmt: skip
def test_a_grid_as_text_is_read_in_all_its_versions(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.asc").write_bytes(text.encode())
    (tmp_path / "a.prj").write_text(rasterio.CRS.from_string(UTM).to_wkt())
    source = load(tmp_path / "a.asc")
    assert source.grid.crs == UTM
    np.testing.assert_array_equal(source.elevation_m, np.array([[1.5, 2, np.nan], [4, 5, 6]], np.float32))
    assert (source.grid.resolution_m, source.grid.west_m, source.grid.north_m) == (50, 1000, 2100)


def test_a_line_of_tabs_longer_than_a_piece_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared_map.importers.gdal_rasters._TEXT_PIECE_BYTES", 16)
    (tmp_path / "a.asc").write_text(HEAD + "\t".join(["1.25"] * 5 + ["123456789.5"]))
    assert load(tmp_path / "a.asc").elevation_m[0].tolist() == [1.25] * 3


@pytest.mark.parametrize("side", [1.0, 1 / 3600])
def test_a_setting_that_a_refusal_names_leads_to_the_same_map(tmp_path: Path, side: float) -> None:
    crs = UTM if side == 1.0 else "EPSG:4326"
    place = from_origin(9.0, 47.0, side, side)
    write_raster(tmp_path / "said.tif", side, crs=crs, transform=place)
    write_raster(tmp_path / "unsaid.tif", side, crs=None, transform=place)
    with pytest.raises(TerrainError, match=r"terrain\.crs"):
        load(tmp_path / "unsaid.tif")
    for resolution_m in (None, 40.0 * side * 3600 if side < 1 else 2.5):
        said = load(tmp_path / "said.tif", resolution_m=resolution_m)
        unsaid = load(tmp_path / "unsaid.tif", crs=crs, resolution_m=resolution_m)
        assert said.grid == unsaid.grid
        np.testing.assert_array_equal(said.elevation_m, unsaid.elevation_m)


def test_control_points_place_a_raster(tmp_path: Path) -> None:
    corners = [(0, 0), (0, COLS), (ROWS, 0), (ROWS, COLS)]
    points = [GroundControlPoint(r, c, WEST + 10 * c, NORTH - 10 * r) for r, c in corners]
    gcps = points, rasterio.CRS.from_string(UTM)
    write_raster(tmp_path / "a.tif", 10.0, transform=None, crs=None, gcps=gcps)
    source = load(tmp_path / "a.tif")
    assert source.grid.crs == UTM
    assert abs(source.grid.west_m - WEST) < 10
    assert abs(source.grid.rows - ROWS) <= 1
    assert float(np.nanmean(source.elevation_m)) == pytest.approx(float(HEIGHTS.mean()), abs=0.5)


@pytest.mark.parametrize("ending", ["tif", "asc", "npz", "xyz", "yaml", "geojson", "tif.aux.xml"])
def test_a_pipe_is_refused_at_once(tmp_path: Path, ending: str) -> None:
    if ending == "tif.aux.xml":  # GDAL opens what lies beside a file, too
        write_raster(tmp_path / "dem.tif", 10.0)
    os.mkfifo(tmp_path / f"dem.{ending}")
    with pytest.raises(TerrainError, match="it is a device or pipe, not a file"):
        load(tmp_path / f"dem.{ending.removesuffix('.aux.xml')}")


def test_depths_are_turned_into_heights(tmp_path: Path) -> None:
    write_raster(tmp_path / "a.tif", 10.0, crs="EPSG:32632+5715")
    write_raster(tmp_path / "b.tif", 10.0, band_tags={"positive": "down"})
    copy(tmp_path / "b.tif", tmp_path / "b.nc", driver="netCDF")
    for name in ("a.tif", "b.nc"):
        source = load(tmp_path / name)
        np.testing.assert_array_equal(source.elevation_m, -HEIGHTS)
        assert "the file states depths; heights are their negatives" in source.notes


REAL = ["uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float32", "float64"]
COMPLEX = ["complex_int16", "complex64", "complex128"]
NOTHING = "no heights at all|shows nothing of the terrain|none of its codes|no value on the|holds -inf"
ODD: dict[str, tuple[dict[str, Any], str]] = {
    **{kind: ({"dtype": kind}, "") for kind in REAL},
    **{kind: ({"dtype": kind}, rf"holds complex numbers \({kind}\), expected real ones") for kind in COMPLEX},
    "other format": ({"driver": "PCIDSK"}, "gdal_translate FILE out.tif` converts most rasters"),
    "cells of no size": ({"transform": rasterio.Affine(np.nan, 0, WEST, 0, -10, NORTH)}, "pixels without a size"),
    **{f"scale {given}": ({"scales": (given,)}, rf"has scales \({given},\)") for given in (0.0, np.nan, np.inf)},
    **{f"half {value}": ({"dtype": "float64", "filled": value}, "") for value in (np.nan, np.inf, 1e300)},
    **{f"all {value}": ({"dtype": "float64", "filled": value}, NOTHING) for value in (np.nan, -np.inf)},
}
"""Raster of one band -> what its refusal says at every door; empty if it is read."""


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("door", ["source", "photo", "cover", "friction"])
def test_numbers_of_every_kind_are_read_or_refused_at_every_door(tmp_path: Path, name: str, door: str) -> None:
    made, words = ODD[name]
    place = {"crs": UTM, "transform": from_origin(WEST, NORTH, 10, 10)}
    made = {"dtype": "int16", "scales": (1.0,), "filled": 1.0, **place, **made}
    numbers = np.arange(ROWS * COLS, dtype=np.float64).reshape(ROWS, COLS) % 90 + 1
    numbers[:, : COLS // (1 if name.startswith("all") else 2)] = made.pop("filled")
    scales, file, dem = made.pop("scales"), tmp_path / "other.tif", tmp_path / "dem.tif"
    write_raster(dem, 10.0)
    with rasterio.open(file, "w", height=ROWS, width=COLS, count=1, **made) as dataset:
        dataset.write(numbers.astype("complex64" if name in COMPLEX else made["dtype"]), 1)
        dataset.scales = scales
    settings = {"photo": {}, "source": {}, "cover": {"cover_codes": str(tmp_path / "codes.csv")}}
    (tmp_path / "codes.csv").write_text("code,class\n" + "".join(f"{code},grass\n" for code in range(1, 91)))
    with pytest.raises(TerrainError, match=words) if words else nullcontext():
        if door == "friction":
            burn_zone(ZoneConfig(kind="factor", file=str(file)), load(dem).grid, "zone")
        else:
            files = {"source": str(dem), door: str(file), **settings[door]}
            assert load(**files).grid.shape == HEIGHTS.shape


def test_colours_are_looked_up_in_a_palette_of_any_length(tmp_path: Path) -> None:
    write_raster(tmp_path / "dem.tif", 10.0)
    place = {"crs": UTM, "transform": from_origin(WEST, NORTH, 10, 10)}
    colours = {300: (90, 80, 70, 255)}
    file = written(tmp_path / "a.tif", np.full(HEIGHTS.shape, 300), "uint16", colours=colours, **place)
    np.testing.assert_array_equal(load(tmp_path / "dem.tif", photo=str(file)).photo[..., 1], 80)


@pytest.mark.parametrize("ending", ["pgm", "png", "bmp"])
@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
def test_the_image_of_a_ros_map_is_of_any_kind_that_map_server_reads(tmp_path, ending, mode):
    from PIL import Image

    pixels = np.array([[254, 0, 254], [254, 254, 205]], np.uint8)
    Image.fromarray(pixels).convert("RGB" if (mode, ending) == ("RGBA", "pgm") else mode).save(
        tmp_path / f"m.{ending}", format="ppm" if ending == "pgm" else None
    )
    for text in ("origin: [0, 0, 0]\nnegate: 0", "origin:\n- 0.0\n- 0.0\n- 0\nnegate: false", "{Y}"):
        values = f"image: m.{ending}, resolution: 0.5, origin: [0, 0, 0], occupied_thresh: 0.65, free_thresh: 0.196"
        flow = f"{{{values}}}"
        block = f"image: m.{ending}\nresolution: 0.5\noccupied_thresh: 0.65\nfree_thresh: 0.196\n{text}\n"
        (tmp_path / "m.yaml").write_text(flow if text == "{Y}" else block)
        factor = load(tmp_path / "m.yaml").factor
        np.testing.assert_array_equal(factor, [[1, np.inf, 1], [1, 1, np.inf]])
