"""Zones from files: shapes in any coordinate system become the cells that they cover; bridges cross water."""

import json
import zipfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rasterio.warp import transform as to_crs
from scipy import ndimage
from support.zone_shapes import OPEN, UTM, feature, geojson, middles, painted, squares, written

from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.zones import paint_zones
from swarm.config.ground import WayConfig, ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec


def degrees_of_middles(grid: GridSpec) -> tuple[np.ndarray, np.ndarray]:
    """(longitude, latitude) of the middle of each cell."""
    rows, cols = np.indices(grid.shape) + 0.5
    xs, ys = grid.west_m + grid.resolution_m * cols, grid.north_m - grid.resolution_m * rows
    lon, lat = to_crs(grid.crs, "EPSG:4326", xs.ravel(), ys.ravel())
    return np.reshape(lon, grid.shape), np.reshape(lat, grid.shape)


def drawn(path: Path, geometry: object) -> str:
    """A file of one geometry as it is, in degrees."""
    path.write_text(json.dumps(geometry))
    return str(path)


@st.composite
def blobs(draw: st.DrawFn) -> Any:
    """A star-shaped polygon with a hole, on and beyond the terrain."""
    count = draw(st.integers(3, 12))
    reach = np.array(draw(st.lists(st.floats(3.0, 25.0), min_size=count, max_size=count)))
    centre = np.array([draw(st.floats(-5.0, 55.0)), draw(st.floats(-5.0, 45.0))])
    angle = np.arange(count) / count * 2 * np.pi
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outer, hole = centre + ring * reach[:, None], centre + ring * reach[:, None] * draw(st.floats(0.1, 0.6))
    return shapely.Polygon(outer, [hole])


@settings(max_examples=8)
@given(blobs(), st.sampled_from(["EPSG:4326", "EPSG:32632", "EPSG:3857"]))
def test_areas_cover_the_cells_whose_middle_they_hold_and_lethal_ones_all_that_they_touch(
    tmp_path_factory: pytest.TempPathFactory, blob: Any, crs: str
) -> None:
    if not blob.is_valid or not blob.intersects(shapely.box(0, 0, UTM.cols, UTM.rows)):
        return
    file = geojson(tmp_path_factory.mktemp("zone") / "a.geojson", [feature(blob)], crs=crs)
    slow, _ = painted([ZoneConfig(kind="factor", file=file, factor=3.0)])
    closed, _ = painted([ZoneConfig(kind="forbidden", file=file)])
    clear = shapely.distance(blob.boundary, middles()) > 1e-4  # of a cell: a middle on the edge may go either way
    assert ((slow > 0.2) == shapely.contains(blob, middles()))[clear].all()
    touched = shapely.intersects(blob.buffer(-1e-4), squares())
    beyond = ~shapely.intersects(blob.buffer(1e-4), squares())
    assert np.isinf(closed[touched]).all()
    assert np.isfinite(closed[beyond]).all()


@settings(max_examples=8)
@given(
    st.lists(st.tuples(st.floats(-10, 60), st.floats(-10, 50)), min_size=2, max_size=6, unique=True),
    st.integers(5, 900).map(lambda tenths: tenths / 10),
)
def test_lines_are_as_wide_as_they_are_and_never_broken(tmp_path_factory, corners, width_m):
    line = shapely.LineString(corners)
    if not line.intersects(shapely.box(0, 0, UTM.cols, UTM.rows)):
        return
    path = tmp_path_factory.mktemp("zone") / "a.geojson"
    file = geojson(path, [feature(line, highway="road", width=f"{width_m} m")])
    pace, _ = painted([ZoneConfig(kind="road", file=file)])
    road = pace < 0.09
    away_m = UTM.resolution_m * shapely.distance(line, middles())
    assert road[shapely.length(shapely.intersection(line, squares())) > 1e-3].all()
    inner, outer = away_m < width_m / 2 * 0.99 - 0.01, away_m > width_m / 2 + 0.01
    assert road[inner].all()
    assert not road[outer & ~shapely.intersects(line.buffer(1e-4), squares())].any()


# --- roads, water, bridges ----------------------------------------------------------------------------------


def crossing(path: Path, bridge: dict[str, str], width_m: float = 4.0, grid: GridSpec = UTM) -> list[ZoneConfig]:
    """A river from north to south and a road across it, of which the piece over the river may be a bridge."""
    bank = (0.5 * 20.0 + 1.0) / grid.resolution_m
    middle, row = grid.cols / 2 + 0.3, grid.rows / 2 + 0.4
    at = [0.5, middle - bank, middle + bank, grid.cols - 0.5]
    roads = [shapely.LineString([(a, row), (b, row)]) for a, b in pairwise(at)]
    features = [
        feature(shapely.LineString([(middle, -1), (middle, grid.rows + 1)]), waterway="river", width="20"),
        feature(roads[0], highway="primary", width=width_m),
        feature(roads[1], highway="primary", width=width_m, **bridge),
        feature(roads[2], highway="primary", width=width_m),
    ]
    file = geojson(path, features, grid)
    return [ZoneConfig(kind="road", file=file), ZoneConfig(kind="water", file=file)]


def sides_meet(pace: np.ndarray) -> bool:
    parts, _ = ndimage.label(np.isfinite(pace), np.ones((3, 3)))
    return bool(parts[3, 2] == parts[3, -3])


@pytest.mark.parametrize("resolution_m", [2.0, 10.0, 30.0, 75.0])
@pytest.mark.parametrize("order", [1, -1])
def test_water_closes_a_road_and_a_bridge_opens_the_water(tmp_path: Path, resolution_m: float, order: int) -> None:
    grid = GridSpec(30, 40, resolution_m, 500_000.0, 5_200_000.0, "EPSG:32632")
    closed, _ = painted(crossing(tmp_path / "a.geojson", {}, grid=grid)[::order], grid)
    assert not sides_meet(closed)
    for value in ("yes", "viaduct", "T"):
        classes = np.zeros(closed.shape, np.uint8)
        zones = crossing(tmp_path / "b.geojson", {"bridge": value}, grid=grid)[::order]
        pace, facts = painted(zones, grid, classes=classes)
        assert sides_meet(pace)
        opened = np.isfinite(pace) & np.isinf(closed)
        assert (pace[opened] == np.float32(0.05)).all()
        assert (classes[opened] == TerrainClass.ROAD).all()
        assert (classes[np.isinf(pace)] == TerrainClass.WATER).all()
        rows = np.flatnonzero(opened.any(axis=1))  # only beneath the road
        assert len(rows) <= max(3, 8 / resolution_m + 2)
        road = next(each for each in facts if each.kind == "road")
        assert (road.file.bridges, road.opened) == (1, int(opened.sum()))
    for value in ("no", "F", "aqueduct"):
        pace, _ = painted(crossing(tmp_path / "c.geojson", {"bridge": value}, grid=grid), grid)
        assert not sides_meet(pace)


def test_a_road_along_the_water_is_not_opened_by_a_bridge_elsewhere(tmp_path: Path) -> None:
    quay = shapely.LineString([(25.3, 2), (25.3, 19.9)])
    zones = crossing(tmp_path / "a.geojson", {"bridge": "yes"})
    raw = json.loads((tmp_path / "a.geojson").read_text())
    extra = json.loads(Path(geojson(tmp_path / "b.geojson", [feature(quay, highway="track")])).read_text())
    (tmp_path / "a.geojson").write_text(json.dumps(raw | {"features": raw["features"] + extra["features"]}))
    pace, _ = painted(zones)
    assert sides_meet(pace)
    assert np.isinf(pace[2:15, 25]).all()


def test_what_is_forbidden_wins_over_bridges_and_roads_open_closed_ground_but_no_voids(tmp_path: Path) -> None:
    zones = crossing(tmp_path / "a.geojson", {"bridge": "yes"})
    shut = ZoneConfig(kind="forbidden", polygon_m=((240, 180), (270, 180), (270, 230), (240, 230)))
    assert not sides_meet(painted([shut, *zones])[0])
    pace = np.full((UTM.rows, UTM.cols), np.inf, np.float32)
    void = np.zeros(pace.shape, np.bool_)
    void[:, 10] = True
    paint_zones(pace, zones[:1], UTM, OPEN, void)
    assert np.isfinite(pace[20, 1:9]).all()
    assert np.isinf(pace[20, 10])


def test_classes_of_roads_and_water_are_those_of_openstreetmap_or_ones_own(tmp_path: Path) -> None:
    def line(row: float) -> Any:
        return shapely.LineString([(2, row), (48, row)])

    file = geojson(
        tmp_path / "a.geojson",
        [
            feature(line(2.5), highway="motorway_link"),
            feature(line(6.5), highway="path"),
            feature(line(10.5), id="way/17", highway="steps"),
            feature(line(14.5), highway="primary", tunnel="yes"),
            feature(line(18.5), other_tags='"highway"=>"track","bridge"=>"yes"'),
            feature(line(22.5), waterway="stream"),
            feature(line(26.5), waterway="ditch", tunnel="culvert"),
            feature(line(30.5), waterway="weir"),
            feature(shapely.box(2, 33.2, 48, 36.9), natural="water"),
            feature(shapely.box(2, 38.2, 48, 39.9), natural="wood"),
        ],
    )
    pace, (roads, water) = painted([ZoneConfig(kind="road", file=file), ZoneConfig(kind="water", file=file)])
    np.testing.assert_allclose(
        pace[[2, 6, 10, 14, 18, 22, 26, 30, 33, 34, 36, 38], 20],
        [0.05, 0.1, 0.1, 0.1, 0.1, 0.2, 0.1, 0.1, np.inf, np.inf, np.inf, 0.1],
        rtol=1e-6,
    )
    assert water.file is not None
    assert dict(roads.file.skipped) == {"of class steps": 1, "below the ground": 1, "without a class": 5}
    assert roads.file.named["of class steps"] == ["way/17"]
    assert (roads.file.used, roads.file.bridges) == (3, 1)
    own = {
        "steps": WayConfig(factor=4.0, width_m=30.0),
        "path": WayConfig(factor="ignored"),
        "track": WayConfig(factor="lethal"),
    }
    pace, _ = painted([ZoneConfig(kind="road", file=file, classes=own)], ground=1.0)
    np.testing.assert_allclose(pace[[6, 9, 10, 11, 18], 20], [1.0, 0.2, 0.2, 0.2, np.inf])
    assert "left out: 5 without a class, 1 of class steps (feature way/17)" in roads.sentence(UTM.cells)


def test_factors_and_paces_come_from_a_column_a_value_or_a_class(tmp_path: Path) -> None:
    boxes = [shapely.box(x, y, x + 8, y + 8) for x, y in ((2, 2), (6, 6), (20, 2), (30, 2))]
    columns = {"f": [2.0, 3.0, np.nan, -1.0], "kind": ["mud", "sand", "mud", "ice"]}
    file = written(tmp_path / "a.gpkg", boxes, UTM.crs, columns)
    pace, (facts,) = painted([ZoneConfig(kind="factor", file=file, attribute="f")])
    np.testing.assert_allclose(pace[[3, 8, 12, 3, 3], [3, 8, 12, 22, 32]], [0.2, 0.3, 0.3, 0.1, 0.1])  # the slower
    assert sum(facts.file.skipped.values()) == 2
    assert "4 (-1.0)" in facts.sentence(UTM.cells)
    own = {"mud": WayConfig(factor=5.0), "ice": WayConfig(factor="lethal")}
    pace, _ = painted([ZoneConfig(kind="factor", file=file, attribute="kind", classes=own)])
    np.testing.assert_allclose(pace[[3, 12, 3, 3], [3, 12, 22, 32]], [0.5, 0.1, 0.5, np.inf])
    pace, _ = painted([ZoneConfig(kind="pace", file=file, pace_s_per_m=0.7)])
    np.testing.assert_allclose(pace[[3, 20], [3, 3]], [0.7, 0.1])
    pace, _ = painted([ZoneConfig(kind="pace", file=file, pace_s_per_m=0.7)], ground=np.inf)
    assert np.isinf(pace).all()  # a pace opens nothing
    for kind, column, words in (
        ("pace", None, r"set pace_s_per_m, or attribute to the column that holds it; it has the"),
        ("pace", "g", r"has no column 'g'; it has the columns f, kind"),
        ("road", None, r"has no column highway or fclass; set attribute .* or width_m; it has"),
        ("road", "kind", r"none of its features on the terrain counts \(2 of class mud"),
    ):
        with pytest.raises(TerrainError, match=words):
            painted([ZoneConfig(kind=kind, file=file, attribute=column)])
    roads, _ = painted([ZoneConfig(kind="road", file=file, width_m=5.0)])
    assert roads[3, 3] == np.float32(0.05)


# --- coordinate systems -------------------------------------------------------------------------------------


def test_the_same_shapes_give_the_same_cells_in_every_system_and_kind_of_file(tmp_path: Path) -> None:
    shapes = [
        shapely.box(3.3, 4.4, 17.7, 12.2),
        shapely.MultiPolygon([shapely.box(30, 20, 33, 22), shapely.box(40, 20, 44, 31)]),
    ]
    zone = {"kind": "factor", "factor": 2.0}
    expected, _ = painted([ZoneConfig(file=geojson(tmp_path / "a.geojson", [feature(s) for s in shapes]), **zone)])
    assert (expected > 0.1).sum() == 15 * 8 + 6 + 44
    files = {
        written(tmp_path / "utm.gpkg", shapes, "EPSG:32632", geometry_type="Unknown"): None,
        written(tmp_path / "mercator.shp", shapes, "EPSG:3857"): None,
        written(tmp_path / "lambert.gpkg", shapes, "EPSG:3035", geometry_type="Unknown"): None,
    }
    with zipfile.ZipFile(tmp_path / "z.zip", "w") as archive:
        for ending in ("shp", "shx", "dbf", "prj"):
            archive.write(tmp_path / f"mercator.{ending}", f"in/a/folder.{ending}")
    files[str(tmp_path / "z.zip")] = None
    (tmp_path / "renamed.dat").write_bytes((tmp_path / "utm.gpkg").read_bytes())
    files[str(tmp_path / "renamed.dat")] = None
    (tmp_path / "mercator.prj").unlink()
    with pytest.raises(TerrainError, match="does not say in which coordinate system it is; set crs, for example"):
        painted([ZoneConfig(file=str(tmp_path / "mercator.shp"), **zone)])
    files[str(tmp_path / "mercator.shp")] = "EPSG:3857"
    for file, crs in files.items():
        pace, _ = painted([ZoneConfig(file=file, crs=crs, **zone)])
        np.testing.assert_array_equal(pace, expected, err_msg=file)
    nowhere = GridSpec(UTM.rows, UTM.cols, 10.0, UTM.west_m, UTM.north_m)
    pace, _ = painted([ZoneConfig(file=str(tmp_path / "utm.gpkg"), crs="local", **zone)], nowhere)
    np.testing.assert_array_equal(pace, expected)
    with pytest.raises(
        TerrainError, match=r"in EPSG:32632, and the terrain has no place; set terrain.crs, or crs = 'local'"
    ):
        painted([ZoneConfig(file=str(tmp_path / "utm.gpkg"), **zone)], nowhere)


def test_long_edges_are_bent_as_the_map_bends_them(tmp_path: Path) -> None:
    wide = GridSpec(100, 200, 1000.0, 400_000.0, 7_100_000.0, "EPSG:32632")
    area = {"type": "Polygon", "coordinates": [[[3, 63.5], [15, 63.5], [15, 66], [3, 66], [3, 63.5]]]}
    pace, _ = painted([ZoneConfig(kind="factor", factor=2.0, file=drawn(tmp_path / "a.geojson", area))], wide)
    _, north = degrees_of_middles(wide)
    clear = abs(north - 63.5) > 1e-6
    assert ((pace > 0.1) == (north > 63.5))[clear].all()
    assert 0.1 < (pace > 0.1).mean() < 0.9


def test_a_terrain_across_180_degrees_has_zones_on_both_sides(tmp_path: Path) -> None:
    west_m, north_m = (float(v[0]) for v in to_crs("EPSG:4326", "EPSG:3994", [179.7], [-17.0]))
    grid = GridSpec(40, 60, 1000.0, west_m, north_m, "EPSG:3994")

    def ring(west: float, east: float) -> list[list[float]]:
        return [[west, -17.2], [east, -17.2], [east, -17.1], [west, -17.1], [west, -17.2]]

    cut = {"type": "MultiPolygon", "coordinates": [[ring(179.8, 180)], [ring(-180, -179.9)]]}
    beyond = {"type": "Polygon", "coordinates": [ring(179.8, 180.1)]}
    lon, lat = degrees_of_middles(grid)
    lon %= 360
    inside = (lon > 179.8) & (lon < 180.1) & (lat > -17.2) & (lat < -17.1)
    assert inside.sum() > 150
    for area in (cut, beyond):
        zone = ZoneConfig(kind="factor", factor=2.0, file=drawn(tmp_path / "a.geojson", area))
        pace, (facts,) = painted([zone], grid)
        assert facts.file.used == 1
        np.testing.assert_array_equal(pace > 0.1, inside)
    uncut = {"type": "Polygon", "coordinates": [ring(179.8, -179.9)]}
    with pytest.raises(TerrainError, match=r"feature 0 cannot be used: an edge .* 180 degrees"):
        painted([ZoneConfig(kind="forbidden", file=drawn(tmp_path / "a.geojson", uncut))], grid)


@settings(max_examples=8)
@given(
    st.lists(st.floats(8, 42), min_size=3, max_size=7),
    st.lists(st.tuples(st.floats(0, 50), st.floats(0, 40)), min_size=2, max_size=6, unique=True),
    st.sampled_from([0.5, 4.0, 15.0, 60.0]),
)
def test_no_road_crosses_a_river_without_a_bridge(tmp_path_factory, bends, roads, width_m):
    rows = np.linspace(-2, UTM.rows + 2, len(bends))
    river = shapely.LineString(np.stack([bends, rows], axis=1))
    way = shapely.LineString([(-3, 20), *roads, (53, 20)])
    features = [feature(river, waterway="river", width=width_m), feature(way, highway="primary", width=9)]
    file = geojson(tmp_path_factory.mktemp("zone") / "a.geojson", features)
    pace, _ = painted([ZoneConfig(kind="water", file=file), ZoneConfig(kind="road", file=file)])
    parts, _ = ndimage.label(np.isfinite(pace), np.ones((3, 3)))
    assert not np.intersect1d(parts[:, 0], parts[:, -1]).any()


@settings(max_examples=8)
@given(
    st.floats(-0.7, 0.7),
    st.floats(20, 30),
    st.floats(18, 22),
    st.floats(0, 1),
    st.sampled_from([1.0, 8.0, 20.0, 70.0]),
)
@example(lean=0.0, col=20.0, row=19.0, turn=0.0, width_m=1.0)
def test_a_bridge_as_long_as_its_river_is_wide_joins_both_banks(tmp_path_factory, lean, col, row, turn, width_m):
    """Roads which meet the river at 45 degrees or more."""
    river = shapely.LineString([(col - 60 * lean, row - 60), (col + 60 * lean, row + 60)])
    slope = np.tan((turn - 0.5) * (np.pi / 2 - 2 * abs(np.arctan(lean))) * 0.9)
    road = shapely.LineString([(col - 60, row - 60 * slope), (col + 60, row + 60 * slope)])
    over = road.intersection(river.buffer(width_m / 2 / UTM.resolution_m))
    features = [
        feature(river, waterway="river", width=width_m),
        feature(over, highway="primary", bridge="yes"),
        *(feature(each, highway="primary") for each in shapely.get_parts(road.difference(over))),
    ]
    file = geojson(tmp_path_factory.mktemp("zone") / "a.geojson", features)
    pace, _ = painted([ZoneConfig(kind="road", file=file), ZoneConfig(kind="water", file=file)])
    parts, _ = ndimage.label(np.isfinite(pace))
    assert parts[int(row), 1] != 0 or parts[:, 0].any()
    assert np.intersect1d(parts[:, 0][parts[:, 0] > 0], parts[:, -1][parts[:, -1] > 0]).size
