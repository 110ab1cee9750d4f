"""Plain formats: right files are read, and wrong ones are refused with the line."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.transform import from_origin
from support.effort import few
from support.height_models import load, written

from shared_map.importers.grids_without_gdal import read_text_grid
from shared_map.terrain.terrain import build_terrain
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError

ASC = "ncols 3\nnrows 2\nxllcorner 1000\nyllcorner 2000\ncellsize 50\nNODATA_value -9999\n1 2 3\n4 -9999 6\n"
GRASS = "north: 20\nsouth: 0\neast: 30\nwest: 0\nrows: 2\ncols: 3\n"
MAP = "type octile\nheight 3\nwidth 4\nmap\n..@T\nGS.W\nO...\n"
YAML = "image: m.pgm  # the picture\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\n"
YAML += "occupied_thresh: 0.65\nfree_thresh: 0.25\n"


def wrote(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


BAD: dict[str, list[tuple[str | bytes, str]]] = {
    "a.asc": [
        (ASC.replace("ncols 3", "ncols 2.5"), "its header says ncols '2.5', expected a whole number"),
        (ASC.replace("cellsize 50", "cellsize 5_0"), "its header says cellsize '5_0', expected a number"),
        (ASC.replace("cellsize 50", "cellsize 50\ncellsize 60"), "its header says cellsize twice"),
        (ASC.replace("1 2 3", "1 2_0 3"), "line 7: found '2_0'; its header says 2 rows of 3 numbers"),
        (ASC.replace("ncols 3", "ncols nan"), "Invalid dataset dimensions : 0 x 2"),
        (ASC.replace("cellsize 50", "cellsize inf"), "has pixels without a size"),
        (ASC.replace("1 2 3", "1 2"), "has 5 numbers; its header says 2 rows of 3"),
        (ASC + "7 8 9\n", "line 9: found '7'; its header says 2 rows of 3 numbers"),
        (ASC.replace("ncols 3\n", ""), "is truncated or no raster"),
        (ASC.replace("cellsize 50", "cellsize 0"), "a cell 0 x 0, expected a size above 0"),
        (ASC.replace("ncols 3", "ncols 300000").replace("nrows 2", "nrows 300000"), "300000 x 300000"),
        (
            ASC.replace("cellsize 50", "cellsize 0.001").replace("1000", "9").replace("2000", "47"),
            "looks like degrees",
        ),
        (GRASS + "multiplier: 0.01\n1 2 3\n4 5 6", "a multiplier"),
        (ASC.replace("cellsize 50", "dx 50\ndy 0"), "a cell 50 x 0, expected"),
        (GRASS.replace("north: 20", "north: -20") + "1 2 3\n4 5 6", "a cell 10 x -10, expected"),
        ("DSAA\n3 2\n60 0\n0 30\n1 6\n1 2 3\n4 5 6", "a cell -30 x 30, expected"),
        (b"\xfd\xfe\x00", "is no raster that is read: it begins with .*gdal_translate"),
        ("", "is empty; it is not read; fetch the file again"),
    ],
    "a.map": [
        (MAP.replace("GS.W", "GS."), "line 6: 3 cells; expected 3 rows of 4"),
        (MAP.replace("O...\n", ""), "2 rows; its header says 3"),
        (MAP.replace("O...", "O.x."), "line 7, column 3: 'x' is no ground"),
        (MAP.replace("height 3", "height many"), "no MovingAI map"),
        (MAP.replace("height 3", "height 99999999").replace("width 4", "width 9999"), "has 99999999 x 9999 cells"),
        ("hello", "no MovingAI map"),
    ],
}


@pytest.mark.parametrize(("name", "text", "words"), [(name, *each) for name, bad in BAD.items() for each in bad])
def test_a_bad_file_is_refused_with_a_sentence(tmp_path: Path, name: str, text: str | bytes, words: str) -> None:
    with pytest.raises(TerrainError, match=words):
        load(wrote(tmp_path / name, text))


def test_a_bad_npz_is_refused_with_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    for arrays, words in (
        ({"height": np.ones((3, 3))}, r"no `elevation` \(read: .*resolution_m.*\); it has height"),
        ({"elevation": np.ones(3)}, r"elevation is \(3,\) float64; expected rows of numbers"),
        ({"elevation": np.ones((3, 3))}, "does not say how large a cell is; set terrain.resolution_m"),
        ({"elevation": np.ones((3, 3)), "resolution_m": -1.0}, "must be positive"),
        ({"elevation": np.ones((3, 3)), "resolution_m": [1, 2]}, "its cell size is no single number"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(TerrainError, match=words):
            load(path)
    np.savez(path, elevation=np.random.default_rng(1).normal(size=(50, 50)), resolution_m=1.0)
    with pytest.raises(TerrainError, match=r"truncated or no \.npz"):
        load(wrote(path, path.read_bytes()[:9000]))
    with pytest.raises(TerrainError, match=r"truncated or no \.npz"):
        load(wrote(path, b"PK nonsense"))


def test_an_npz_names_the_arrays_which_are_not_read_and_that_no_system_can_place_it(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", elevation=np.eye(20), resolution_m=10.0, west_m=500_000.0)
    said = "\n".join(load(tmp_path / "a.npz", crs="EPSG:32632").notes)
    assert "! not read: the arrays west_m (read: elevation" in said
    assert "! the file has no origin" in said


def test_an_hgt_is_known_by_its_length(tmp_path: Path) -> None:
    heights = np.full((1201, 1201), 700, ">i2")
    heights[0, 0] = -32768
    source = load(wrote(tmp_path / "N46E009.hgt", heights.tobytes()))
    assert 70 < source.grid.resolution_m < 93
    assert np.nanmedian(source.elevation_m) == 700


def test_a_png_needs_a_scale(tmp_path: Path) -> None:
    grey = (np.arange(48).reshape(6, 8) * 100).astype(np.uint16)
    written(tmp_path / "a.png", grey, "uint16", driver="PNG", crs=None, transform=None)
    with pytest.raises(TerrainError, match=r"set terrain\.resolution_m .* terrain\.height_scale"):
        load(tmp_path / "a.png")
    source = load(tmp_path / "a.png", resolution_m=5.0, height_scale=0.1)
    np.testing.assert_allclose(source.elevation_m, grey * 0.1, rtol=1e-6)


# --- maps without heights -----------------------------------------------------------------------------------


def test_a_movingai_map_is_open_or_lethal_cell_by_cell(tmp_path: Path) -> None:
    (tmp_path / "a.map").write_text(MAP)
    source, cost = TerrainConfig(source=str(tmp_path / "a.map")), CostConfig(flat_speed_m_per_s=4.0)
    terrain = build_terrain(Scenario(terrain=source, cost=cost))
    lethal = np.array([[0, 0, 1, 1], [0, 0, 0, 1], [1, 0, 0, 0]], bool)
    np.testing.assert_array_equal(np.isinf(terrain.pace_s_per_m), lethal)
    assert (terrain.pace_s_per_m[~lethal] == 0.25).all()
    assert terrain.grid.resolution_m == 1


def ros(folder, yaml=YAML, image=b"P5\n# made by hand\n3 2\n255\n\xfe\x00\xcd\xfe\xfe\x00"):
    wrote(folder / "m.pgm", image)
    return load(wrote(folder / "m.yaml", yaml))


def test_a_ros_map_keeps_row_0_on_top_and_unknown_is_lethal(tmp_path: Path) -> None:
    source = ros(tmp_path)
    np.testing.assert_array_equal(source.factor, np.array([[1, np.inf, 1], [1, 1, np.inf]], np.float32))
    assert (source.grid.resolution_m, source.grid.west_m, source.grid.north_m) == (0.05, -1.0, -1.9)
    unknown = ros(tmp_path, YAML.replace("0.25", "0.1"))
    assert np.isinf(unknown.factor[0, 2])
    (tmp_path / "m.yaml").write_text(YAML.replace("0.25", "0.1"))
    assert load(tmp_path / "m.yaml", nodata="fill").factor[0, 2] == 1


def test_ros_modes_scale_raw_and_negate(tmp_path: Path) -> None:
    scaled = ros(tmp_path, YAML + "mode: scale\n", b"P2 3 1 # wide\n100\n100 55 20\n").factor
    assert scaled[0, 0] == 1
    assert 1 < scaled[0, 1] < 10
    assert np.isinf(scaled[0, 2])
    raw = ros(tmp_path, YAML + "mode: raw\n", b"P5 3 1 255\n\x00\x64\xff").factor
    np.testing.assert_array_equal(raw, np.array([[1, np.inf, np.inf]], np.float32))
    turned = ros(tmp_path, YAML.replace("negate: 0", "negate: 1"), b"P5 2 1 255\n\x00\xff").factor
    np.testing.assert_array_equal(turned, np.array([[1, np.inf]], np.float32))
    wide = ros(tmp_path, YAML, b"P5 2 1 65535\n\xff\xff\x00\x00").factor
    np.testing.assert_array_equal(wide, np.array([[1, np.inf]], np.float32))


@pytest.mark.parametrize(
    ("yaml", "image", "words"),
    [
        (YAML.replace("m.pgm", "n.pgm"), b"", r"cannot read image .*n\.pgm: No such file"),
        (YAML, b"P9 1 1 255\n\0\0\0", "no PGM, PNG or BMP"),
        (YAML, b"P5 100 100 255\n\0\0", "is truncated"),
        (YAML, b"P5 99999 99999 255\n\0", "is truncated or no PGM.*decompression bomb"),
        (YAML, b"P5 2 1 0\n\0\0", "maxval must be greater than 0"),
        (YAML.replace("resolution: 0.05\n", ""), b"P5 1 1 255\n\0", "missing required field `resolution`"),
        (YAML.replace("-1.0", ".nan"), b"P5 1 1 255\n\0", "origin.0.: found nan"),
        (YAML.replace("0.0]", "0.7]"), b"P5 1 1 255\n\0", "turned by 0.7 rad"),
        (YAML + "mode: fancy\n", b"P5 1 1 255\n\0", "mode: found 'fancy'; allowed"),
        (YAML + "what is this\n", b"P5 1 1 255\n\0", "line 7"),
        (YAML.replace("0.25", "0.9"), b"P5 1 1 255\n\0", "free <= occupied"),
    ],
)
def test_a_bad_ros_map_is_refused_with_a_sentence(tmp_path: Path, yaml: str, image: bytes, words: str) -> None:
    with pytest.raises(TerrainError, match=words):
        ros(tmp_path, yaml, image)


# --- points as text -------------------------------------------------------------------------------------------


ROWS, COLS, STEP = 12, 9, 25.0
WEST, NORTH = 500_000.0, 5_000_000.0
GROUND = np.round(np.add.outer(np.arange(ROWS) * 7.3, np.arange(COLS) * -3.1) + 400, 2).astype(np.float32)
X, Y = WEST + STEP / 2 + STEP * np.arange(COLS), NORTH - STEP / 2 - STEP * np.arange(ROWS)
POINTS = [(x, y, float(GROUND[row, col])) for row, y in enumerate(Y) for col, x in enumerate(X)]


def text_of(points: Any, between: str = " ", header: str = "", end: str = "\n") -> str:
    lines = [between.join(f"{value!r}" for value in map(float, point)) for point in points]
    return end.join([*([header] if header else []), *lines]) + end


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", text_of(POINTS, ",")),
        ("a.csv", text_of(POINTS, ",", "x,y,z")),
        ("a.csv", text_of(POINTS, ", ", '"Easting", "Northing", "Elevation"', "\r\n")),
        ("a.csv", "\ufeff" + text_of(POINTS, ";", "X;Y;Höhe;Z".replace("Höhe;", ""))),
        ("a.csv", text_of(POINTS, ";").replace(".", ",")),
        ("a.xyz", "# made by hand\n" + text_of(POINTS, "\t")),
        ("a.xyz", text_of([(*point, 7, 8, 9) for point in POINTS])),
        ("a.csv", text_of([(z, n, x, y) for n, (x, y, z) in enumerate(POINTS)], ",", "z,id,x,y")),
        ("a.csv", text_of([(y, x, z) for x, y, z in POINTS], ",", "north,east,height")),
        ("a.csv", text_of(POINTS, ",", end=",\n")),
        ("a.csv", re.sub(r"[^,\n]+", r'"\g<0>"', text_of(POINTS, ",", "x,y,z"))),
        ("a.xyz", text_of(POINTS) + "\n\n"),
        ("a.xyz", text_of(POINTS).rstrip()),
        ("a.xyz", text_of([*POINTS, *POINTS[:5]])),
    ],
    ids=lambda value: value[:24] if isinstance(value, str) else None,
)
def test_every_layout_gives_the_same_heights(tmp_path: Path, name: str, text: str) -> None:
    plain = read_text_grid(wrote(tmp_path / name, text), "a")
    np.testing.assert_array_equal(plain.numbers, GROUND)
    assert (plain.transform, plain.crs) == (from_origin(WEST, NORTH, STEP, STEP), None)


@settings(max_examples=few(40))
@given(order=st.randoms(use_true_random=False), missing=st.sets(st.integers(0, len(POINTS) - 1), max_size=60))
def test_points_in_any_order_and_with_any_gaps_lie_where_they_say(tmp_path_factory, order, missing):
    """The four corners are there, so that the grid is the same."""
    there = missing - {0, COLS - 1, len(POINTS) - COLS, len(POINTS) - 1}
    points = [point for n, point in enumerate(POINTS) if n not in there]
    rows = {y for _, y, _ in points}
    cols = {x for x, _, _ in points}
    order.shuffle(points)
    path = wrote(tmp_path_factory.getbasetemp() / "any.xyz", text_of(points))
    if len(rows) < ROWS or len(cols) < COLS:
        return  # a step that no two neighbours show
    plain = read_text_grid(path, "a")
    expected = GROUND.copy()
    expected.reshape(-1)[sorted(there)] = np.nan
    np.testing.assert_array_equal(plain.numbers, expected)
    assert (f"{len(there)} points of the grid" in " ".join(plain.notes)) == bool(there)


def test_rounded_degrees_are_a_grid_and_are_put_on_metres(tmp_path: Path) -> None:
    lon, lat = 9 + np.arange(130) / 1200, 46 - np.arange(100) / 1200
    ground = np.add.outer(np.arange(100) * 2.0, np.arange(130) * 1.5)
    lines = [f"{a:.6f},{b:.6f},{ground[i, j]:g}" for i, b in enumerate(lat) for j, a in enumerate(lon)]
    source = load(wrote(tmp_path / "a.csv", "\n".join(["lon,lat,elevation", *lines])))
    assert "+proj=eqc" in source.grid.crs
    assert source.grid.rows * source.grid.resolution_m == pytest.approx(100 / 1200 * 111_150, rel=1e-2)
    path = wrote(tmp_path / "b.csv", "\n".join(lines))
    with pytest.raises(TerrainError, match=r"looks like degrees; set terrain\.crs = 'EPSG:4326'"):
        load(path)
    np.testing.assert_array_equal(load(path, crs="EPSG:4326").elevation_m, source.elevation_m)


def test_empty_fields_and_nan_are_voids(tmp_path: Path) -> None:
    path = wrote(tmp_path / "a.csv", "0,10,\n10,10,2\n0,0,nan\n10,0,4\n")
    np.testing.assert_array_equal(read_text_grid(path, "a").numbers, [[np.nan, 2], [np.nan, 4]])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "holds no numbers"),
        ("a,b,c\n1,2,3\n", "line 1: 'a,b,c' names no x, y, z"),
        ("x,y,z\n1,2,3\n2,x,3\n", "line 3: could not convert string 'x'"),
        ("x,y,z\n1,2,3\n2,3\n", "line 3: invalid column index 2; expected x, y and z"),
        ("1,2,3,4\n1,2,3,4\n", "its first line has 4 numbers; expected x, y and z"),
        ("0,0,1\n10,0,2\n0,10,3\n10,10,4\n10,10,5\n", "two heights at x 10, y 10"),
        ("0,0,1\n10,0,2\n23,0,3\n0,10,3\n", "on no regular grid: x has gaps from 10 to 13"),
        ("0,0,1\n1,1,2\n100000,100000,3\n", "3 points are 0.0% of a grid of 1 x 1; gdal_grid makes one"),
        ("0,0,1\n0,1,2\n", "its points have 1 different x; a grid has at least two"),
        ("0,0,1\nnan,1,2\n", "a point has no x or no y"),
        ("0,0,1\n1e300,1,2\n", "a point has no x or no y, or one beyond"),
        ("1,2,3\n1,2,\xff3\n", "line 2: could not convert string '\xff3'"),
    ],
)
def test_bad_text_is_refused_in_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    path = wrote(tmp_path / "a.csv", text)
    with pytest.raises(TerrainError, match=sentence) as refused:
        read_text_grid(path, "the file")
    assert "\n" not in str(refused.value)
    assert "the file" in str(refused.value)


def test_what_is_no_text_or_has_no_lines_is_refused(tmp_path: Path) -> None:
    for data in (b"\x00\xff\xfe1,2,3\n", b"1,2,3\n\xc3\x28,2,3\n", b"\0" * 100):
        path = tmp_path / "a.csv"
        path.write_bytes(data)
        with pytest.raises(TerrainError, match=r"a\.csv"):
            load(path)


def test_points_are_read_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shared_map.importers.grids_without_gdal._LINES", 20)
    plain = read_text_grid(wrote(tmp_path / "a.csv", text_of(POINTS, ",", "x,y,z")), "a")
    np.testing.assert_array_equal(plain.numbers, GROUND)
    with pytest.raises(TerrainError, match="line 110: could not convert string 'what'"):
        read_text_grid(wrote(tmp_path / "b.csv", text_of(POINTS, ",", "x,y,z") + "1,2,what\n"), "b")


def test_degrees_lie_where_they_say_in_text_and_in_rasters(tmp_path: Path) -> None:
    """The same degrees as points and as a raster become the same ground at the same place, in true metres."""
    import rasterio.warp

    place = from_origin(9.0, 46.5, 1 / 900, 1 / 1200)
    ground = np.add.outer(np.arange(60) * 3.0, np.arange(50) * -2.0) + 500
    raster = load(written(tmp_path / "a.tif", ground, crs="EPSG:4326", transform=place), resolution_m=90.0)
    lon, lat = 9.0 + (np.arange(50) + 0.5) / 900, 46.5 - (np.arange(60) + 0.5) / 1200
    points = [(a, b, ground[i, j]) for i, b in enumerate(lat) for j, a in enumerate(lon)]
    text = load(wrote(tmp_path / "a.csv", text_of(points, ",", "lon,lat,z")), resolution_m=90.0)
    assert (text.grid.rows, text.grid.cols) == (raster.grid.rows, raster.grid.cols)
    # GDAL widens its kernel where cells grow, by a twentieth here: 0.05 of a pixel of 2 m.
    np.testing.assert_allclose(text.elevation_m, raster.elevation_m, atol=0.12)
    for grid in (text.grid, raster.grid):
        corner = rasterio.warp.transform(grid.crs, "EPSG:4326", [grid.west_m], [grid.north_m])
        np.testing.assert_allclose(np.ravel(corner), (9.0, 46.5), atol=2e-8)
        # In a system of true metres, along the side: within 30 ppm over five kilometres.
        south_m = grid.north_m - grid.rows * grid.resolution_m
        _, ys = rasterio.warp.transform(grid.crs, "EPSG:32632", [0.0, 0.0], [grid.north_m, south_m])
        assert (ys[0] - ys[1]) / 0.9996 == pytest.approx(grid.rows * 90.0, rel=3e-5)
