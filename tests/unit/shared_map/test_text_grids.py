"""Heights as text: points of a regular grid in any order and layout."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.transform import from_origin
from support.effort import few
from support.height_models import load, written

from shared_map.importers.plain_grids import read_text_grid
from swarm.errors import TerrainError

ROWS, COLS, STEP = 12, 9, 25.0
WEST, NORTH = 500_000.0, 5_000_000.0
GROUND = np.round(np.add.outer(np.arange(ROWS) * 7.3, np.arange(COLS) * -3.1) + 400, 2).astype(np.float32)
X, Y = WEST + STEP / 2 + STEP * np.arange(COLS), NORTH - STEP / 2 - STEP * np.arange(ROWS)
POINTS = [(x, y, float(GROUND[row, col])) for row, y in enumerate(Y) for col, x in enumerate(X)]


def text_of(points: Any, between: str = " ", header: str = "", end: str = "\n") -> str:
    lines = [between.join(f"{value!r}" for value in map(float, point)) for point in points]
    return end.join([*([header] if header else []), *lines]) + end


def wrote(path: Path, text: str) -> Path:
    path.write_bytes(text.encode("utf-8"))
    return path


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
        ("# nothing\n\n", "holds no numbers"),
        ("a,b,c\n1,2,3\n", "line 1: 'a,b,c' names no x, y, z"),
        ("x,y,z\n1,2,3\n2,x,3\n", "line 3: could not convert string 'x'"),
        ("x,y,z\n1,2,3\n2,3\n", "line 3: invalid column index 2; expected x, y and z"),
        ("1,2,3,4\n1,2,3,4\n", "its first line has 4 numbers; expected x, y and z"),
        ("0,0,1\n10,0,2\n0,10,3\n10,10,4\n10,10,5\n", "two heights at x 10, y 10"),
        ("0,0,1\n10,0,2\n23,0,3\n0,10,3\n", "on no regular grid: x has gaps from 10 to 13"),
        ("0,0,1\n1,1,2\n1000,1000,3\n", "on no regular grid: 3 points are 0.0% of a grid of 1 x 1"),
        ("0,0,1\n1,1,2\n100000,100000,3\n", "3 points are 0.0% of a grid of 1 x 1; gdal_grid makes one"),
        ("0,0,1\n0,1,2\n", "its points have 1 different x; a grid has at least two"),
        ("0,0,1\nnan,1,2\n", "a point has no x or no y"),
        ("0,0,1\ninf,1,2\n", "a point has no x or no y"),
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
    monkeypatch.setattr("shared_map.importers.plain_grids._LINES", 20)
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
