"""`swarm route --terrain`: a route without a swarm, its places, and what other programs get of it."""

import csv
import json
import re
import sqlite3
from collections.abc import Callable
from concurrent.futures import Future
from datetime import datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import msgspec
import numpy as np
import pyogrio
import pytest
import rasterio
from rasterio.transform import from_origin
from support import slow_twins as naive
from support.command import Swarm
from support.height_models import written
from support.makers import run_info
from typer.testing import CliRunner

from launch_scripts.commands import swarm_route
from launch_scripts.commands.terrain_commands import app
from launch_scripts.commands.terrain_routes import DescribedRoute, corridor, find_route, metres_along, write_route
from launch_scripts.launcher.run_options import find_scenario
from launch_scripts.report import plots_and_figures
from shared_map.terrain.terrain import build_terrain, terrain_of_pace
from shared_map.terrain.zones import paint_zones
from swarm.client import BusError
from swarm.client import connected_swarm as client
from swarm.client.session import Session
from swarm.client.terrain_frame import Frame
from swarm.config.ground import CostConfig, ZoneConfig
from swarm.config.scenario_files import load_scenario
from swarm.errors import NoAnswerError, SwarmError
from swarm.grid import GridSpec
from swarm.places import read_place
from swarm.wire.messages.planning import PlaceRouteReply
from swarm.wire.messages.processes import RunInfo
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus

SYSTEM = "EPSG:32632"
ALPS = GridSpec(60, 80, 20.0, 500_000.0, 5_200_000.0, SYSTEM)


@pytest.fixture(scope="module")
def hill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ridge of 45 degrees from the north to near the south, with level ground to both sides."""
    path = tmp_path_factory.mktemp("hill") / "hill.tif"
    across = np.abs(np.arange(80) - 40)
    heights = np.repeat(np.maximum(400.0 - 40.0 * across, 100.0)[None], 60, axis=0)
    heights[50:] = 100.0
    heights += np.random.default_rng(1).uniform(0, 0.5, heights.shape)
    return written(path, heights, crs=SYSTEM, transform=from_origin(ALPS.west_m, ALPS.north_m, 20, 20))


def test_a_route_goes_around_the_ridge_and_every_format_holds_it(hill: Path, tmp_path: Path, swarm: Swarm) -> None:
    route = find_route(find_scenario(str(hill)), "cell:10,5", "cell:10,75")
    assert (route.cells // route.grid.cols).max() >= 50
    assert route.gap == pytest.approx(1, abs=1e-3)
    assert route.at_s[-1] == pytest.approx(route.cost_s, rel=1e-4)
    assert route.at_m[-1] == pytest.approx(route.length_m, rel=1e-6)
    assert (np.diff(route.at_s) > 0).all()
    for ending in ("geojson", "gpkg", "gpx", "kml", "csv", "png"):
        told = swarm(
            f"route --terrain {hill} --from cell:10,5 --to cell:10,75 --out {tmp_path}/way.{ending} --json"
        )
        assert told[0] == 0, told
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
    meta, _, _, values = pyogrio.raw.read(tmp_path / "way.gpkg", layer="route")
    found = dict(zip(meta["fields"].tolist(), values, strict=True))
    assert found["cost_s"][0] == pytest.approx(route.cost_s, abs=1e-3)
    assert len(pyogrio.raw.read(tmp_path / "way.gpkg", layer="route_cells")[2]) == many
    with (tmp_path / "way.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = [rows[0][name] for name in ("row", "col", "cost_rule")]
    assert (len(rows), *columns) == (many, "10", "5", "pace of the cell entered")
    for ending in ("geojson", "gpx", "kml"):
        assert "(s/m) of the cell that it enters" in (tmp_path / f"way.{ending}").read_text()


def test_a_route_is_written_as_a_mission_with_times_and_for_old_readers(hill: Path, tmp_path: Path) -> None:
    found = find_route(find_scenario(str(hill)), "cell:10,5", "cell:50,75")
    for ending in ("plan", "waypoints", "gpx", "gpkg"):
        write_route(found, tmp_path / f"way.{ending}")
    items = json.loads((tmp_path / "way.plan").read_text())["mission"]["items"]
    rows = [line.split("\t") for line in (tmp_path / "way.waypoints").read_text().splitlines()[1:]]
    assert [each["params"][4:6] for each in items] == [[float(row[8]), float(row[9])] for row in rows[1:]]
    assert [int(row[0]) for row in rows] == list(range(len(items) + 1))
    # The line of the mission covers each cell of the route.
    pace = np.ones(found.grid.shape, np.float32)
    zone = ZoneConfig(kind="forbidden", file=str(tmp_path / "way.waypoints"))
    paint_zones(pace, [zone], found.grid, CostConfig())
    assert np.isinf(pace.reshape(-1)[found.cells]).all()
    times = re.findall(r"<time>(.*?)</time>", (tmp_path / "way.gpx").read_text())
    assert len(times) == len(found.cells)
    assert found.at_s is not None
    last = datetime.fromisoformat(times[-1].replace("Z", "+00:00")).timestamp()
    assert last == pytest.approx(found.at_s[-1], abs=0.001)
    with sqlite3.connect(tmp_path / "way.gpkg") as database:
        assert database.execute("PRAGMA user_version").fetchall() == [(10200,)]
        names = database.execute("SELECT srs_name FROM gpkg_spatial_ref_sys").fetchall()
        told = str(database.execute("SELECT description FROM gpkg_contents").fetchall())
    assert "seconds of travel" in told
    assert "lower_bound_s: no route takes less" in told
    assert ("unknown",) not in names


def test_a_place_on_lethal_ground_is_refused_with_the_nearest_that_is_not(hill: Path) -> None:
    with pytest.raises(
        SwarmError, match=r"--from is on lethal ground, cell:10,35 \(xy:.*, latlon:46.*\), class unknown"
    ):
        find_route(find_scenario(str(hill)), "cell:10,35", "cell:10,75")
    for start, end, option in (("cell:10,35", "cell:10,75", "--from"), ("cell:10,75", "cell:10,35", "--to")):
        with pytest.raises(SwarmError, match=f"{option} is on lethal ground") as told:
            find_route(find_scenario(str(hill)), start, end)
        nearest = str(told.value).split("reached is ")[1].split()[0]
        ends = (nearest, end) if option == "--from" else (start, nearest)
        assert find_route(find_scenario(str(hill)), *ends).cost_s > 0


def test_a_place_which_a_zone_closes_is_refused_with_the_zone(hill: Path) -> None:
    scenario = find_scenario(str(hill))
    zone = ZoneConfig(kind="forbidden", name="range", polygon_m=((0, 0), (200, 0), (200, 400), (0, 400)))
    closed = msgspec.structs.replace(scenario, cost=msgspec.structs.replace(scenario.cost, zones=(zone,)))
    with pytest.raises(SwarmError, match=r"--from .* no way leads there; closed by forbidden zone 'range'") as told:
        find_route(closed, "cell:10,5", "cell:10,75")
    assert "degrees" not in str(told.value)


def test_the_time_from_everywhere_is_that_of_the_routes_as_raster_and_as_areas(
    hill: Path, tmp_path: Path, swarm: Swarm
) -> None:
    line = f"terrain reach {hill} --to cell:10,75 --out {tmp_path}"
    _, said, _ = swarm(f"{line}/s.tif")
    assert "from 8" in said or "from 9" in said
    with rasterio.open(tmp_path / "s.tif") as file:
        seconds = file.read(1)
        assert (file.crs.to_string(), file.nodata, file.shape, file.units) == (SYSTEM, -1.0, (60, 80), ("s",))
        assert "slope rule quadratic" in file.tags()["TIFFTAG_IMAGEDESCRIPTION"]
        assert file.tags()["TIFFTAG_SOFTWARE"].startswith("terrain-swarm ")
    best = find_route(find_scenario(str(hill)), "cell:10,5", "cell:10,75")
    assert seconds[10, 5] == pytest.approx(best.cost_s, rel=1e-5)
    assert "the file exists; --force replaces it" in swarm(f"{line}/s.tif")[2]
    assert swarm(f"{line}/s.tif --force")[0] == 0
    assert seconds[10, 35] == -1
    assert seconds[10, 75] == 0
    swarm(f"{line}/a.geojson --every-s 60 --json")
    features = json.loads((tmp_path / "a.geojson").read_text())["features"]
    assert max(each["properties"]["to_s"] for each in features) >= seconds.max()
    lon, lat = features[0]["geometry"]["coordinates"][0][0]
    assert (lat, lon) == pytest.approx((46.95, 9.0), abs=0.05)
    assert "areas, at most 200" in swarm(f"{line}/a.geojson --force --every-s 0.001")[2]
    assert "--to is on lethal ground" in swarm(f"terrain reach {hill} --to cell:10,35")[2]


def test_a_corridor_holds_cells_of_good_ways_and_no_others(hill: Path, tmp_path: Path, swarm: Swarm) -> None:
    """Against all cheapest ways there and on, by their slow twin. Ways from a cell are ways to it turned round, on
    which a step has the pace of the cell that it leaves."""
    best = find_route(find_scenario(str(hill)), "cell:20,5", "cell:30,75")
    found = corridor(find_scenario(str(hill)), "cell:20,5", "cell:30,75", 0.1)
    pace = build_terrain(find_scenario(str(hill))).pace_s_per_m
    there, on = naive.cost_to_go(pace, ALPS.cell(20, 5), left_share=1.0), naive.cost_to_go(pace, ALPS.cell(30, 75))
    truth = 20.0 * (there + on)
    inside = np.isfinite(found.seconds)
    assert found.fastest_s == pytest.approx(truth[20, 5], rel=1e-5)
    assert (found.seconds[inside] >= truth[inside] * (1 - 1e-5)).all()
    assert (truth[inside] <= best.cost_s * 1.1 + 1e-3).all()
    assert inside.reshape(-1)[best.cells].all()
    assert inside.sum() >= 0.95 * (truth <= best.cost_s * 1.1).sum() > 300
    line = f"terrain reach {hill} --from cell:20,5 --to cell:30,75 --slack 0.1 --out {tmp_path}/c.geojson"
    for more, fewest, most in ("", 3, 6), (" --every-s 5", 3, 99):
        assert f"the best takes {best.cost_s:.0f} s" in swarm(f"{line} --force {more}")[1]
        features = json.loads((tmp_path / "c.geojson").read_text())["features"]
        bands = {each["properties"]["from_s"] for each in features}
        assert min(bands) == 0
        assert fewest <= len(bands) <= most
        for feature in features:
            border, *holes = feature["geometry"]["coordinates"]
            assert turned(border) > 0
            assert all(turned(hole) < 0 for hole in holes)
    with pytest.raises(SwarmError, match="--from is on lethal ground, cell:10,35"):
        corridor(find_scenario(str(hill)), "cell:10,35", "cell:30,75", 0.1)


def turned(ring: list[list[float]]) -> float:
    """Twice the area of a ring, above 0 against the clock."""
    assert ring[0] == ring[-1]
    (x0, y0), points = ring[0], np.array(ring)
    x, y = points[:, 0] - x0, points[:, 1] - y0
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def test_a_route_across_180_degrees_is_one_line(tmp_path: Path) -> None:
    grid = GridSpec(10, 200, 100.0, 170_000.0, 8_200_000.0, "EPSG:32701")
    cells = np.arange(5 * 200, 6 * 200)
    route = DescribedRoute("across", grid, cells, 1.0, 1.0, metres_along(grid, cells))
    for ending in ("geojson", "gpx", "kml", "csv"):
        write_route(route, tmp_path / f"way.{ending}")
    (feature,) = json.loads((tmp_path / "way.geojson").read_text())["features"]
    lon = np.array(feature["geometry"]["coordinates"])[:, 0]
    assert lon[0] < 180 < lon[-1]
    assert np.abs(np.diff(lon)).max() < 0.01
    points = ElementTree.parse(tmp_path / "way.gpx").iter("{http://www.topografix.com/GPX/1/1}trkpt")
    within = np.array([float(point.attrib["lon"]) for point in points])
    assert np.abs((within - lon + 180) % 360 - 180).max() < 1e-7
    assert -180 <= within.min() < within.max() < 180
    line = next(ElementTree.parse(tmp_path / "way.kml").iter("{http://www.opengis.net/kml/2.2}LineString"))
    # The order that the schema asks for. Heights are not known here: those that stand there lie on the ground.
    assert [each.tag.rpartition("}")[2] for each in line] == ["tessellate", "altitudeMode", "coordinates"]
    assert line[1].text == "clampToGround"
    with pytest.raises(SwarmError, match="a picture needs the terrain"):
        write_route(route, tmp_path / "way.png")
    site = DescribedRoute("site", GridSpec(9, 9, 1.0), np.arange(9), 1.0, 1.0, np.arange(9.0))
    with pytest.raises(SwarmError, match="has no place on Earth"):
        write_route(site, tmp_path / "way.kml")


def test_a_route_to_where_one_is_takes_nothing_and_has_two_points(hill: Path, tmp_path: Path, swarm: Swarm) -> None:
    for ending in ("geojson", "kml"):
        line = f"route --terrain {hill} --from cell:55,5 --to cell:55,5 --out {tmp_path}/way.{ending}"
        assert "at most 0.00% above the optimum" in swarm(line)[1]
    (feature,) = json.loads((tmp_path / "way.geojson").read_text())["features"]
    first, last = feature["geometry"]["coordinates"]
    assert first == last
    coordinates = ElementTree.parse(tmp_path / "way.kml").find(".//{*}coordinates")
    assert len((coordinates.text or "").split()) == 2


# --- a question about places while the process that answers is replaced: it is asked again ------------------------


GRID = GridSpec(10, 10, 10.0)
ROUTE = Route(status=RouteStatus.OK, start=0, directions=b"\2", cost_s=1.0, lower_bound_s=1.0, length_m=10.0)
REPLY = PlaceRouteReply(
    to_cell=1, incarnation=1, map_version=0, routes=RouteBatch.of([ROUTE]).columns(), status="ok",
    vehicle_class="ground",
)  # fmt: skip


@pytest.fixture(params=["client", "command"])
def ask(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that asks for a route of a run with such a crew, the first `silent` times in vain; it returns the
    end of the route and how often it asked."""
    waited = SimpleNamespace(s=0.0)
    clock = SimpleNamespace(monotonic=lambda: waited.s, sleep=lambda s: setattr(waited, "s", waited.s + s))
    monkeypatch.setattr(client, "time", clock)
    monkeypatch.setattr(swarm_route, "time", clock)

    def by_client(info: RunInfo, replies: Callable[[], list[PlaceRouteReply]]) -> int:
        def answers(*_: object) -> list[PlaceRouteReply]:
            if not (found := replies()):
                raise NoAnswerError("no process answers")
            return found

        session: Any = SimpleNamespace(
            run=info, frame=Frame.of(info), ask=lambda *_, **__: Future(), answers=answers,
            number=partial(Session.number, SimpleNamespace()), check_ids=lambda **_: None,
        )  # fmt: skip
        return client.Swarm(session).route((5.0, -5.0), (15.0, -5.0)).cells[-1]

    def by_command(info: RunInfo, replies: Callable[[], list[PlaceRouteReply]]) -> int:
        monkeypatch.setattr(swarm_route, "replies_to", lambda *_, **__: (replies(), None))
        monkeypatch.setattr(swarm_route, "ask_run", lambda _: [info])
        monkeypatch.setattr(swarm_route, "frame_of_run", lambda *_: Frame.of(info))
        bus: Any = None
        where: Any = SimpleNamespace(plans_no_places="no process plans routes to places here")
        start, end = read_place("cell:0,0", "from"), read_place("cell:0,1", "to")
        return swarm_route.ask_place(bus, where, start, end, "ground").path()[-1]

    def ask(info: RunInfo, silent: int) -> tuple[int, int]:
        asked: list[int] = []

        def replies() -> list[PlaceRouteReply]:
            asked.append(1)
            return [] if len(asked) <= silent else [REPLY]

        end = (by_client if request.param == "client" else by_command)(info, replies)
        return end, len(asked)

    return ask


def test_while_another_takes_over_a_route_to_a_place_is_asked_for_again(ask: Any) -> None:
    assert ask(run_info(GRID, crew=["keeper-k", "places-all", "places-all.r1"]), 3) == (1, 4)


def test_a_process_that_never_answers_is_named_and_one_that_no_run_needs_is_asked_once(ask: Any) -> None:
    with pytest.raises(BusError, match=r"places-all does not answer|no process answers"):
        ask(run_info(GRID, crew=["places-all"]), 1_000)
    with pytest.raises(BusError, match=r"no process (plans routes to places here|answers)"):
        ask(run_info(GRID, crew=["keeper-k"]), 1_000)


# --- the commands that look at terrains, as a user runs them ------------------------------------------------------


def run(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    size = ("--rows", 300, "--cols", 280, "--seed", 4, "--rivers", 0, "--roads", 0)
    run("generate", *size, "--out", folder / "dem.tif", "--photo", folder / "photo.tif")
    return folder


def test_what_synth_writes_is_what_info_reads(made: Path) -> None:
    facts = json.loads(run("info", made / "dem.tif", "--json"))
    assert (facts["rows"], facts["cols"], facts["resolution_m"], facts["voids"]) == (300, 280, 30.0, 0)
    assert facts["highest_m"] - facts["lowest_m"] == pytest.approx(400, abs=60)
    assert "resolution_m" in run("info", "jacksboro")


def test_info_tells_of_the_scenarios_own_landscape_what_it_costs_and_what_looks_wrong(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text('seed = 9\n[terrain]\nsource = "synthetic"\nrivers = 1\n[cost]\nmax_slope_deg = 3\n')
    facts = json.loads(run("info", file, "--json"))
    terrain = build_terrain(load_scenario(file))
    assert facts["highest_m"] == pytest.approx(float(terrain.elevation_m.max()), abs=0.1)
    assert facts["lethal_share"] == pytest.approx(float(terrain.lethal.mean()), abs=1e-4)
    assert 0 < facts["class_shares"]["water"] < 0.2
    assert 0 < facts["largest_part_share"] <= 1
    assert any("cost.max_slope_deg" in doubt for doubt in facts["doubts"])
    assert "! " in run("info", file)


def test_cost_writes_a_geotiff_with_overviews_and_a_picture(made: Path, tmp_path: Path) -> None:
    scenario = tmp_path / "mine.toml"
    (tmp_path / "dem.tif").write_bytes((made / "dem.tif").read_bytes())
    (tmp_path / "photo.tif").write_bytes((made / "photo.tif").read_bytes())
    scenario.write_text('name = "mine"\n[terrain]\nsource = "dem.tif"\nphoto = "photo.tif"\n')
    said = run("cost", scenario, "--out", tmp_path / "cost.tif", "--picture", tmp_path / "cost.png")
    assert "300 x 280 cells of 30 m" in said
    with rasterio.open(tmp_path / "cost.tif") as file:
        pace = file.read(1)
        assert (file.nodata, file.crs.to_epsg(), file.overviews(1)) == (-1, 32632, [2])
        assert "slope rule quadratic" in file.tags()["TIFFTAG_IMAGEDESCRIPTION"]
    assert ((pace == -1) | (pace > 0)).all()
    assert (tmp_path / "cost.png").stat().st_size > 50_000


def test_cost_of_a_class_that_flies_is_that_of_its_surface(tmp_path: Path) -> None:
    scenario = tmp_path / "mine.toml"
    scenario.write_text(
        'name = "mine"\n[terrain]\nsource = "synthetic"\nrows = 32\ncols = 32\n'
        '[[classes]]\nname = "drone"\n[classes.air]\nspeed_m_per_s = 20.0\n'
    )
    said = run("cost", scenario, "--class", "drone")
    assert "0.0% lethal, pace 0.05 to 0.05 s/m" in said
    assert "flies at" in said
    assert "wind" not in said
    scenario.write_text(scenario.read_text() + "[wind]\nspeed_m_per_s = 5\nfrom_deg = 270\n")
    windy = run("cost", scenario, "--class", "drone")
    assert "in a wind of 5 m/s from 270 degrees: 15 m/s over the ground against it, 25 m/s with it" in windy
    assert "and by the wind, times 0.8 to" in windy


@pytest.mark.parametrize("shape", [(70, 90), (1, 1), (9, 400), (400, 9)])
def test_a_picture_of_any_shape_with_voids_and_coarsened(
    shape: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots_and_figures, "MOST_CELLS", 1000)
    heights = np.random.default_rng(1).uniform(0, 50, shape).astype(np.float32)
    pace = np.ones(shape, np.float32)
    if heights.size > 1:
        heights[:, 0] = np.nan
        pace[0] = np.inf
    plots_and_figures.draw_terrain(terrain_of_pace(pace, 10.0, heights), tmp_path / "look.png", "any shape")
    assert (tmp_path / "look.png").stat().st_size > 10_000


def test_classify_prints_what_it_found_and_how_well(made: Path, tmp_path: Path) -> None:
    spots = {"forest": [], "grass": []}
    from shared_map.terrain.synthetic import landscape

    _, classes = landscape(300, 280, 30.0, 400.0, 4)
    rng = np.random.default_rng(1)
    for name, kind in (("forest", 2), ("grass", 4)):
        for cell in rng.choice(np.flatnonzero(classes == kind), 12, replace=False):
            row, col = divmod(int(cell), 280)
            spots[name].append([col * 30 + 15, row * 30 + 15])
    labels = "".join(f'[[labels]]\nclass = "{name}"\npoints_m = {points}\n' for name, points in spots.items())
    (tmp_path / "labels.toml").write_text(labels)
    said = run(
        "classify", made / "dem.tif", made / "photo.tif", "--labels", tmp_path / "labels.toml",
        "--out", tmp_path / "classes.tif",
    )  # fmt: skip
    assert "forest" in said
    assert "learnt, on polygons not seen" in said
    with rasterio.open(tmp_path / "classes.tif") as file:
        assert set(np.unique(file.read(1))) == {2, 4}


def test_a_terrain_file_is_told_its_vehicles_by_an_option_and_a_scenario_says_them_itself(tmp_path: Path) -> None:
    file = tmp_path / "hill.npz"
    row, col = np.mgrid[:20, :20]
    np.savez(file, elevation=(0.1 * 10.0 * col + 0.3 * row).astype(np.float32), resolution_m=10.0)

    def told(*words: object) -> dict[str, float]:
        return json.loads(run(*words, "--json"))

    assert told("info", file)["preset"] == "none"
    facts = told("info", file, "--preset", "hiker")
    assert (facts["slope_rule"], facts["preset"]) == ("tobler", "hiker")
    there = ("reach", file, "--to", "cell:10,10")
    assert told(*there, "--preset", "hiker")["longest_s"] > 8 * told(*there)["longest_s"]
    scenarios = (find_scenario(str(file), preset) for preset in ("hiker", None))
    on_foot, driven = (find_route(each, "cell:1,1", "cell:10,15").cost_s for each in scenarios)
    assert on_foot > 8 * driven
