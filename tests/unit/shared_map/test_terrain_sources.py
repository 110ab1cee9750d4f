"""Every kind of file is read onto one metric grid; each fault of a file is one sentence."""

import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine, from_origin
from scipy.io import netcdf_file
from support.height_models import load, said, written

from shared_map.importers.cover.photos import read_photo
from shared_map.importers.georeference import check_size, metres_per_degree
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.terrain import build_terrain
from shared_map.terrain.terrain_report import doubts_about, facts_of
from swarm.config.ground import TerrainConfig
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError

DATA = Path(__file__).parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is absent")
UTM = from_origin(500_000, 5_200_000, 20, 20)


def heights(rows: int = 40, cols: int = 50) -> np.ndarray:
    row, col = np.mgrid[:rows, :cols]
    return (500 + 3.0 * row + 2.0 * col + 10 * np.sin(row / 5.0) * np.cos(col / 7.0)).astype(np.float32)


def write(path: Path, bands: np.ndarray, transform: Affine = UTM, crs: Any = "EPSG:32632", **profile: Any) -> Path:
    return written(path, bands, None, transform=transform, crs=crs, **profile)


# --- GeoTIFF ------------------------------------------------------------------------------------------------


def test_degrees_are_put_on_square_metres(tmp_path: Path) -> None:
    row, _ = np.mgrid[:60, :80]
    plane = (1000 + row * 5.0).astype(np.float32)
    source = load(write(tmp_path / "a.tif", plane, from_origin(9.5, 46.9, 0.001, 0.001), "EPSG:4326"))
    per_lat, per_lon = metres_per_degree(46.87)
    assert source.grid.resolution_m == pytest.approx(0.001 * np.sqrt(per_lat * per_lon), rel=2e-3)
    assert source.grid.rows * source.grid.resolution_m == pytest.approx(0.06 * per_lat, rel=0.02)
    assert source.grid.cols * source.grid.resolution_m == pytest.approx(0.08 * per_lon, rel=0.02)
    assert not np.isnan(source.elevation_m).any()
    per_cell = np.diff(source.elevation_m[5:-5, 10])
    np.testing.assert_allclose(per_cell, 5.0 * source.grid.resolution_m / (0.001 * per_lat), rtol=5e-3)


@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:2263"])
def test_systems_whose_unit_is_no_true_metre_are_reprojected(tmp_path: Path, crs: str) -> None:
    corner = (980_000, 200_000) if crs == "EPSG:2263" else (1_000_000, 5_900_000)
    source = load(write(tmp_path / "a.tif", heights(), from_origin(*corner, 100, 100), crs))
    true_m = 30.48 if crs == "EPSG:2263" else 100 * np.cos(np.radians(46.7))
    assert source.grid.resolution_m == pytest.approx(true_m, rel=0.01)


def test_a_rotated_file_is_turned_north_up_and_says_so(tmp_path: Path) -> None:
    turned = Affine(20 * np.cos(0.5), 20 * np.sin(0.5), UTM.c, 20 * np.sin(0.5), -20 * np.cos(0.5), UTM.f)
    source = load(write(tmp_path / "a.tif", heights(), turned))
    assert said(source.notes, "rotated")
    assert said(source.notes, "voids")
    known = source.elevation_m[~np.isnan(source.elevation_m)]
    assert 0.5 < known.size / source.elevation_m.size < 0.95
    assert heights().min() - 1 <= known.min()
    assert known.max() <= heights().max() + 1


def test_local_metres_need_no_system(tmp_path: Path) -> None:
    terrain = load(crs="local", **dem(tmp_path, crs=None))
    assert (terrain.grid.crs, terrain.grid.resolution_m) == ("local", 20.0)


def test_a_coarser_resolution_averages(tmp_path: Path) -> None:
    source = load(write(tmp_path / "a.tif", heights()), resolution_m=40.0)
    assert (source.grid.rows, source.grid.cols) == (20, 25)
    np.testing.assert_allclose(source.elevation_m, heights().reshape(20, 2, 25, 2).mean(axis=(1, 3)), atol=0.01)


def test_scale_and_offset_are_applied_and_said(tmp_path: Path) -> None:
    raw = np.round(heights() * 10).astype(np.int16) - 3000
    source = load(write(tmp_path / "a.tif", raw, scales=(0.1,), offsets=(300.0,)))
    np.testing.assert_allclose(source.elevation_m, heights(), atol=0.06)
    assert said(source.notes, "scale 0.1 and offset 300")


@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_voids_nan_and_infinite_cells_are_voids_counted_and_said(tmp_path: Path, dtype: str) -> None:
    values = heights().astype(dtype)
    values[5:10] = -9999
    if dtype == "float32":
        values[20, 20], values[20, 22], values[20, 24] = np.nan, np.inf, -3.4e38
    source = load(write(tmp_path / "a.tif", values, nodata=-9999))
    count = 253 if dtype == "float32" else 250
    assert np.isnan(source.elevation_m).sum() == count
    assert said(source.notes, "of the cells) are lethal; crop the file, or set terrain.nodata = 'fill'")
    assert not np.isnan(load(tmp_path / "a.tif", nodata="fill").elevation_m).any()
    terrain = build_terrain(Scenario(terrain=TerrainConfig(source=str(tmp_path / "a.tif"))))
    assert (np.isinf(terrain.pace_s_per_m) == np.isnan(source.elevation_m)).all()


def test_a_photo_on_another_grid_is_brought_onto_the_elevations(tmp_path: Path) -> None:
    photo = np.zeros((3, 100, 100), np.uint8)
    photo[1] = 120
    photo[:, :, 50:] = [[[200]], [[60]], [[40]]]
    write(tmp_path / "dem.tif", heights(), UTM)
    west = UTM.c + 20 * 25 - 10 * 50
    write(tmp_path / "photo.tif", photo, from_origin(west, UTM.f, 10, 10))
    source = load(tmp_path / "dem.tif", photo=str(tmp_path / "photo.tif"))
    assert source.photo.shape == (40, 50, 3)
    assert (source.photo[:, :24] == (0, 120, 0)).all()
    assert (source.photo[:, 26:] == (200, 60, 40)).all()


def test_a_photo_of_another_projection_and_depth_with_alpha(tmp_path: Path) -> None:
    write(tmp_path / "dem.tif", heights(), UTM)
    bounds = rasterio.warp.transform_bounds("EPSG:32632", "EPSG:4326", 500_000, 5_199_200, 501_000, 5_200_000)
    where = rasterio.transform.from_bounds(*bounds, 120, 100)
    photo = np.random.default_rng(1).integers(200, 4000, (4, 100, 120)).astype(np.uint16)
    photo[3] = 65535
    photo[3, :, :60] = 0
    write(tmp_path / "photo.tif", photo, where, "EPSG:4326", photometric="rgb", alpha="yes")
    source = load(tmp_path / "dem.tif", photo=str(tmp_path / "photo.tif"))
    seen = read_photo(tmp_path / "photo.tif", source.grid, None).seen
    assert not seen[:, :23].any()
    assert seen[2:-2, 27:-1].all()
    assert (source.classes[~seen] == TerrainClass.UNKNOWN).all()
    assert said(source.notes, "stretched")


# --- bad rasters --------------------------------------------------------------------------------------------


def dem(folder: Path, bands: np.ndarray | None = None, *place: Any, **profile: Any) -> dict[str, Any]:
    return {"source": write(folder / "a.tif", heights() if bands is None else bands, *place, **profile)}


def with_photo(folder: Path, bands: np.ndarray, *place: Any, **profile: Any) -> dict[str, Any]:
    return dem(folder) | {"photo": str(write(folder / "p.tif", bands, *place, **profile))}


def text(folder: Path, name: str) -> dict[str, Any]:
    (folder / name).write_text("this is a letter, not a map")
    return {"source": folder / name}


def cut(folder: Path, bands: np.ndarray, **profile: Any) -> dict[str, Any]:
    made = dem(folder, bands, **profile)
    made["source"].write_bytes(made["source"].read_bytes()[:200_000])
    return made


def vrt(folder: Path, source: str, times: int = 1, name: str = "a.vrt") -> dict[str, Any]:
    """A raster which another file paints, several times over."""
    painted = f'<SimpleSource><SourceFilename relativeToVRT="1">{source}</SourceFilename></SimpleSource>' * times
    place = "<SRS>EPSG:32632</SRS><GeoTransform>500000,20,0,5200000,0,-20</GeoTransform>"
    band = f'<VRTRasterBand dataType="Float32" band="1">{painted}</VRTRasterBand>'
    head = '<VRTDataset rasterXSize="50" rasterYSize="40">'
    (folder / name).write_text(f"{head}{place}{band}</VRTDataset>")
    return {"source": folder / name}


def fifo(folder: Path) -> str:
    os.mkfifo(folder / "pipe")
    return "pipe"


def packed(folder: Path, *names: str, method: int = zipfile.ZIP_DEFLATED) -> dict[str, Any]:
    with zipfile.ZipFile(folder / "a.zip", "w", method) as archive:
        for name in names:
            archive.write(dem(folder)["source"], name)
    return {"source": folder / "a.zip"}


def spoilt(made: dict[str, Any]) -> dict[str, Any]:
    content = bytearray(made["source"].read_bytes())
    content[40:140] = bytes(7 * n % 256 for n in range(100))
    made["source"].write_bytes(content)
    return made


def blank(folder: Path, name: str, content: bytes) -> dict[str, Any]:
    (folder / name).write_bytes(content)
    return {"source": folder / name}


def raw(folder: Path, rows: int) -> dict[str, Any]:
    (folder / "a.hdr").write_text(f"NROWS {rows}\nNCOLS 10\nNBITS 8\n")
    return blank(folder, "a.bil", bytes(100))


def two_variables(folder: Path) -> dict[str, Any]:
    with netcdf_file(folder / "a.nc", "w") as file:
        for axis in ("y", "x"):
            file.createDimension(axis, 40)
        for name in ("height", "snow"):
            file.createVariable(name, "f4", ("y", "x"))[:] = 1.0
    return {"source": folder / "a.nc"}


def test_degrees_of_a_netcdf_that_names_no_system_are_those_of_wgs_84(tmp_path: Path) -> None:
    with netcdf_file(tmp_path / "a.nc", "w") as file:
        for axis, count, first, unit in (("lat", 40, 46.0, b"degrees_north"), ("lon", 50, 9.0, b"degrees_east")):
            file.createDimension(axis, count)
            places = file.createVariable(axis, "f8", (axis,))
            places.units, places[:] = unit, first + np.arange(count) / 1000
        file.createVariable("z", "f4", ("lat", "lon"))[:] = heights()
    assert said(load(tmp_path / "a.nc").notes, " m in EPSG:4326")


NOISE = np.random.default_rng(1).normal(size=(400, 400)).astype(np.float32)
PHOTO = np.zeros((3, 9, 9), np.uint8)
FEET = 'LOCAL_CS["mine",UNIT["foot",0.3048]]'
DEGREES = {
    "all": (from_origin(-180, 90, 7.2, 4.5), "EPSG:4326"),
    "beyond": (from_origin(9, 91, 0.1, 0.1), "EPSG:4326"),
    "pole": (from_origin(10, 90, 0.001, 0.001), "EPSG:4326"),
}
BAD: list[tuple[Callable[[Path], dict[str, Any]], str]] = [
    (lambda f: dem(f, None, *DEGREES["pole"]), "around latitude 89.98, where degrees of longitude have no width"),
    (lambda f: dem(f, None, *DEGREES["all"]), "no flat grid is true over more than 12; crop it"),
    (lambda f: dem(f, None, *DEGREES["beyond"]), "to 91; its georeference is damaged"),
    (lambda f: dem(f, crs=None), r"does not say in which coordinate system.*set terrain\.crs"),
    (lambda f: dem(f, crs=FEET), r"without metres or degrees.*set terrain\.crs"),
    (lambda f: dem(f, crs=None) | {"crs": "EPSG:banana"}, "'EPSG:banana' is no coordinate system"),
    (lambda f: dem(f) | {"resolution_m": 5000.0}, "no cell of 5000 m fits"),
    (lambda f: dem(f) | {"labels": "labels.toml"}, "needs a photo"),
    (lambda f: dem(f, PHOTO), r"3 bands of uint8, expected one of elevation.*terrain\.photo"),
    (lambda f: with_photo(f, np.zeros((3, 40, 50), np.uint8), nodata=0), "p.tif shows nothing of the terrain"),
    (lambda f: with_photo(f, PHOTO, from_origin(6e5, 52e5, 10, 10)), "does not overlap .*: it covers x 600000"),
    (lambda f: with_photo(f, PHOTO, Affine.identity(), None), "georeference both, or make them the same size"),
    (lambda f: cut(f, heights(400, 400)), "truncated or no raster"),
    (lambda f: cut(f, NOISE, compress="deflate", tiled=True, blockxsize=128, blockysize=128), "truncated"),
    (lambda f: text(f, "a.tif"), "no raster"),
    (lambda f: text(f, "a.qqq"), "is no raster that is read: it begins with b'this is .*gdal_translate FILE out"),
    (lambda f: {"source": f / "nowhere.tif"}, r"cannot read terrain .*nowhere\.tif: No such file"),
    (lambda f: {"source": f}, "is a folder"),
    (lambda f: vrt(f, "http://127.0.0.1:9/a.tif"), r"cannot read .*vrt: .*a\.tif: No such file"),
    (lambda f: vrt(f, "/vsicurl/a.tif"), r"cannot read .*vrt: /vsicurl/a\.tif: No such file"),
    (lambda f: vrt(f, fifo(f)), "it is a device or pipe"),
    (lambda f: vrt(f, "a.vrt"), "more than 4 deep"),
    (lambda f: vrt(f, dem(f)["source"].name, 40), "paints its pixels 40 times over"),
    (lambda f: vrt(f, vrt(f, dem(f)["source"].name, 40, "b.vrt")["source"].name), "paints its pixels 40 times"),
    (lambda f: vrt(f, text(f, "wms.xml")["source"].name), r"wms\.xml is no raster"),
    (lambda f: packed(f, "a.tif", "b.tif"), "holds 2 files of the kinds .tif"),
    (lambda f: packed(f, "a.tif", *(f"{n}{'x' * 60_000}" for n in range(20))), "its table of contents has 1.2 MB"),
    (lambda f: spoilt(packed(f, "a.tif")), r"a\.zip"),
    (lambda f: spoilt(packed(f, "a.tif", method=zipfile.ZIP_LZMA)), r"a\.zip"),
    (lambda f: spoilt(packed(f, "a.tif", method=zipfile.ZIP_BZIP2)), r"a\.zip"),
    (lambda f: blank(f, "a.zip", b"PK no"), r"damaged or no \.zip"),
    (lambda f: blank(f, "a.hgt", bytes(2 * 1201**2)), "says by its name where it lies, such as N46E008.hgt"),
    (lambda f: blank(f, "N46E010.hgt", bytes(1000)), r"truncated or no \.hgt: it has 1000 bytes"),
    (
        lambda f: dem(f, heights() * np.float32(100)),
        r"less than 20 km: set terrain\.height_scale \(1; of centimetres",
    ),
    (lambda f: dem(f, heights().astype(np.uint8), compress="jpeg"), "with loss, expected exact numbers"),
    (lambda f: dem(f, None, from_origin(9, 46, 0.001, 0.001)), "a cell of 0.001 looks like degrees"),
    (
        lambda f: {"source": dem(f)["source"].rename(f / os.fsdecode(b"a\xff.tif"))},
        "its name, or a name in it .* is not UTF-8",
    ),
    (lambda f: raw(f, 3), "has 100 bytes, expected 30, as the header beside it says"),
    (lambda f: raw(f, 11), "has 100 bytes, expected 110"),
    (two_variables, "several rasters .*height.*snow"),
]


@pytest.mark.parametrize(("make", "words"), BAD, ids=[words for _, words in BAD])
def test_a_bad_raster_is_refused_with_a_sentence(tmp_path, make, words):
    with pytest.raises(TerrainError, match=words) as caught:
        load(**make(tmp_path))
    assert "\n" not in str(caught.value)


def test_an_array_in_place_of_a_path_is_refused_by_what_to_write(tmp_path: Path) -> None:
    with pytest.raises(
        TerrainError, match=r"is of type ndarray, expected a path: numpy\.savez\('heights\.npz', elev"
    ):
        build_terrain(Scenario(terrain=TerrainConfig(source=heights())))
    np.savez(tmp_path / "heights.npz", elevation=heights(), resolution_m=10.0)
    np.testing.assert_array_equal(load(tmp_path / "heights.npz").elevation_m, heights())


def test_a_raster_within_another_file_is_that_raster(tmp_path: Path) -> None:
    plain = load(**dem(tmp_path))
    nested = vrt(tmp_path, vrt(tmp_path, "a.tif", 30, "b.vrt")["source"].name)
    for made in (nested, packed(tmp_path, "inside/dem.tif")):
        found = load(**made)
        assert found.grid == plain.grid
        np.testing.assert_array_equal(found.elevation_m, plain.elevation_m)


# --- real data ----------------------------------------------------------------------------------------------


@needs_data
def test_real_pairs_come_onto_one_grid() -> None:
    davos = load(DATA / "dem/davosdorf/davosdorf.tif", photo=str(DATA / "dem/davosdorf/davosdorf_color.tif"))
    assert (davos.grid.rows, davos.grid.cols, davos.grid.resolution_m) == (495, 559, 10)
    assert davos.photo is not None
    rmnp = load(DATA / "dem/rmnp/rmnp-dem.tif", photo=str(DATA / "dem/rmnp/rmnp-rgb.tif"))
    assert 230 < rmnp.grid.resolution_m < 238
    assert rmnp.photo.shape == (rmnp.grid.rows, rmnp.grid.cols, 3)
    assert not np.isnan(rmnp.elevation_m).any()
    tujunga = load(DATA / "dem/bigtujunga/bigtujunga_512.tif")
    assert tujunga.elevation_m.shape == (512, 512)


@needs_data
def test_jacksboro_from_its_file_is_jacksboro() -> None:
    file = load(DATA / "dem/jacksboro/jacksboro_fault_dem.npz", resolution_m=75.0)
    np.testing.assert_array_equal(file.elevation_m, load("jacksboro").elevation_m)


def test_the_built_in_terrain_lies_where_its_degrees_are() -> None:
    from rasterio.warp import transform

    grid = load("jacksboro").grid
    (lon,), (lat,) = transform(grid.crs, "EPSG:4326", [grid.west_m], [grid.north_m])
    assert (lon, lat) == (pytest.approx(-84.41375, abs=1e-7), pytest.approx(36.73291667, abs=1e-7))


@pytest.mark.parametrize(("rows", "side_m"), [(16_385, 0.33), (99_999, 27.7), (1_536_000, 0.01)])
def test_a_terrain_with_too_many_cells_names_a_resolution_which_is_allowed(rows: int, side_m: float) -> None:
    with pytest.raises(TerrainError, match=r"set terrain\.resolution_m to at least ") as refused:
        check_size(rows, rows, "terrain", side_m)
    least_m = float(str(refused.value).split()[-1])
    check_size(int(rows * side_m / least_m), int(rows * side_m / least_m), "terrain", least_m)


# --- rasters that would have ended in a traceback or a wait ---------------------------------------------------


HEIGHTS = np.add.outer(np.arange(40) * 2.0, np.arange(40) * 1.0).astype(np.float32)


MOON = "+proj=longlat +R=1737400 +no_defs"


def slanted(path: Path, heights=HEIGHTS, crs="EPSG:32632", where=(500_000.0, 5_000_000.0)) -> Path:
    return written(path, heights, crs=crs, transform=from_origin(*where, 30, 30))


def test_a_map_in_metres_may_lie_across_180_degrees(tmp_path: Path) -> None:
    path = slanted(tmp_path / "fiji.tif", crs="EPSG:3832", where=(3_339_000.0, -1_800_000.0))
    raster = load(path)
    assert raster.grid.rows in range(37, 42)
    assert raster.grid.cols in range(37, 42)
    path = slanted(tmp_path / "edge.tif", crs="EPSG:3857", where=(20_037_000.0, -1_800_000.0))
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
    level = load(slanted(tmp_path / "large.tif", heights)).level
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


@pytest.mark.parametrize(
    ("crs", "water_below_m", "told"),
    [("EPSG:32632", None, 1), ("EPSG:32632", 0.0, 0), ("EPSG:4326", None, 1), (MOON, None, 0)],
)
def test_a_sea_floor_of_the_earth_is_doubted(
    tmp_path: Path, crs: str, water_below_m: float | None, told: int
) -> None:
    place = from_origin(9, 47, 0.001, 0.001) if crs != "EPSG:32632" else from_origin(5e5, 5e6, 30, 30)
    path = str(written(tmp_path / "deep.tif", HEIGHTS * 8 - 600, crs=crs, transform=place))
    terrain = build_terrain(Scenario(terrain=TerrainConfig(source=path, water_below_m=water_below_m)))
    assert sum("no dry land" in doubt for doubt in doubts_about(facts_of(terrain))) == told


def test_a_setting_that_contradicts_the_file_is_said_aloud(tmp_path: Path) -> None:
    path = slanted(tmp_path / "dem.tif")
    said = "terrain.crs = 'EPSG:32633' counts, though the file says EPSG:32632: every place follows from it"
    notes = {crs: load(path, crs=crs).notes for crs in (None, "EPSG:32632", "EPSG:32633")}
    assert {crs for crs, told in notes.items() if said in told} == {"EPSG:32633"}
    bare = slanted(tmp_path / "bare.tif", crs=None)
    told = load(bare, crs="EPSG:32633").notes
    assert not any("counts" in note for note in told)
