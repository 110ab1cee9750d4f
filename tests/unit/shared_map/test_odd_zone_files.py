"""Files of zones that are damaged, odd or hostile are refused in one sentence; rasters of paces and factors."""

from pathlib import Path

import numpy as np
import pytest
import shapely
from rasterio.transform import Affine, from_origin
from rasterio.warp import transform as to_crs
from support import height_models
from support.zone_shapes import UTM, feature, geojson, middles, painted, squares, written

from shared_map.importers.zones.zone_features import outlines_of
from shared_map.terrain.pace_layers import polygon_mask
from swarm.config.ground import ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec


def test_odd_shapes_are_taken_as_what_they_enclose(tmp_path: Path) -> None:
    turn = np.arange(5) * 4 * np.pi / 5
    star = shapely.Polygon(np.stack([20 + 12 * np.sin(turn), 20 - 12 * np.cos(turn)], axis=1))
    assert not star.is_valid
    three_d = shapely.Polygon([(40, 5, 100), (45, 5, 200), (45, 9, 300), (40, 9, 400)])
    mixed = shapely.GeometryCollection(
        [shapely.Point(3.5, 3.5), shapely.LineString([(1, 30), (9, 30.5)]), shapely.box(2, 8, 5, 11)]
    )
    file = geojson(tmp_path / "a.geojson", [feature(star, id=7), feature(mixed), feature(three_d)])
    pace, (facts,) = painted([ZoneConfig(kind="forbidden", file=file)])
    assert np.isinf(pace[[20, 3, 30, 9, 7], [20, 3, 5, 3, 42]]).all()  # the middle of the star, too
    assert facts.file.repaired == ["7"]
    assert facts.file.used == 3


def test_an_island_in_a_hole_is_closed_and_a_hole_in_a_hole_is_asked_about(tmp_path: Path) -> None:
    box, inner, core = (
        shapely.box(5.2, 5.2, 25.2, 25.2),
        shapely.box(8.2, 8.2, 22.2, 22.2),
        shapely.box(12, 12, 15, 15),
    )
    nested = shapely.MultiPolygon([box.difference(inner), core])
    pace, _ = painted([ZoneConfig(kind="forbidden", file=geojson(tmp_path / "a.geojson", [feature(nested)]))])
    assert pace[13, 13] == pace[6, 6] == np.inf
    assert pace[10, 10] < np.inf
    rings = shapely.Polygon(box.exterior, [inner.exterior, core.exterior])
    with pytest.raises(TerrainError, match=r"feature 0 cannot be used: a hole of it lies in another"):
        painted([ZoneConfig(kind="forbidden", file=geojson(tmp_path / "b.geojson", [feature(rings)]))])


def test_a_shape_that_crosses_itself_thousands_of_times_is_named_not_waited_for(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    scribble = shapely.Polygon(rng.uniform(5, 35, (4000, 2)))
    file = geojson(tmp_path / "a.geojson", [feature(scribble, id=99), feature(shapely.box(1, 1, 3, 3))])
    for kind in ("forbidden", "rough"):
        with pytest.raises(TerrainError, match="feature 99 cannot be used: it crosses itself thousands"):
            painted([ZoneConfig(kind=kind, file=file)])
    lines = geojson(tmp_path / "b.geojson", [feature(shapely.LineString(rng.uniform(5, 35, (500, 2))))])
    assert painted([ZoneConfig(kind="road", file=lines, width_m=3.0)])[1][0].cells > 500


def test_a_geopackage_of_several_layers_asks_which_and_views_are_no_layers(tmp_path: Path) -> None:
    import sqlite3

    file = written(tmp_path / "a.gpkg", [shapely.box(1, 1, 3, 3)], UTM.crs, layer="roads")
    written(tmp_path / "a.gpkg", [shapely.box(1, 1, 5, 5)], UTM.crs, layer="lakes", append=False)
    with pytest.raises(TerrainError, match="has 2 layers; set layer to one of roads, lakes"):
        painted([ZoneConfig(kind="forbidden", file=file)])
    with pytest.raises(TerrainError, match=r"has no layer 'lake', only roads, lakes; did you mean 'lakes'\?"):
        painted([ZoneConfig(kind="forbidden", file=file, layer="lake")])
    _, (facts,) = painted([ZoneConfig(kind="factor", factor=2.0, file=file, layer="lakes")])
    assert facts.cells == 16
    assert "from a.gpkg layer 'lakes' in EPSG:32632: 1 of 1 features" in facts.sentence(UTM.cells)
    database = sqlite3.connect(file)
    with database:
        database.execute("DROP TABLE lakes")
        database.execute(
            "CREATE VIEW lakes AS WITH RECURSIVE n(fid) AS (SELECT 1 UNION ALL SELECT fid + 1 FROM n)"
            " SELECT n.fid AS fid, roads.geom AS geom FROM n, roads"
        )
    database.close()
    with pytest.raises(TerrainError, match=r"'lakes' is a view, expected a table|is damaged|has no layer 'lakes'"):
        painted([ZoneConfig(kind="forbidden", file=file, layer="lakes")])


# --- rasters of pace or factor ------------------------------------------------------------------------------


def raster(path: Path, values: np.ndarray, where: Affine, crs: str | None, nodata: float | None = -1.0) -> str:
    return str(height_models.written(path, values, None, transform=where, crs=crs, nodata=nodata))


def test_a_raster_gives_paces_or_factors_and_leaves_the_rest(tmp_path: Path) -> None:
    values = np.full((20, 25), 3.0, np.float32)
    values[0, :] = -1.0
    values[1, :] = np.inf
    file = raster(tmp_path / "a.tif", values, from_origin(500_100, 5_199_900, 10.0, 10.0), UTM.crs)
    pace, (facts,) = painted([ZoneConfig(kind="factor", file=file)])
    np.testing.assert_allclose(pace[[9, 10, 11, 12, 29, 30], 20], [0.1, 0.1, np.inf, 0.3, 0.3, 0.1])
    assert "factor zone from a.tif in EPSG:32632: 475 of 475 values" in facts.sentence(UTM.cells)
    pace, _ = painted([ZoneConfig(kind="pace", file=file)])
    np.testing.assert_allclose(pace[[11, 12], 20], [np.inf, 3.0])
    degrees = to_crs(UTM.crs, "EPSG:4326", [500_000.0, 500_500.0], [5_200_000.0, 5_199_600.0])
    (west, east), (north, south) = degrees
    fine = np.full((400, 500), 2.0, np.float32)
    fine[:, 250:] = 4.0
    place = from_origin(west, north, (east - west) / 500, (north - south) / 400)
    file = raster(tmp_path / "b.tif", fine, place, "EPSG:4326")
    pace, _ = painted([ZoneConfig(kind="factor", file=file)])
    np.testing.assert_allclose(pace[20, [5, 45]], [0.2, 0.4])
    place, nowhere = from_origin(500_100, 5_199_900, 10.0, 10.0), tmp_path / "e.tif"
    for kind, other, words in (
        (
            "factor",
            raster(tmp_path / "c.tif", values - 10, place, UTM.crs, None),
            r"holds -11, expected a factor of 1e",
        ),
        (
            "factor",
            raster(tmp_path / "d.tif", values, from_origin(0, 0, 10.0, 10.0), UTM.crs),
            "covers x 0..250, y -200",
        ),
        ("road", file, "is read as a raster, which goes with kind pace or factor of a scenario"),
        (
            "factor",
            raster(nowhere, values, place, None),
            "does not say in which coordinate system it is; set crs, for",
        ),
    ):
        with pytest.raises(TerrainError, match=words):
            painted([ZoneConfig(kind=kind, file=other)])
    local = GridSpec(UTM.rows, UTM.cols, 10.0, UTM.west_m, UTM.north_m)
    pace, _ = painted([ZoneConfig(kind="factor", file=str(nowhere), crs="local")], local)
    np.testing.assert_allclose(pace[[10, 11, 12], 20], [0.1, np.inf, 0.3])


# --- areas for orders ---------------------------------------------------------------------------------------


def test_areas_of_a_file_become_rings_that_a_keeper_takes(tmp_path: Path) -> None:
    star = shapely.Polygon([(5, 5), (15, 6), (14, 15), (6, 14)])
    overlapping = [shapely.box(25, 5, 35, 12), shapely.box(30, 10, 40, 20)]
    file = geojson(tmp_path / "a.geojson", [feature(each) for each in (star, *overlapping)], crs="EPSG:4326")
    rings = outlines_of(ZoneConfig(kind="forbidden", file=file), UTM, 256)
    assert sorted(len(ring) for (ring,) in rings) == [4, 8]
    rings.sort(key=lambda area: len(area[0]))
    for (ring,), shape in zip(rings, (star, shapely.union_all(overlapping)), strict=True):
        corners = tuple((10.0 * col, 10.0 * row) for row, col in ring)
        clear = shapely.distance(shape.boundary, middles()) > 0.02
        assert (polygon_mask(corners, UTM) == shapely.contains(shape, middles()))[clear].all()
    round_ = geojson(tmp_path / "b.geojson", [feature(shapely.Point(20, 20).buffer(15, 500))])
    ((ring,),) = outlines_of(ZoneConfig(kind="forbidden", file=round_), UTM, 256)
    assert 20 < len(ring) <= 256
    hole = geojson(tmp_path / "c.geojson", [feature(shapely.box(1, 1, 9, 9) - shapely.box(3, 3, 5, 5))])
    ((ring, inner),) = outlines_of(ZoneConfig(kind="forbidden", file=hole), UTM, 256)
    assert (len(ring), np.array(inner).round(3).min(), np.array(inner).round(3).max()) == (4, 3.0, 5.0)
    line = geojson(tmp_path / "d.geojson", [feature(shapely.LineString([(1, 1), (5, 5)]))])
    ((ring,),) = outlines_of(ZoneConfig(kind="forbidden", file=line), UTM, 256)
    crossed = shapely.length(shapely.intersection(shapely.LineString([(1, 1), (5, 5)]), squares())) > 1e-6
    assert polygon_mask([(10.0 * col, 10.0 * row) for row, col in ring], UTM)[crossed].all()
    comb = shapely.union_all([shapely.box(n, 1, n + 0.5, 20) for n in range(1, 40)] + [shapely.box(1, 19, 40, 21)])
    teeth = geojson(tmp_path / "e.geojson", [feature(comb)])
    with pytest.raises(TerrainError, match=r"of 1\d\d corners, at most 64 are ordered; simplify it"):
        outlines_of(ZoneConfig(kind="forbidden", file=teeth), UTM, 64)
