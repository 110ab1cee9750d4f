"""`swarm runs export`: what a run left, as another program reads it."""

import csv
import dataclasses
import datetime
import json
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from pyogrio import raw
from rasterio.features import rasterize
from rasterio.transform import from_origin
from support.command import Swarm
from support.fake_run import BEGAN_NS, GRID

from launch_scripts.observe.recorder import BegunRoute, Recorder
from launch_scripts.report.gis_formats import in_degrees, write_layers
from launch_scripts.report.report_and_tracks import TRACKS_FILE, Track, packed_tracks, read_tracks
from launch_scripts.report.run_gis_layers import ENDINGS, mark_layer, target_tracks, vehicle_tracks
from shared_map.terrain.map_frame import MapFrame
from swarm.clock import NS_PER_S
from swarm.errors import StoreError
from swarm.grid import GridSpec, walk
from swarm.wire.messages.map_data import MarkKind


@pytest.fixture
def recorder(left_run: tuple[Path, Recorder]) -> Recorder:
    return left_run[1]


def read_layers(folder: Path) -> dict[str, list[Any]]:
    return {
        path.stem.partition("-")[2]: json.loads(path.read_text())["features"] for path in folder.glob("*.geojson")
    }


def test_geojson_has_places_and_times_in_wgs84(run: Path, recorder: Recorder, tmp_path: Path, swarm: Swarm) -> None:
    code, out, _ = swarm(f"runs export {run.name} --runs", run.parent, "--out", tmp_path)
    assert (code, "4 vehicle_tracks" in out) == (0, True)
    layers = read_layers(tmp_path)
    assert len(layers["captures"]) == len(recorder.captures) > 0
    for feature in layers["vehicle_tracks"]:
        said = feature["properties"]
        points = np.array(feature["geometry"]["coordinates"])
        key = said["vehicle"], 0
        first, *_, last = (each for each in recorder.vehicle_tracks.kept if key in each.keys)
        east_m, south_m = np.array([each.places_m[each.keys.index(key)] for each in (first, last)], float).T
        xy_m = np.stack([GRID.west_m + east_m, GRID.north_m - south_m], axis=1)
        assert points[[0, -1]] == pytest.approx(in_degrees(xy_m, MapFrame(GRID)), abs=1e-7)
        times = [datetime.datetime.fromisoformat(time) for time in said["times"]]
        assert len(times) == len(points) <= said["samples"]
        assert times == sorted(times)
        assert times[0].timestamp() * NS_PER_S == pytest.approx(first.time_ns)
    marked = recorder.observed.marked()
    assert sum(each["properties"]["cells"] for each in layers["marks"]) == len(marked.cells) > 0
    lethal = sum(each["properties"]["cells"] for each in layers["marks"] if each["properties"]["kind"] == "lethal")
    assert lethal == (marked.kinds == MarkKind.LETHAL).sum() > 0
    routes = {(each["properties"]["vehicle"], each["properties"]["at"]): each for each in layers["routes"]}
    for told in recorder.routes.kept:
        row, col = divmod(told.route.start, GRID.cols)
        at = datetime.datetime.fromtimestamp(told.time_ns / 1e9, datetime.UTC).isoformat(timespec="milliseconds")
        feature = routes[told.route.vehicle, at.replace("+00:00", "Z")]
        there = np.array([GRID.centre_m(row * GRID.cols + col)])
        assert feature["geometry"]["coordinates"][0] == pytest.approx(
            in_degrees(there, MapFrame(GRID))[0], abs=1e-7
        )
        gap = told.route.cost_s / told.route.lower_bound_s
        assert feature["properties"]["certified_gap"] == pytest.approx(gap)


def test_what_never_moved_is_a_point_and_no_line_without_a_length(run: Path) -> None:
    def track(id: str, *places: tuple[float, float]) -> Track:
        return Track(id, 0, BEGAN_NS + np.arange(len(places)), np.array(places, float).reshape(-1, 2))

    still = dataclasses.replace(
        read_tracks(run / TRACKS_FILE),
        vehicles=[track("a", (1.0, 2.0)), track("b", (1.0, 2.0), (1.0, 2.0)), track("c", (0.0, 0.0), (3.0, 4.0))],
        targets=[track("t", (5.0, 5.0)), track("u")],
    )
    made = (*vehicle_tracks(still, {"a": "g"}), *target_tracks(still, {}))
    layers = {layer.name: layer for layer in made}
    assert [each.values["vehicle"] for each in layers["vehicle_tracks"].features] == ["c"]
    assert [each.values["length_m"] for each in layers["vehicle_tracks"].features] == [5.0]
    assert [each.values["vehicle"] for each in layers["vehicles_standing"].features] == ["a", "b"]
    assert [each.values["target"] for each in layers["targets_standing"].features] == ["t"]
    assert layers["vehicles_standing"].features[0].values["group"] == "g"


@pytest.mark.parametrize("ending", ENDINGS[:-1])
def test_every_format_holds_all_layers_that_it_can(run: Path, tmp_path: Path, swarm: Swarm, ending: str) -> None:
    assert swarm("runs", "export", run, "--format", ending, "--out", tmp_path)[0] == 0
    tracks = read_tracks(run / TRACKS_FILE)
    if ending == "csv":
        rows = list(csv.DictReader((tmp_path / f"{run.name}-vehicle_tracks.csv").open()))
        assert {row["vehicle"] for row in rows} == {track.id for track in tracks.vehicles}
        assert all(row["at"].endswith("Z") and float(row["lat"]) > 0 for row in rows)
        wkt = [row["wkt"] for row in csv.DictReader((tmp_path / f"{run.name}-marks.csv").open())]
        assert all(each.startswith("POLYGON ((") for each in wkt)
        return
    if ending == "gpx":
        meta, _, _, values = raw.read(tmp_path / f"{run.name}-vehicle_tracks.gpx", layer="track_points")
        found = dict(zip(meta["fields"].tolist(), values, strict=True))
        assert set(found["track_fid"].tolist()) == set(range(len(tracks.vehicles)))
        assert not np.isnat(found["time"]).any()
        assert swarm("runs", "export", run, "--format", "gpx", "--what", "marks", "--out", tmp_path)[0] != 0
        return
    several = ending in ("gpkg", "kml")
    for name in ("vehicle_tracks", "target_tracks", "captures", "routes", "marks"):
        path = tmp_path / (f"{run.name}.{ending}" if several else f"{run.name}-{name}.{ending}")
        meta, _, shapes, _ = raw.read(path, layer=name)
        assert len(shapes) > 0, name
        assert ending == "gpkg" or meta["crs"] == "EPSG:4326"


def test_without_pyogrio_a_sentence_says_what_to_install_and_tables_are_written(
    run: Path, tmp_path: Path, swarm: Swarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    assert swarm("runs", "export", run, "--what", "captures", "--format", "csv", "--out", tmp_path)[0] == 0
    code, _, told = swarm("runs export --what captures", run, "--out", tmp_path)
    assert (code, "install the extra 'vectors'" in told) == (2, True)


def test_no_route_that_leaves_the_map_harms_the_others(recorder: Recorder, tmp_path: Path) -> None:
    routes = recorder.routes.kept
    bad = [
        msgspec.structs.replace(routes[0].route, start=GRID.cells, directions=b""),
        msgspec.structs.replace(routes[0].route, start=0, directions=b"\0\1\2\3\4\5\6\7" * 100),
    ]
    recorder.routes.kept = [*(BegunRoute(BEGAN_NS, each) for each in bad), *routes]
    try:
        (tmp_path / TRACKS_FILE).write_bytes(packed_tracks(recorder))
    finally:
        recorder.routes.kept = routes
    kept = read_tracks(tmp_path / TRACKS_FILE)
    assert [route.vehicle for route in kept.routes] == [each.route.vehicle for each in routes]
    assert [route.cells.tolist() for route in kept.routes] == [
        walk(GRID, each.route.start, each.route.directions) for each in routes
    ]


def test_nothing_is_replaced_unless_asked(run: Path, tmp_path: Path, swarm: Swarm) -> None:
    words = ("runs", "export", run, "--out", tmp_path / "new", "--what", "captures")
    assert swarm(*words)[0] == 0
    (path,) = (tmp_path / "new").iterdir()
    path.write_text("mine")
    code, _, told = swarm(*words)
    assert (code, f"{path}: the file exists; --force replaces it" in told) == (2, True)
    assert path.read_text() == "mine"
    assert swarm(*words, "--force")[0] == 0
    assert path.read_text() != "mine"


def test_polygons_of_marks_cover_the_cells_that_are_marked_and_no_others(tmp_path: Path) -> None:
    chance = np.random.default_rng(5)
    kinds = chance.choice(np.array([0, 1, 2, 255], np.uint8), (40, 50), p=[0.3, 0.3, 0.1, 0.3])
    paces = chance.choice(np.array([0.1, 0.25, 3.0], np.float32), (40, 50))
    kinds[5:25, 5:25] = MarkKind.LETHAL
    kinds[8, 8] = kinds[12, 12:14] = kinds[13, 12] = 255  # two holes, of four corners and of six
    grid = GridSpec(40, 50, 10.0, 100.0, 900.0)
    layer = mark_layer(grid, kinds, paces)
    codes = {"lethal": 1, "0.1": 2, "0.25": 3, "3.0": 4}

    def code(values: dict[str, Any]) -> int:
        return codes["lethal" if values["kind"] == "lethal" else str(round(values["pace_s_per_m"], 4))]

    shapes = [
        ({"type": "Polygon", "coordinates": [ring.tolist() for ring in each.parts]}, code(each.values))
        for each in layer.features
    ]
    drawn = rasterize(shapes, (40, 50), transform=from_origin(100.0, 900.0, 10.0, 10.0))
    expected: NDArray[Any] = np.zeros((40, 50), int)
    expected[kinds == MarkKind.LETHAL] = 1
    for number, pace in ((2, 0.1), (3, 0.25), (4, 3.0)):
        expected[(kinds == MarkKind.PACE) & (paces == np.float32(pace))] = number
    assert (drawn == expected).all()
    assert sum(int(each.values["cells"] or 0) for each in layer.features) == (expected > 0).sum()  # type: ignore[arg-type]
    assert len({len(hole) for each in layer.features for hole in each.parts[1:]}) > 1, "holes of several lengths"
    for file in (tmp_path / "marks.gpkg", tmp_path / "marks.geojson"):
        write_layers(file, [layer], MapFrame(grid))
        written = shapely.from_wkb(raw.read(file)[2])
        assert shapely.area(written).sum() == pytest.approx(100 * (expected > 0).sum())
        with pytest.raises(StoreError, match=rf"cannot write /proc/{file.name}: ((?!part).)*$"):
            write_layers(Path("/proc", file.name), [layer], MapFrame(grid))


def test_what_cannot_be_exported_is_said_in_a_sentence(run: Path, tmp_path: Path, swarm: Swarm) -> None:
    for words, complaint in (
        ((run, "--out", run / TRACKS_FILE), "expected a folder, or a file with an ending of geojson,"),
        ((run, "--out", tmp_path / "a.csv"), "found one file for"),
    ):
        code, _, told = swarm("runs", "export", *words)
        assert (code, complaint in told, told.count("\n")) == (2, True, 1), told
    whole = (run / TRACKS_FILE).read_bytes()
    for number, broken in enumerate((b"", b"PK", whole[: len(whole) // 2], whole[:300] + bytes(100) + whole[400:])):
        (tmp_path / f"{number}.npz").write_bytes(broken)
        with pytest.raises(StoreError, match="is damaged"):
            read_tracks(tmp_path / f"{number}.npz")


@pytest.mark.parametrize(
    "changed",
    [
        {"vehicles_place_m": np.full((1, 2), np.nan)},
        {"vehicles_samples": np.array([-1])},
        {"vehicles_time_ns": np.array([0.5])},
        {"marks_paces": np.full(1, np.inf, np.float32)},
        {"routes_steps": np.array([-1])},
        {"routes_steps": np.array([3])},
        {"routes_legs": np.array([6, -5]), "routes_many_legs": np.array([2])},
        {"routes_legs": np.array([1]), "routes_many_legs": np.array([2])},
        {"grid": np.array('{"rows": 2.5, "cols": 2, "resolution_m": 1.0}')},
        {"grid": np.array('{"rows": 2, "cols": 2, "resolution_m": Infinity}')},
        {"grid": np.array('{"rows": 2, "cols": 2, "resolution_m": 1e-300}')},
        {"grid": np.array('{"rows": 2, "cols": 2, "resolution_m": 1.0, "crs": 5}')},
    ],
)
def test_tracks_that_nothing_could_have_left_are_damaged(
    run: Path, tmp_path: Path, changed: dict[str, NDArray[Any]]
) -> None:
    with np.load(run / TRACKS_FILE) as arrays:
        columns = {**arrays, **changed}
    np.savez(tmp_path / "t.npz", allow_pickle=False, **columns)
    with pytest.raises(StoreError, match=r"t\.npz is damaged: "):
        read_tracks(tmp_path / "t.npz")
