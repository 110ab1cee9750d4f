"""Places as people write them: each form leads to the cell that it names, on every kind of terrain."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rasterio.transform import Affine
from support import height_models
from support.effort import few

from shared_map.terrain.map_frame import MapFrame, middles_of
from shared_map.terrain.terrain import build_terrain
from shared_map.terrain.zones import zone_mask
from swarm.client.terrain_frame import Frame
from swarm.config.ground import TerrainConfig, ZoneConfig
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import parse_scenario
from swarm.errors import ConfigError, TerrainError
from swarm.grid import GridSpec
from swarm.places import bounds_of, cell_of, corners_of, extent_of, fields_of, read_place, written

MOON = "+proj=stere +lat_0=-90 +lon_0=0 +R=1737400 +units=m +no_defs"
EQC = "+proj=eqc +lat_ts=36.5 +lon_0=-84.3 +datum=WGS84 +units=m +no_defs"
ALPS = MapFrame(GridSpec(60, 80, 20.0, 500_000.0, 5_200_000.0, "EPSG:32632"))
PLACED = {
    "UTM": ALPS,
    "degrees on metres": MapFrame(GridSpec(344, 403, 75.0, -15_100.0, 4_080_000.0, EQC)),
    "Swiss, another datum": MapFrame(GridSpec(495, 559, 10.0, 779_503.0, 190_480.0, "EPSG:21781")),
    "south, across 180 degrees": MapFrame(GridSpec(300, 900, 30.0, 170_000.0, 8_200_000.0, "EPSG:32701")),
    "around a pole": MapFrame(GridSpec(500, 500, 25.0, -6_000.0, 6_100.0, "EPSG:3413")),
    "centimetres": MapFrame(GridSpec(400, 300, 0.05, 500_000.0, 5_200_000.0, "EPSG:32632")),
    "the Moon": MapFrame(GridSpec(400, 300, 100.0, 30_000.0, 90_000.0, MOON)),
}
SITE = MapFrame(GridSpec(60, 80, 20.0))


@settings(max_examples=few(150))
@given(st.sampled_from(sorted(PLACED)), st.floats(0, 1, exclude_max=True))
@example("around a pole", 0.49)
def test_every_way_to_write_a_cell_leads_back_to_it(name: str, where: float) -> None:
    frame = PLACED[name]
    cell = int(where * frame.grid.cells)
    row, col = frame.grid.row_col(cell)
    fields = fields_of(frame, cell)
    said, _, rest = written(frame, cell).partition(" (")
    forms = [said, *rest.rstrip(")").split(", "), f"xy:{fields['x_m']!r}, {fields['y_m']!r}"]
    for text in [*forms, f"latlon:{fields['lat']:.9f},{fields['lon']:.9f}", (row, col)]:
        assert cell_of(text, frame, "--at") == cell
    for text in (f"cell:{row}.7,{col}", f"cell:{row},{col}.0", (row + 0.5, col)):
        with pytest.raises(ConfigError, match="expected whole numbers: a row and a column"):
            cell_of(text, frame, "--at")
    assert len(forms) == 4
    assert (fields["row"], fields["col"]) == (row, col)
    corners = corners_of([f"cell:{row},{col}", f"xy:{fields['x_m']},{fields['y_m']}"], frame, "--polygon")
    assert corners == [(row, col), pytest.approx((row + 0.5, col + 0.5), abs=1e-3)]


@given(st.integers(0, SITE.grid.cells - 1))
def test_a_terrain_without_a_place_has_its_own_metres(cell: int) -> None:
    x_m, y_m = SITE.grid.centre_m(cell)
    for text in (f"{x_m:.1f},{y_m:.1f}", f"xy:{x_m},{y_m}", written(SITE, cell).split(" ")[0]):
        assert cell_of(text, SITE, "--at") == cell
    assert fields_of(SITE, cell).keys() == {"row", "col", "x_m", "y_m"}


@given(st.integers(-100, 400), st.integers(-100, 400))
@example(46, 9)
def test_two_bare_whole_numbers_are_never_taken_for_what_they_may_not_be(first: int, second: int) -> None:
    """An independent reading: whatever of the two meanings lies in the terrain; both at once is refused."""
    place = MapFrame(GridSpec(60, 80, 20_000.0, -400_000.0, 400_000.0, "+proj=aeqd +lat_0=46 +lon_0=9 +units=m"))
    cells = set()
    if place.grid.inside(first, second):
        cells.add(place.grid.cell(first, second))
    if abs(first) <= 90 and abs(second) <= 360:
        x_m, y_m = place.from_wgs84(first, second)
        if math.isfinite(x_m) and place.grid.cell_at(x_m, y_m) >= 0:
            cells.add(place.grid.cell_at(x_m, y_m))
    if len(cells) == 1:
        assert {cell_of(f"{first},{second}", place, "--at")} == cells
    else:
        sentence = r"write one of these before it" if cells else "outside the terrain: latitude .*; 60 x 80 cells"
        with pytest.raises(ConfigError, match=sentence):
            cell_of(f"{first},{second}", place, "--at")


@pytest.mark.parametrize(
    ("text", "frame", "complaint"),
    [
        ("nowhere", ALPS, r"^--from is 'nowhere'; expected LAT,LON in degrees, xy:X,Y .* or cell:ROW,COL$"),
        ("nan,nan", ALPS, "expected LAT,LON"),
        ("", ALPS, "expected LAT,LON"),
        ("1" * 400, ALPS, "expected LAT,LON"),
        ("latlon:1e999,1", ALPS, r"expected a latitude \(-90 to 90\)"),
        ("1e999,1", ALPS, "outside the terrain"),
        ("500100.5,5199900", ALPS, "; did you mean 'xy:500100.5,5199900'\\?$"),
        ("xy:5199900,500100", ALPS, "; did you mean 'xy:500100,5199900'\\?$"),
        ("9.001,46.95", ALPS, "; did you mean 'latlon:46.95,9.001'\\?$"),
        ("latlon:9.001,46.95", ALPS, "; did you mean 'latlon:46.95,9.001'\\?$"),
        ("46.95  9.001", ALPS, "; did you mean '46.95,9.001'\\?$"),
        ("xy:500100; -5", ALPS, "; did you mean 'xy:500100,-5'\\?$"),
        ("500100,5199900", ALPS, r"outside the terrain: latitude 46\.\d+ to 46.*; 60 x 80 cells"),
        ("46.5,9.5", ALPS, r"outside the terrain: latitude 46\.\d+ to 46.*longitude 9"),
        ("xy:0,0", ALPS, "outside the terrain: x 500000 to 501600, y 5198800 to 5200000$"),
        ("xy:1e999,-1e999", ALPS, "outside the terrain"),
        ("cell:60,0", ALPS, "outside the terrain: 60 x 80 cells$"),
        ("cell:-1,0", SITE, "outside the terrain: 60 x 80 cells$"),
        ("latlon:46,9", SITE, "has no place on Earth; give xy:X,Y in its own metres or cell:ROW,COL, or say where"),
        ("46.81,9.84", SITE, r"outside the terrain: x 0 to 1600, y -1200 to 0$"),
        ("-90,0", ALPS, "outside the terrain"),
    ],
)
def test_a_bad_place_is_refused_in_a_sentence(text: str, frame: MapFrame, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as refused:
        cell_of(text, frame, "--from")
    assert "\n" not in str(refused.value)


def test_the_corners_of_an_area_are_read_in_one_way() -> None:
    square = ["10,10", "10,30", "25,30", "25,10"]
    assert corners_of(square, ALPS, "--polygon") == [(10, 10), (10, 30), (25, 30), (25, 10)]
    assert corners_of(square, SITE, "--polygon") == [(10, 10), (10, 30), (25, 30), (25, 10)]
    outside = corners_of(["46.95,9.001", "46.94,9.002", "cell:-3,5"], ALPS, "--polygon")
    assert outside[2] == (-3, 5)
    with pytest.raises(ConfigError, match="begins with '100,200', which may be a latitude and longitude"):
        corners_of(["100,200", "200,200", "200,300"], ALPS, "--polygon")
    with pytest.raises(ConfigError, match="far from the terrain"):
        corners_of(["xy:1e999,2", "46.95,9.001", "46.95,9.002"], ALPS, "--polygon")
    with pytest.raises(ConfigError, match="metres of the map"):
        corners_of(["0,0", "5,0", "5,-5"], MapFrame(GridSpec(9, 9, 1.0, 0.0, 5.0)), "--polygon")


def test_bounds_hold_all_cells_also_across_180_degrees() -> None:
    for name, frame in PLACED.items():
        box = bounds_of(frame)
        cells = np.random.default_rng(1).integers(0, frame.grid.cells, 50)
        for cell in cells.tolist():
            lat, lon = frame.to_wgs84(*frame.grid.centre_m(cell))
            lon += 360 if lon < box[1] - 1 else 0
            assert box[0] <= lat <= box[2]
            assert box[1] <= lon <= box[3], name
        assert "latitude" in extent_of(frame)
    across = bounds_of(PLACED["south, across 180 degrees"])
    assert across[1] < 180 < across[3]


@pytest.mark.parametrize("name", sorted(PLACED))
def test_a_program_and_a_command_agree_on_where_a_cell_is(name: str) -> None:
    """The client's frame goes by pyproj, the commands by rasterio."""
    pytest.importorskip("pyproj", reason="the extra wgs84 is not installed")
    ours = PLACED[name]
    client = Frame(ours.grid)
    for cell in (0, ours.grid.cells // 3, ours.grid.cells - 1):
        assert client.to_wgs84(*client.centre_m(cell)) == pytest.approx(
            ours.to_wgs84(*ours.grid.centre_m(cell)), abs=1e-8
        )
        assert client.cell_named(written(ours, cell).rpartition("latlon:")[2].rstrip(")")) == cell
        assert client.written(cell) == written(ours, cell)


def test_a_client_reads_places_without_pyproj() -> None:
    frame = Frame(SITE.grid)
    assert frame.cell_named("cell:2,3") == frame.cell_named((2, 3)) == frame.cell_named("70.0,-50.0") == 163
    assert frame.written(163) == "cell:2,3 (xy:70,-50)"


def test_places_of_a_rotated_file_are_those_of_its_own_transform(tmp_path: Path) -> None:
    """A value of a turned file at a longitude and latitude is found at the cell of that place."""
    turned = Affine.translation(500_000, 5_200_000) @ Affine.rotation(-30) @ Affine.scale(30, -30)
    heights = np.zeros((60, 60), np.float32)
    heights[20:24, 40:44] = 100.0
    heights += np.random.default_rng(1).uniform(0, 0.5, heights.shape).astype(np.float32)
    height_models.written(tmp_path / "turned.tif", heights, transform=turned)
    terrain = build_terrain(Scenario(terrain=TerrainConfig(source=str(tmp_path / "turned.tif"))))
    frame = MapFrame(terrain.grid)
    x_m, y_m = turned @ (42, 22)
    lat, lon = frame.to_wgs84(x_m, y_m)
    assert terrain.elevation_m.reshape(-1)[cell_of(f"{lat:.6f},{lon:.6f}", frame, "--at")] > 90


# --- in a scenario ----------------------------------------------------------------------------------------------


def test_a_scenario_takes_places_and_says_which_is_none() -> None:
    scenario = parse_scenario(
        """
        targets = [{ start = "46.95,9.005" }]
        groups = [{ vehicles = 3, cells = [[1, 2], "cell:3,4", "46.95,9.005"] }]
        [[cost.zones]]
        kind = "rough"
        polygon = ["46.95,9.0", "46.95,9.01", "46.945,9.01"]
        """
    )
    assert [cell_of(place, ALPS, "cells") for place in scenario.groups[0].cells] == [82, 244, 1539]
    (zone,) = scenario.cost.zones
    inside = zone_mask(zone, ALPS.grid)
    lat, lon = MapFrame(ALPS.grid).to_degrees(*middles_of(ALPS.grid, np.arange(ALPS.grid.cells))).reshape(2, 60, 80)
    expected = (lat <= 46.95) & (lon <= 9.01) & (lat >= 46.95 - (lon - 9.0) / 2)
    assert inside.sum() > 400
    assert (inside != expected).sum() <= 3
    for text, complaint in (
        ('[[targets]]\nstart = "there"', r"targets\[0\].start is 'there'; expected LAT,LON"),
        ("[[targets]]\nstart = [1]", "targets"),
        ('[[groups]]\ncells = ["1;2"]', r"groups\[0\].cells is '1;2'; expected"),
        ('[[cost.zones]]\nkind = "rough"\npolygon = ["a,b", "1,1", "2,2"]', r"cost.zones\[0\].polygon is 'a,b'"),
        ('[[cost.zones]]\nkind = "rough"\npolygon = ["1,1", "2,2"]', "polygon"),
        ('[[cost.zones]]\nkind = "rough"\npolygon = ["1,1", "2,2", "3,3"]\nmask = "a.png"', "exclude each other"),
        ('[[cost.zones]]\nkind = "rough"', "missing required field `polygon`"),
    ):
        with pytest.raises(ConfigError, match=complaint):
            parse_scenario(text)


def test_a_zone_that_lies_elsewhere_is_refused_with_the_extent_of_the_terrain() -> None:
    zone = ZoneConfig(kind="rough", polygon=("47.95,9.0", "47.95,9.01", "47.945,9.01"), name="elsewhere")
    with pytest.raises(TerrainError, match=r"zone 'elsewhere' covers no cell of the terrain: .*latitude 46"):
        zone_mask(zone, ALPS.grid)


def test_what_is_read_once_stays_what_it_is() -> None:
    place = read_place("46.95,9.005", "--at")
    assert read_place(place, "--at") is place
    assert cell_of(place, ALPS, "--at") == cell_of("46.95,9.005", ALPS, "--at")
