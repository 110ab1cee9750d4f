"""`swarm route --terrain`: a route without a swarm, its places, and what other programs get of it."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from rasterio.transform import from_origin
from typer.testing import CliRunner

from launch_scripts.commands.query import app
from launch_scripts.commands.route_on_terrain import find_route, profile_of
from launch_scripts.commands.terrain import app as terrain_app
from shared_map.terrain.places import latitudes_of, middles_of, parse_place
from swarm.errors import ConfigError, SwarmError
from swarm.grid import GridSpec

SYSTEM = "EPSG:32632"
ALPS = GridSpec(60, 80, 20.0, 500_000.0, 5_200_000.0, SYSTEM)
SITE = GridSpec(60, 80, 20.0)


@pytest.fixture(scope="module")
def hill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ridge of 45 degrees from the north to near the south, with level ground to both sides."""
    path = tmp_path_factory.mktemp("hill") / "hill.tif"
    across = np.abs(np.arange(80) - 40)
    heights = np.repeat(np.maximum(400.0 - 40.0 * across, 100.0)[None], 60, axis=0)
    heights[50:] = 100.0
    heights += np.random.default_rng(1).uniform(0, 0.5, heights.shape)
    place = from_origin(ALPS.west_m, ALPS.north_m, 20, 20)
    with rasterio.open(
        path, "w", driver="GTiff", height=60, width=80, count=1, dtype="float32", crs=SYSTEM, transform=place
    ) as file:
        file.write(heights.astype(np.float32), 1)
    return path


@given(st.integers(0, ALPS.cells - 1))
def test_every_way_to_name_a_cell_means_that_cell(cell: int) -> None:
    row, col = ALPS.row_col(cell)
    (lat,), (lon,) = latitudes_of(ALPS, np.array([cell]))
    (x_m,), (y_m,) = middles_of(ALPS, np.array([cell]))
    for text in (f"cell:{row},{col}", f"xy:{x_m},{y_m}", f"{lat},{lon}", f" latlon:{lat}, {lon}"):
        assert parse_place(text.strip(), ALPS, "--from") == cell
    assert parse_place(f"{(col + 0.5) * 20},{-(row + 0.5) * 20}", SITE, "--from") == cell


@pytest.mark.parametrize(
    ("text", "grid", "complaint"),
    [
        ("nowhere", ALPS, "--from is 'nowhere'; expected LAT,LON"),
        ("nan,nan", ALPS, "expected LAT,LON"),
        ("1e999,1", ALPS, "no latitude and longitude"),
        ("500100,5199900", ALPS, r"write xy:X,Y"),
        ("0,0", ALPS, r"outside the terrain: 60 x 80 cells, x 500000 to 501600.*latitude 46\.\d+ to 46"),
        ("cell:60,0", ALPS, "outside the terrain"),
        ("cell:-1,0", SITE, "outside the terrain"),
        ("latlon:46,9", SITE, "has no place; give xy:X,Y"),
    ],
)
def test_a_bad_place_is_refused_in_a_sentence(text: str, grid: GridSpec, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        parse_place(text, grid, "--from")


def test_a_route_goes_around_the_ridge_and_every_format_holds_it(hill: Path, tmp_path: Path) -> None:
    route = find_route(str(hill), "cell:10,5", "cell:10,75")
    assert route.found.cells[:, 0].max() >= 50
    assert route.found.gap == pytest.approx(1, abs=1e-3)
    assert route.at_s[-1] == pytest.approx(route.found.cost_s, rel=1e-4)
    assert route.at_m[-1] == pytest.approx(route.found.length_m, rel=1e-6)
    assert (np.diff(route.at_s) > 0).all()
    assert "m" in profile_of(route)
    for ending in ("geojson", "gpx", "kml", "csv"):
        words = [
            "--terrain",
            hill,
            "--from",
            "cell:10,5",
            "--to",
            "cell:10,75",
            "--out",
            tmp_path / f"way.{ending}",
        ]
        result = CliRunner().invoke(app, ["route", *map(str, words), "--json"], catch_exceptions=False)
        assert result.exit_code == 0, result.output
    many = len(route.at_m)
    (feature,) = json.loads((tmp_path / "way.geojson").read_text())["features"]
    lon, lat, height_m = feature["geometry"]["coordinates"][0]
    assert len(feature["geometry"]["coordinates"]) == many == feature["properties"]["steps"] + 1
    assert (lat, lon) == pytest.approx((46.95, 9.0), abs=0.05)
    assert height_m == pytest.approx(100, abs=1)
    points = ElementTree.parse(tmp_path / "way.gpx").iter("{http://www.topografix.com/GPX/1/1}trkpt")
    assert next(float(point.attrib["lat"]) for point in points) == pytest.approx(lat, abs=1e-7)
    line = next(ElementTree.parse(tmp_path / "way.kml").iter("{http://www.opengis.net/kml/2.2}coordinates")).text
    assert len((line or "").split()) == many
    with (tmp_path / "way.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert (len(rows), rows[0]["row"], rows[0]["col"]) == (many, "10", "5")


def test_what_cannot_be_is_said_in_a_sentence(hill: Path, tmp_path: Path) -> None:
    with pytest.raises(SwarmError, match=r"--from is on lethal ground \(cell:10,35, class unknown\)"):
        find_route(str(hill), "cell:10,35", "cell:10,75")
    for words, complaint in (
        (["--terrain", str(hill), "--from", "cell:1,1"], "give --from and --to"),
        (["--row", "1"], "give --target, --row and --col"),
        (
            ["--terrain", str(hill), "--from", "cell:1,1", "--to", "cell:2,2", "--out", str(tmp_path / "a.doc")],
            "write .geojson",
        ),
    ):
        result = CliRunner().invoke(app, ["route", *words])
        assert isinstance(result.exception, SwarmError)
        assert complaint in str(result.exception)


def test_the_time_from_everywhere_is_that_of_the_routes_as_raster_and_as_areas(hill: Path, tmp_path: Path) -> None:
    words = [str(hill), "--to", "cell:10,75", "--out"]
    said = (
        CliRunner().invoke(terrain_app, ["reach", *words, str(tmp_path / "s.tif")], catch_exceptions=False).output
    )
    assert "from 8" in said or "from 9" in said
    with rasterio.open(tmp_path / "s.tif") as file:
        seconds = file.read(1)
        assert (file.crs.to_string(), file.nodata, file.shape) == (SYSTEM, -1.0, (60, 80))
    assert seconds[10, 5] == pytest.approx(find_route(str(hill), "cell:10,5", "cell:10,75").found.cost_s, rel=1e-5)
    assert seconds[10, 35] == -1
    assert seconds[10, 75] == 0
    areas = [*words, str(tmp_path / "a.geojson"), "--every-s", "60", "--json"]
    CliRunner().invoke(terrain_app, ["reach", *areas], catch_exceptions=False)
    features = json.loads((tmp_path / "a.geojson").read_text())["features"]
    assert max(each["properties"]["to_s"] for each in features) >= seconds.max()
    lon, lat = features[0]["geometry"]["coordinates"][0][0]
    assert (lat, lon) == pytest.approx((46.95, 9.0), abs=0.05)
    with pytest.raises(SwarmError, match="areas, at most 200"):
        CliRunner().invoke(terrain_app, ["reach", *areas[:-2], "0.001"], catch_exceptions=False)
    with pytest.raises(SwarmError, match="--to is on lethal ground"):
        CliRunner().invoke(terrain_app, ["reach", str(hill), "--to", "cell:10,35"], catch_exceptions=False)
