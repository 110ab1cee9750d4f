"""Rasters that would have ended in a traceback, at a web server, in a wait for ever, or as a lake that is none."""

from __future__ import annotations

import os
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from support.height_models import load, written

from shared_map.importers.level_ground import level_ground, undeclared_voids
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError

HEIGHTS = np.add.outer(np.arange(40) * 2.0, np.arange(40) * 1.0).astype(np.float32)
VRT = (
    '<VRTDataset rasterXSize="40" rasterYSize="40"><SRS>EPSG:32632</SRS>'
    "<GeoTransform>500000,30,0,5000000,0,-30</GeoTransform>"
    '<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="1">{}</SourceFilename>'
    "<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
)


def dem(path: Path, heights=HEIGHTS, crs="EPSG:32632", where=(500_000.0, 5_000_000.0)) -> Path:
    return written(path, heights, crs=crs, transform=from_origin(*where, 30, 30))


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_a_zip_with_damaged_bytes_is_refused_in_one_sentence(tmp_path: Path, method: int) -> None:
    path = tmp_path / "dem.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.write(dem(tmp_path / "dem.tif"), "dem.tif")
    whole = bytearray(path.read_bytes())
    whole[40:140] = bytes(7 * n % 256 for n in range(100))
    path.write_bytes(bytes(whole))
    with pytest.raises(TerrainError, match=r"dem\.zip") as refused:
        load(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["http://127.0.0.1:9/a.tif", "/vsicurl/a.tif", "pipe", "nowhere.tif"])
def test_a_vrt_names_ordinary_files_only(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "dem.vrt"
    path.write_text(VRT.format(name), encoding="utf-8")
    with pytest.raises(TerrainError, match="cannot read raster"):
        load(path)
    path.write_text(VRT.format(dem(tmp_path / "dem.tif").name), encoding="utf-8")
    assert np.array_equal(load(path).elevation_m, HEIGHTS)


def test_a_file_of_several_variables_is_refused_with_their_names(tmp_path: Path) -> None:
    from scipy.io import netcdf_file

    path = tmp_path / "dem.nc"
    with netcdf_file(path, "w") as file:
        for axis in ("y", "x"):
            file.createDimension(axis, 40)
        for name in ("height", "snow"):
            file.createVariable(name, "f4", ("y", "x"))[:] = HEIGHTS
    with pytest.raises(TerrainError, match=r"several rasters .*height.*snow"):
        load(path)


def test_a_slope_too_gentle_to_see_between_two_cells_is_no_lake() -> None:
    slope = np.add.outer(np.arange(200) * 0.002, np.arange(200) * 0.001).astype(np.float32)
    assert not level_ground(slope).mask.any()
    slope[60:100, 60:100] = slope.min() - 1
    assert np.count_nonzero(level_ground(slope).mask) == 1600


@pytest.mark.parametrize("code", [np.inf, -np.inf, -3.4e38])
def test_what_is_no_height_is_no_lake_and_no_warning(code: float) -> None:
    heights = HEIGHTS.copy()
    heights[5:20, 5:20] = code
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert level_ground(heights).patches == ()


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


def test_level_ground_of_a_large_plain_file_is_looked_for_in_some_of_its_cells(monkeypatch) -> None:
    from shared_map.importers import level_ground as module

    monkeypatch.setattr(module, "MOST_SAMPLED", 2000)
    heights = np.add.outer(np.arange(101) * 2.0, np.arange(83) * 1.0).astype(np.float32) + 50
    heights[20:60, 20:60] = 40
    _, level, _ = module.looked_at(heights, TerrainConfig(source="dem.asc"))
    assert level.shape == heights.shape
    assert (level != (heights == 40)).mean() < 0.03


def test_a_vrt_that_paints_the_same_pixels_many_times_is_refused(tmp_path: Path) -> None:
    dem(tmp_path / "dem.tif")
    head, _, rest = VRT.partition("<SimpleSource>")
    source = "<SimpleSource>" + rest[: rest.index("</VRTRasterBand>")].format("dem.tif")
    path = tmp_path / "dem.vrt"
    path.write_text(head + source * 30 + rest[rest.index("</VRTRasterBand>") :], encoding="utf-8")
    assert np.array_equal(load(path).elevation_m, HEIGHTS)
    other = tmp_path / "other.vrt"
    other.write_text(VRT.format("dem.vrt"), encoding="utf-8")
    assert np.array_equal(load(other).elevation_m, HEIGHTS)
    path.write_text(head + source * 40 + rest[rest.index("</VRTRasterBand>") :], encoding="utf-8")
    for file in (path, other):
        with pytest.raises(TerrainError, match="paints its pixels 40 times over"):
            load(file)


def test_a_vrt_that_names_itself_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "dem.vrt"
    path.write_text(VRT.format("dem.vrt"), encoding="utf-8")
    with pytest.raises(TerrainError, match="more than 4 deep"):
        load(path)


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


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("[m]", 1),
        ("US survey foot", 1200 / 3937),
        ("US_survey_foot", 1200 / 3937),
        ("ft (US)", 1200 / 3937),
        ("cm.", 0.01),
    ],
)
def test_units_are_known_however_they_are_dem(tmp_path: Path, unit: str, metres: float) -> None:
    path = dem(tmp_path / "dem.tif")
    with rasterio.open(path, "r+") as file:
        file.units = (unit,)
    raster = load(path)
    np.testing.assert_allclose(raster.elevation_m, HEIGHTS * metres, rtol=1e-6)
    assert not any("unknown" in note for note in raster.notes)


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
