"""`swarm report export`: tracks, captures and marks of a run, as another program reads them."""

from __future__ import annotations

import dataclasses
import datetime
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rasterio.features import rasterize
from rasterio.transform import from_origin
from support.fake_run import fake_run
from support.map_strategies import set_of

from launch_scripts.cli import main
from launch_scripts.report.geo.geo_layers import mark_layer
from launch_scripts.report.geo.geo_shapes import in_degrees
from launch_scripts.report.geo.track_file import TRACKS_FILE, packed_tracks, read_tracks
from launch_scripts.report.recorder import Recorder
from shared_map.keeper.store import KeeperStore
from shared_map.terrain.places import MapFrame
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.load import parse_scenario
from swarm.errors import StoreError
from swarm.grid import GridSpec
from swarm.liveness import Peer
from swarm.wire.statements import MarkKind

GRID = GridSpec(48, 64, 25.0, 500_000.0, 5_200_000.0, "EPSG:32632")
BEGAN_NS = 1_700_000_000 * NS_PER_S
LETHAL_CELLS = {(3, 4), (3, 5), (4, 5), (9, 9)}


@pytest.fixture(scope="module")
def recorder() -> Recorder:
    scenario = parse_scenario(
        'name = "little"\nseed = 3\nseconds = 8.0\n[[targets]]\nname = "t"\ncount = 2\n[[groups]]\nvehicles = 4\n'
    )
    terrain = dataclasses.replace(terrain_of_pace(np.full((48, 64), 0.1, np.float32), 25.0), grid=GRID)
    recorder = Recorder(scenario, GRID)
    for now_ns, told in fake_run(terrain, np.array(terrain.pace_s_per_m), scenario):
        if isinstance(told, Peer):
            recorder.alive(told, True, BEGAN_NS + now_ns)
        else:
            recorder.heard(told, {}, BEGAN_NS + now_ns)
    return recorder


@pytest.fixture(scope="module")
def run(recorder: Recorder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "r1"
    folder.mkdir()
    (folder / TRACKS_FILE).write_bytes(packed_tracks(recorder))
    with KeeperStore(folder / "map.sqlite") as store:
        store.bind("fedcba9876543210", GRID)
        marks: dict[int, tuple[MarkKind, float, int]] = {
            row * 32 + col: (MarkKind.LETHAL, 0, BEGAN_NS) for row, col in LETHAL_CELLS
        }
        marks |= {
            20 * 32 + col: (MarkKind.PACE, pace, BEGAN_NS + NS_PER_S) for col, pace in ((1, 0.5), (2, 0.5001))
        }
        store.save([set_of("a1.1", 0, 1, marks)])
    return folder


def swarm(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["swarm", *map(str, words)])
    try:
        return main()
    except SystemExit as end:  # of a command that went well
        return int(end.code or 0)


def test_a_geojson_has_every_place_and_time_in_wgs84(
    run: Path,
    recorder: Recorder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert (
        swarm(monkeypatch, "report", "export", run.name, "--runs", run.parent, "--out", tmp_path / "r.geojson") == 0
    )
    assert "4 vehicle_tracks" in capsys.readouterr().out
    layers: dict[str, list[Any]] = {}
    for feature in json.loads((tmp_path / "r.geojson").read_text())["features"]:
        layers.setdefault(feature["properties"]["layer"], []).append(feature)
    assert len(layers["captures"]) == len(recorder.captures) > 0
    lines = recorder.vehicle_tracks.lines()
    for feature in layers["vehicle_tracks"]:
        said = feature["properties"]
        points = np.array(feature["geometry"]["coordinates"])
        east_m, south_m = lines[said["vehicle"], 0][[0, -1]].astype(float).T
        xy_m = np.stack([GRID.west_m + east_m, GRID.north_m - south_m], axis=1)
        assert points[[0, -1]] == pytest.approx(in_degrees(xy_m, MapFrame(GRID)), abs=1e-7)
        times = [datetime.datetime.fromisoformat(time) for time in said["times"]]
        assert len(times) == len(points) <= said["samples"]
        assert times == sorted(times)
        assert times[0].timestamp() * NS_PER_S == pytest.approx(
            recorder.vehicle_tracks.times_ns()[said["vehicle"], 0][0]
        )
    lethal, far, paced = sorted(
        layers["marks"], key=lambda each: (each["properties"]["kind"], -each["properties"]["cells"])
    )
    assert [each["properties"]["cells"] for each in (lethal, far, paced)] == [3, 1, 2]
    assert paced["properties"] | {"pace_s_per_m": 0.5} == {
        "layer": "marks", "kind": "pace", "pace_s_per_m": 0.5, "cells": 2, "area_m2": 1250.0,
        "oldest": "2023-11-14T22:13:21.000Z", "newest": "2023-11-14T22:13:21.000Z",
    }  # fmt: skip


def test_another_program_reads_the_same_from_a_geopackage(
    run: Path, recorder: Recorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = pytest.importorskip("pyogrio.raw", reason="the extra vectors is not installed")
    out = tmp_path / "r.gpkg"
    assert swarm(monkeypatch, "report", "export", run, "--out", out) == 0
    tracks = read_tracks(run / TRACKS_FILE)
    meta, _, shapes, values = raw.read(out, layer="vehicle_tracks")
    assert meta["crs"] == "EPSG:32632"
    assert meta["geometry_type"] == "LineString"
    found = dict(zip(meta["fields"].tolist(), values, strict=True))
    assert found["vehicle"].tolist() == [track.id for track in tracks.vehicles]
    assert found["begins"].astype("datetime64[ms]").tolist() == [
        datetime.datetime(1970, 1, 1) + datetime.timedelta(milliseconds=int(track.time_ns[0] // 10**6))
        for track in tracks.vehicles
    ]
    for shape, track in zip(shapes, tracks.vehicles, strict=True):
        points = np.frombuffer(shape, "<f8", offset=9).reshape(-1, 2)
        assert points[[0, -1]] == pytest.approx(track.xy_m[[0, -1]], abs=1e-6)
    meta, _, shapes, values = raw.read(out, layer="vehicle_places")
    found = dict(zip(meta["fields"].tolist(), values, strict=True))
    for track in tracks.vehicles:
        own = found["vehicle"] == track.id
        times_ms = found["at"][own].astype("datetime64[ms]").astype(np.int64)
        assert np.isin(times_ms, track.time_ns // 10**6).all()
        for time_ms, shape in zip(times_ms, shapes[own], strict=True):
            (at,) = np.flatnonzero(track.time_ns // 10**6 == time_ms)
            assert np.frombuffer(shape, "<f8", offset=5) == pytest.approx(track.xy_m[at], abs=1e-6)
    meta, _, shapes, values = raw.read(out, layer="marks")
    assert sorted(dict(zip(meta["fields"].tolist(), values, strict=True))["cells"].tolist()) == [1, 2, 3]
    assert len(raw.read(out, layer="captures")[2]) == len(recorder.captures)
    assert swarm(monkeypatch, "map", "export", run / "map.sqlite", tmp_path / "marks.gpkg") == 0
    assert len(raw.read(tmp_path / "marks.gpkg", layer="marks")[2]) == 3


def test_polygons_of_marks_cover_the_cells_that_are_marked_and_no_others() -> None:
    chance = np.random.default_rng(5)
    kinds = chance.choice(np.array([0, 1, 2, 255], np.uint8), (40, 50), p=[0.3, 0.3, 0.1, 0.3])
    paces = chance.choice(np.array([0.1, 0.25, 3.0], np.float32), (40, 50))
    grid = GridSpec(40, 50, 10.0, 100.0, 900.0)
    layer = mark_layer(grid, kinds, paces, np.full((40, 50), BEGAN_NS))
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


def test_what_cannot_be_exported_is_said_in_a_sentence(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    for words, complaint in (
        (("nowhere", "--out", tmp_path / "a.gpkg"), "there is no run 'nowhere'"),
        ((run, "--out", tmp_path / "a.doc"), "write .geojson or .gpkg"),
        ((run, "--out", tmp_path / "no" / "a.gpkg"), "cannot write there"),
        ((tmp_path / "empty", "--out", tmp_path / "a.gpkg"), "has no tracks.npz: the run has not ended yet"),
    ):
        assert swarm(monkeypatch, "report", "export", *words) == 2
        told = capsys.readouterr().err
        assert complaint in told
        assert told.count("\n") == 1
    whole = (run / TRACKS_FILE).read_bytes()
    for number, broken in enumerate((b"", b"PK", whole[: len(whole) // 2], whole[:300] + bytes(100) + whole[400:])):
        (tmp_path / f"{number}.npz").write_bytes(broken)
        with pytest.raises(StoreError, match="is damaged"):
            read_tracks(tmp_path / f"{number}.npz")
