"""Files of zones with any damage: all features close their ground, or the file is refused by name."""

import itertools
import json
import os
import random
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.zone_shapes import UTM, feature, geojson, in_crs, middles, painted, squares, written

from launch_scripts.check.scenario_check import files_named
from shared_map.importers.zones.zone_features import outlines_of
from shared_map.terrain.pace_layers import polygon_mask
from swarm.config.ground import CostConfig, ZoneConfig
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError

Damage = Callable[[dict[str, Any], random.Random], None]


def spot(at: Any, chance: random.Random) -> list[Any]:
    """A list of coordinates somewhere in a geometry."""
    while not isinstance(at[0][0], float):
        at = chance.choice(at)
    return at  # type: ignore[no-any-return]


def opened(f: dict[str, Any], chance: random.Random) -> None:
    ring = spot(f["geometry"]["coordinates"], chance)
    if ring[0] != ring[-1]:
        raise IndexError("a line has no ring to open")
    ring.pop()


def coordinate(value: Any) -> Damage:
    def damage(f: dict[str, Any], chance: random.Random) -> None:
        line = spot(f["geometry"]["coordinates"], chance)
        line[chance.randrange(len(line))] = value

    return damage


def geometry(make: Callable[[dict[str, Any]], Any]) -> Damage:
    def damage(f: dict[str, Any], chance: random.Random) -> None:
        f["geometry"] = make(f["geometry"])

    return damage


def collection(*more: Any) -> Damage:
    return geometry(lambda g: {"type": "GeometryCollection", "geometries": [*more, g]})


def reverse(f: dict[str, Any], chance: random.Random) -> None:
    turned = shapely.transform(shapely.geometry.shape(f["geometry"]), lambda p: p[:, ::-1])
    f["geometry"] = shapely.geometry.mapping(turned)


KINDS = ["forbidden", "water", "factor", "keep_in"]
DAMAGES: dict[str, Damage] = {
    "open ring": opened,
    "text": lambda f, chance: spot(f["geometry"]["coordinates"], chance).__setitem__(0, ["9.0", "46.9"]),
    "null number": coordinate([None, 46.94]),
    "null place": coordinate(None),
    "one number": coordinate([9.0]),
    "no number": coordinate([float("nan"), 46.94]),
    "infinite": coordinate([float("inf"), 46.94]),
    "truth": coordinate([True, 46.94]),
    "object": coordinate({"lon": 9.0, "lat": 46.9}),
    "far": coordinate([9.0, 4e6]),
    "null shape": geometry(lambda g: None),
    "no shape": lambda f, chance: f.pop("geometry"),
    "no coordinates": lambda f, chance: f["geometry"].pop("coordinates"),
    "empty": lambda f, chance: f["geometry"].update(coordinates=[]),
    "empty part": lambda f, chance: f["geometry"]["coordinates"].append([]),
    "too deep": lambda f, chance: f["geometry"].update(coordinates=[f["geometry"]["coordinates"]]),
    "too flat": lambda f, chance: f["geometry"].update(coordinates=f["geometry"]["coordinates"][0]),
    "small letters": lambda f, chance: f["geometry"].update(type=f["geometry"]["type"].lower()),
    "unknown type": lambda f, chance: f["geometry"].update(type="Circle"),
    "list in a list": lambda f, chance: f.update(type="FeatureCollection", features=[dict(f)]),
    "collection": collection(),
    "nested": collection({"type": "GeometryCollection", "geometries": [{"type": "Point", "coordinates": [9, 46]}]}),
    "collection of null": collection(None),
    "collection of circles": collection({"type": "Circle", "coordinates": [9.0, 46.9]}),
    "reverse": reverse,
}


@st.composite
def shapes(draw: st.DrawFn) -> list[Any]:
    """Shapes on the terrain, beyond it, and in several parts."""
    made = []
    for _ in range(draw(st.integers(1, 4))):
        col, row = draw(st.integers(0, 44)), draw(st.integers(0, 34))
        area = shapely.box(col + 0.2, row + 0.3, col + 4.7, row + 4.6)
        hole = area.difference(shapely.box(col + 1.5, row + 1.5, col + 2.5, row + 2.5))
        line = shapely.LineString([(col, row + 0.4), (col + 3, row + 2.1), (col + 6, row + 0.2)])
        several = shapely.MultiPolygon([area, shapely.box(col + 5.5, row, col + 6.5, row + 1)])
        made.append(draw(st.sampled_from([area, hole, line, several, shapely.box(900, 900, 905, 905)])))
    return [shapely.box(1.1, 1.1, 2.9, 2.9), *made]


def closed_by(file: str, kind: str) -> np.ndarray:
    slow = {"factor": 2.0} if kind == "factor" else {}
    pace, _ = painted([ZoneConfig(kind=kind, file=file, width_m=3.0, **slow)])  # type: ignore[arg-type]
    return np.asarray(pace != np.float32(0.1))


@settings(max_examples=few(400))
@given(shapes(), st.sampled_from(sorted(DAMAGES)), st.sampled_from(KINDS), st.integers())
def test_a_damaged_feature_closes_its_ground_or_ends_the_start(tmp_path_factory, drawn, name, kind, seed):
    chance, path = random.Random(seed), tmp_path_factory.mktemp("damage") / "a.geojson"
    if kind == "keep_in":
        drawn = [shape for shape in drawn if shape.geom_type != "LineString"]
    file = geojson(path, [feature(shape) for shape in drawn])
    text = json.loads(path.read_text())
    before = closed_by(file, kind)
    hurt = text["features"][chance.randrange(len(drawn))]
    try:
        DAMAGES[name](hurt, chance)
    except (IndexError, TypeError, KeyError):
        return  # it does not go with this shape
    path.write_text(json.dumps(text))
    refused = ""
    try:
        assert (closed_by(file, kind) == before).all()
    except TerrainError as error:
        refused = str(error)
    if refused:
        assert re.fullmatch(r".*a\.geojson.*", refused)
        with pytest.raises(TerrainError):
            outlines_of(ZoneConfig(kind="forbidden", file=file, width_m=3.0), UTM, 256)


# --- other formats ------------------------------------------------------------------------------------------

AREA = shapely.box(10.3, 10.3, 20.6, 18.4)
CORNERS = shapely.get_coordinates(in_crs(AREA, UTM, "EPSG:4326"))[:-1]
RING = " ".join(f"{x:.10f},{y:.10f}" for x, y in [*CORNERS, CORNERS[0]])
MIDDLE = shapely.get_coordinates(in_crs(shapely.Point(15.5, 14.5), UTM, "EPSG:4326"))[0]


def kml(inside: str) -> str:
    return f'<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document>{inside}</Document></kml>'


def placemark(ring: str) -> str:
    ring = f"<LinearRing><coordinates>{ring}</coordinates></LinearRing>"
    return f"<Placemark><Polygon><outerBoundaryIs>{ring}</outerBoundaryIs></Polygon></Placemark>"


def osm(ways: str) -> str:
    nodes = "".join(f'<node id="{n}" lat="{y:.10f}" lon="{x:.10f}"/>' for n, (x, y) in enumerate(CORNERS, 1))
    return f'<?xml version="1.0"?><osm version="0.6">{nodes}{ways}</osm>'


def way(*nodes: int, says: str = "") -> str:
    refs = "".join(f'<nd ref="{n}"/>' for n in nodes)
    return f'<way id="7" {says}>{refs}<tag k="natural" v="water"/></way>'


def plan(polygons: list[Any], circles: list[Any] | None = None, **more: Any) -> str:
    fence = {"version": 2, "polygons": polygons, "circles": circles or []}
    return json.dumps({"fileType": "Plan", "groundStation": "QGroundControl", "geoFence": fence, **more})


def waypoints(*rows: tuple[int, float, Any]) -> str:
    lines = [
        f"{n}\t0\t3\t{c}\t{extent}\t0\t0\t0\t{y:.10f}\t{x:.10f}\t0\t1" for n, (c, extent, (x, y)) in enumerate(rows)
    ]
    return "\n".join(["QGC WPL 110", *lines])


SPOT = "<Point><coordinates>9,46</coordinates></Point>"
BOX = zip(("west", "south", "east", "north"), [*CORNERS.min(axis=0), *CORNERS.max(axis=0)], strict=True)
SIDES = "".join(f"<{side}>{at:.10f}</{side}>" for side, at in BOX)
PICTURE = f"<GroundOverlay><LatLonBox>{SIDES}<rotation>0</rotation></LatLonBox></GroundOverlay>"
LATLON = [[y, x] for x, y in CORNERS]
DISC = {"circle": {"center": MIDDLE[::-1].tolist(), "radius": 40.0}, "inclusion": False}
FEATURE = json.dumps({"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(
    in_crs(AREA, UTM, "EPSG:4326"))})  # fmt: skip
SAME = {
    "lines of geojson": FEATURE.replace("[[[", "[\n[[") + "\n",
    "geojson lines": f"{FEATURE}\n{FEATURE}\n",
    "geojson sequence": f"\x1e{FEATURE}\n\x1e{FEATURE}\n",
    "a line of one place": f'{FEATURE}\n{{"type": "LineString", "coordinates": {[MIDDLE.tolist()] * 2}}}',
    "kml": kml(f"<Folder><name>a</name>{placemark(RING)}</Folder>"),
    "kml with a picture that is not turned": kml(PICTURE),
    "kml with spaces": kml(placemark(RING.replace(" ", " " * 1_000_000, 1).replace(",", ", "))),
    "open kml": kml(placemark(RING.rpartition(" ")[0])),
    "osm": osm(way(1, 2, 3, 4, 1)),
    "osm of an editor": re.sub(r'(id|ref)="', r'\1="-', osm(way(1, 2, 3, 4, 1))),
    "plan": plan([{"inclusion": False, "polygon": LATLON}]),
    "waypoints": waypoints(*((5002, 4, corner) for corner in CORNERS)),
}
DAMAGED = {
    "nothing": "",
    "words": "not a map at all",
    "other json": '{"a": 1}',
    "cut off": FEATURE[:-9],
    "deep": '{"type": "FeatureCollection", "features":' + "[" * 100_000,
    "elsewhere": '{"type": "Point", "coordinates": [100.0, 20.0]}',
    "metres": '{"type": "Point", "coordinates": [500100.0, 5199900.0]}',
    "huge": '{"type": "Point", "coordinates": [1e300, -1e300]}',
    "no number": '{"type": "Point", "coordinates": [1e999, -1e999]}',
    "sqlite": "SQLite format 3\0" + "x" * 5000,
    "geopackage": "SQLite format 3\0".ljust(68, "x") + "GPKG" + "x" * 5000,
    "shapefile": "\0\0\x27\x0a" + "\x7f" * 500,
    "zip": "PK\3\4" + "x" * 200,
    "lines cut off": f"{FEATURE}\n{FEATURE[:-9]}",
    "kml of words": kml(placemark(RING.replace(f"{CORNERS[1][0]:.10f}", "east"))),
    "kml of underscores": kml(placemark(RING.replace(f"{CORNERS[1][0]:.10f}", "9_0"))),
    "kml of one number": kml(placemark(RING + " 9.0")),
    "kml of two borders": kml(placemark(RING).replace("</Polygon>", f"{placemark(RING)[20:-22]}</Polygon>")),
    "kml of two shapes": kml(placemark(RING).replace("</Placemark>", f"{SPOT}</Placemark>")),
    "kml of a ring": kml(f"<Placemark>{SPOT.replace('Point', 'LinearRing')}</Placemark>"),
    "kml of a turned picture": kml(PICTURE.replace(">0<", ">0.5<") + placemark(RING)),
    "kml without corners": kml(placemark("")),
    "kml without a shape": kml("<Placemark><name>a</name></Placemark>" + placemark(RING)),
    "linked kml": kml("<NetworkLink><Link><href>http://127.0.0.1:9/a.kml</href></Link></NetworkLink>"),
    "kml cut off": kml(placemark(RING))[:-20],
    "osm without a node": osm(way(1, 2, 99, 4, 1)),
    "osm of an open area": osm(way(1, 2, 4, 3)),
    "osm of a deleted way": osm(way(1, 2, 3, 1, says='action="delete"')),
    "osm as PBF": "\0\0\0\r\n\tOSMHeader",
    "osm as JSON": '{"version": 0.6, "generator": "Overpass API", "elements": []}',
    "osm of words": osm(way(1, 2, 3, 4, 1)).replace('lat="', 'lat="N'),
    "gpx of words": '<?xml version="1.0"?><gpx version="1.1"><wpt lat="46" lon="x"/></gpx>',
    "gpx without places": '<?xml version="1.0"?><gpx version="1.1"></gpx>',
    "virtual": "<?xml version='1.0'?><kml><OGRVRTDataSource/></kml>",
    "system as text": f'{FEATURE[:-1]}, "crs": "EPSG:4326"}}',
    "system of no name": FEATURE[:-1] + ', "crs": {"type": "name", "properties": {"title": "EPSG:4326"}}}',
    "system unknown": FEATURE[:-1] + ', "crs": {"type": "name", "properties": {"name": "EPSG:99999"}}}',
    "system of one feature": f'{FEATURE}\n{FEATURE[:-1]}, "crs": {{"type": "OGC", "properties": {{}}}}}}',
    "features twice": f'{{"type": "FeatureCollection", "features": [{FEATURE}], "features": []}}',
    "topojson": '{"type": "Topology", "objects": {}, "arcs": []}',
    "arcgis": '{"geometryType": "esriGeometryPolygon", "features": []}',
    "plan without a fence": json.dumps({"fileType": "Plan", "mission": {"items": []}}),
    "plan of words": plan([{"inclusion": False, "polygon": [["a", "b"], *LATLON[1:]]}]),
    "plan of nothing": plan([]),
    "plan without radius": plan([], [{**DISC, "circle": {"center": LATLON[0]}}]),
    "waypoints of less": waypoints(*((5002, 5, corner) for corner in CORNERS)),
    "waypoints of parts": waypoints(*((5002, 4.5, corner) for corner in CORNERS)),
    "waypoints of words": waypoints(*((5002, 4, corner) for corner in CORNERS)).replace("\t0\t3\t", "\tx\t3\t"),
    "circle of nothing": waypoints((5004, 0, MIDDLE)),
    "fen": "#saved by Mission Planner\n46.9\t9\n",
    "poly": "none\n1\n   9.0  46.9\n   9.1 46.9\nEND\nEND\n",
    "parquet": "PAR1....",
    "inav": "geozone 0 1 0 0 0 0 0 4\n",
    "inav mission": '<?xml version="1.0"?>\n<mission><geozone no="0" shape="Circular"/></mission>',
    "shapes as text": 'id,WKT\n1,"POLYGON ((9 47, 9.1 47, 9 47.1, 9 47))"\n',
    "kml of entities": '<!DOCTYPE kml [<!ENTITY a "b">]><kml><Document/></kml>',
    "raster as text": "ncols 1\nnrows 1\nxllcorner 0\nyllcorner 0\ncellsize 1\n1\n",
}


REASONS = {
    "words": "is neither GeoJSON, GeoPackage, Shapefile.*gdal_translate FILE out.tif.*ogr2ogr",
    "kml of a ring": "no shape, or one that is not read, such as a LinearRing",
    "kml of a turned picture": "has a turned overlay",
    "elsewhere": r"reaches from 100, 20 to 100, 20, the terrain from 8\.9\S+, 46\.\S+ to 9\.\S+, 46\.\S+ in",
    "metres": "which are no degrees",
    "sqlite": "is SQLite, but no GeoPackage, perhaps SpatiaLite; it is not read; `ogr2ogr",
    "topojson": "is TopoJSON; it is not read; `ogr2ogr",
    "arcgis": "is ArcGIS JSON; it is not read; `ogr2ogr",
    "geopackage": "is damaged",
    "system as text": r"Expected `object \| null`, got `str` - at `\$\.crs`",
    "kml of two borders": "a Polygon has 2 of outerBoundaryIs, expected one",
    "kml of two shapes": "a Placemark has 2 of Point, LineString",
    "system unknown": "its crs 'EPSG:99999' is no coordinate system; write EPSG:32632",
    "zip": r"is damaged or no \.zip",
    "osm of an open area": "way 7 is an area, but its ring is not closed",
    "osm of a deleted way": "way 7 is deleted, but still in the file",
    "osm as PBF": "osmium cat",
    "osm as JSON": "an answer of Overpass as JSON",
    "fen": r"fence of Mission Planner .* save it as \.waypoints",
    "poly": "an area of Osmosis",
    "inav": "geozones by INAV; it is not read; draw",
    "inav mission": "geozones by INAV; it is not read; draw",
    "shapes as text": r"shapes as text \(WKT\)",
    "kml of entities": "an XML with entities of its own",
    "plan of nothing": "holds no feature or fence",
    "raster as text": "is read as a raster, which goes",
}


@pytest.mark.parametrize("name", [*SAME, *DAMAGED])
def test_other_formats_close_the_same_ground_or_say_why_not(tmp_path: Path, name: str) -> None:
    path = tmp_path / "zone.dat"
    path.write_text({**SAME, **DAMAGED}[name])
    zone = ZoneConfig(kind="forbidden", file=str(path))
    archive = tmp_path / "zone.kmz"
    with zipfile.ZipFile(archive, "w") as packed:
        packed.writestr("__MACOSX/._doc.kml", "of Finder")
        packed.write(path, f"doc.{name.partition(' ')[0]}")
    if name in SAME:
        touched = shapely.intersects(AREA, squares())
        assert (closed_by(str(path), "forbidden") == touched).all()
        if name.partition(" ")[0] in ("kml", "osm"):
            assert (closed_by(str(archive), "forbidden") == touched).all()
    else:
        for file in (str(path), str(archive)):
            with pytest.raises(TerrainError, match=r"^[^\n]{20,400}$") as told:
                painted([ZoneConfig(kind="forbidden", file=file)])
            assert file != str(path) or re.search(REASONS.get(name, ""), str(told.value))
        with pytest.raises(TerrainError, match=r"^[^\n]{20,400}$") as told:
            outlines_of(zone, UTM, 256)
        assert re.search(REASONS.get(name, ""), str(told.value))


@pytest.mark.parametrize("kind", ["gpkg", "shp", "fgb", "kml"])
def test_a_file_that_is_cut_off_anywhere_is_refused(tmp_path: Path, kind: str) -> None:
    shapes = [shapely.box(c + 0.2, r + 0.3, c + 4.7, r + 4.6) for c in range(5, 40, 8) for r in range(5, 30, 8)]
    options: Any = {"driver": "LIBKML"} if kind == "kml" else {}
    file = written(tmp_path / f"a.{kind}", shapes, "EPSG:4326", **options)
    before, chance = closed_by(file, "forbidden"), random.Random(kind)
    for part in [path for path in tmp_path.iterdir() if path.suffix in (f".{kind}", ".shx")]:
        whole = part.read_bytes()
        for _ in range(few(30)):
            part.write_bytes(whole[: chance.randrange(len(whole))])
            try:
                assert (closed_by(file, "forbidden") == before).all()
            except TerrainError as error:
                refused = str(error)
                assert "\n" not in refused
        part.write_bytes(whole)


def test_a_part_of_another_shapefile_is_refused(tmp_path: Path) -> None:
    boxes = [shapely.box(col, row, col + 3, row + 2) for row in (3, 20) for col in (4, 14, 24)]
    sets = (boxes, [box.buffer(1) for box in boxes], boxes[:4])
    files = [Path(written(tmp_path / f"{n}.shp", shapes, "EPSG:4326")) for n, shapes in enumerate(sets)]
    for one, other in itertools.permutations(files, 2):
        for part in (".shp", ".shx", ".dbf", ".prj"):
            source = other if part == ".shx" else one
            (tmp_path / f"mixed{part}").write_bytes(source.with_suffix(part).read_bytes())
        with pytest.raises(TerrainError, match=r"is damaged: its \.shx is that of another file"):
            closed_by(str(tmp_path / "mixed.shp"), "forbidden")
    for part in (".shp", ".shx", ".dbf", ".prj"):
        files[0].with_suffix(part).rename(tmp_path / f"CAPITAL{part.upper()}")
    assert closed_by(str(tmp_path / "CAPITAL.SHP"), "forbidden").any()
    os.truncate(tmp_path / "mixed.shx", 2 << 30)
    with pytest.raises(TerrainError, match=r"mixed\.shx: it has 2\.1 GB; at most"):
        closed_by(str(tmp_path / "mixed.shp"), "forbidden")
    (tmp_path / "mixed.shx").unlink()
    with pytest.raises(TerrainError, match=r"mixed\.shp lacks mixed\.shx, its index: copy it, too"):
        closed_by(str(tmp_path / "mixed.shp"), "forbidden")


def test_a_text_that_is_too_large_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "zone.geojson"
    path.write_text("{")
    os.truncate(path, 300 << 20)
    with pytest.raises(TerrainError, match="of text are read"):
        closed_by(str(path), "forbidden")


# --- extents and fences -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "tags", [{"radius": 40}, {"Radius": "40 m"}, {"diameter": 80}, {"width": 80.0}, {"radius": "0.04 km"}]
)
def test_a_stated_extent_is_closed_up_to_its_edge(tmp_path: Path, tags: dict[str, Any]) -> None:
    for at in (15.5, -2.5):  # the middle may lie outside of the terrain
        disc = shapely.Point(at, 14.5).buffer(4.0, 64)
        file = geojson(tmp_path / "a.geojson", [feature(shapely.Point(at, 14.5), **tags)])
        closed = closed_by(file, "forbidden")
        assert closed[shapely.intersects(disc.buffer(-1e-3), squares())].all()
        assert not closed[~shapely.intersects(disc.buffer(0.02), squares())].any()


@pytest.mark.parametrize(
    "tags",
    [{"radius": "wide"}, {"radius_nm": 3}, {"Radius": -5}, {"width": 20_000}, {"radius": [1, 2]}, {"buffer_m": 50},
        {"range": 8}, {"Dist": 8}, {"safetyDistance": "80 m"}, {"RANGE_M": 8}, {"BUFF_DIST": 8}, {"Halbmesser": 8}],
)  # fmt: skip
def test_an_extent_that_cannot_be_read_is_refused_by_name(tmp_path: Path, tags: dict[str, Any]) -> None:
    file = geojson(tmp_path / "a.geojson", [feature(shapely.Point(15.5, 14.5), **tags)])
    words = (
        f"feature 0 cannot be used: its {next(iter(tags)).lower()} is .*, expected metres as radius, diameter or"
    )
    with pytest.raises(TerrainError, match=words):
        painted([ZoneConfig(kind="forbidden", file=file)])


@pytest.mark.parametrize("tags", [{"range": 80}, {"distance": "far"}, {"dist": 0}, {"orange": 80}])
def test_another_number_of_a_line_or_of_a_point_with_a_width_is_no_extent(tmp_path: Path, tags: dict) -> None:
    line = geojson(tmp_path / "line.geojson", [feature(shapely.LineString([(5, 9.5), (25, 9.5)]), **tags)])
    pace, _ = painted([ZoneConfig(kind="forbidden", file=line)])
    assert (pace != np.float32(0.1)).sum() < 30
    point = geojson(tmp_path / "point.geojson", [feature(shapely.Point(15.5, 14.5), **tags)])
    assert closed_by(point, "forbidden").sum() == 1


def test_a_fence_keeps_in_and_keeps_out(tmp_path: Path) -> None:
    kept = ~shapely.contains(AREA, squares())
    inside = {"inclusion": True, "polygon": LATLON}
    disc = shapely.Point(15.5, 14.5).buffer(4.0, 64)
    path = tmp_path / "a.plan"
    path.write_text(plan([inside]))
    assert (closed_by(str(path), "forbidden") == kept).all()
    path.write_text(plan([inside], [DISC]))
    closed = closed_by(str(path), "forbidden")
    assert closed[kept | shapely.intersects(disc.buffer(-1e-3), squares())].all()
    assert not closed[~kept & ~shapely.intersects(disc.buffer(0.02), squares())].any()
    rings = outlines_of(ZoneConfig(kind="forbidden", file=str(path)), UTM, 256)
    ordered = np.zeros(UTM.shape, np.bool_)
    for border, *holes in rings:
        masks = [polygon_mask([(10 * col, 10 * row) for row, col in ring], UTM) for ring in (border, *holes)]
        ordered |= masks[0] & ~np.any([np.zeros(UTM.shape, np.bool_), *masks[1:]], axis=0)
    clear = shapely.distance(disc.boundary, middles()) > 0.02
    assert (ordered == (~shapely.contains(AREA, middles()) | shapely.contains(disc, middles())))[clear].all()
    excluded = {"inclusion": False, "polygon": LATLON}
    path.write_text(plan([excluded]))
    assert (closed_by(str(path), "keep_in") == closed_by(str(path), "forbidden")).all()
    beyond = {"inclusion": True, "polygon": [[lat + 0.05, lon] for lat, lon in LATLON]}
    path.write_text(plan([beyond, excluded]))
    assert closed_by(str(path), "forbidden").all()  # no cell is within
    path.write_text(waypoints(*((5001, 4, corner) for corner in CORNERS), (5003, 40, MIDDLE)))
    assert (closed_by(str(path), "forbidden") == kept).all()
    drawn = geojson(tmp_path / "b.geojson", [feature(AREA)])
    assert (closed_by(drawn, "keep_in") == kept).all()
    corners = tuple((10.0 * x, 10.0 * y) for x, y in shapely.get_coordinates(AREA)[:-1])
    pace, _ = painted([ZoneConfig(kind="keep_in", polygon_m=corners)])
    assert (np.isinf(pace) == ~shapely.contains(AREA, middles())).all()
    line = geojson(tmp_path / "c.geojson", [feature(shapely.LineString([(1, 1), (5, 5)]))])
    with pytest.raises(TerrainError, match="keeps in, but is no area"):
        painted([ZoneConfig(kind="keep_in", file=line)])


LONG = "x" * 5000


@pytest.mark.parametrize("name", ["fifo", "folder", "/dev/zero", LONG, f"{LONG}.csv", "nowhere", "a\0b"])
def test_what_is_no_file_is_refused_at_once(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "fifo":
        os.mkfifo(path)
    elif name == "folder":
        path.mkdir()
    zone = ZoneConfig(kind="forbidden", file=str(path))
    if len(name) < 9:
        scenario = Scenario(cost=CostConfig(zones=(zone,)))
        found = [each.text for each in files_named(scenario) if each.about.startswith("cost.zones")]
        assert len(found) == 1
    with pytest.raises(TerrainError, match=r"^cannot read .*: "):
        painted([zone])
    with pytest.raises(TerrainError, match=r"^cannot read .*: "):
        outlines_of(zone, UTM, 256)


@pytest.mark.parametrize("before", [b"<?a?>", b"<!---->", b"<!DOCTYPE a>", b" "])
def test_what_stands_before_the_root_of_an_xml_is_skipped_in_one_way_only(tmp_path: Path, before: bytes) -> None:
    (tmp_path / "a.kml").write_bytes(before * 500 + b"<svg/>")
    with pytest.raises(TerrainError, match="is neither GeoJSON"):
        painted([ZoneConfig(kind="forbidden", file=str(tmp_path / "a.kml"))])


def test_places_in_reverse_are_told_apart_from_places_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    file = geojson(path, [feature(AREA), feature(shapely.box(80, 80, 85, 85)), feature(shapely.box(5, 5, 7, 7))])
    text = json.loads(path.read_text())
    reverse(text["features"][2], random.Random(0))
    path.write_text(json.dumps(text))
    with pytest.raises(TerrainError, match="feature 2 cannot be used: it is on the terrain only if x and y change"):
        closed_by(file, "forbidden")
    for each in text["features"][:2]:
        reverse(each, random.Random(0))
    path.write_text(json.dumps(text))
    with pytest.raises(TerrainError, match=r"does not touch the terrain.*are x and y in reverse"):
        closed_by(file, "forbidden")
