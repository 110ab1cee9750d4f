"""The results of a run: the numbers and the picture."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray
from support import fake_run

from launch_scripts.observe.fact_table import verdict
from launch_scripts.observe.recorder import Recorder
from launch_scripts.report import run_picture as picture
from launch_scripts.report import run_plots as plots
from launch_scripts.report.write_report import make_report, write_report
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.config.scenario import Scenario
from swarm.errors import StoreError
from swarm.files import write_file
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import VehicleState

ASKED_FOR = [
    "scenario", "seed", "seconds", "vehicles", "targets", "processes", "restarts", "captures", "stranded", "lost",
    "reroute_requests", "marks", "routes_served", "collisions", "lethal_entries", "startup_s", "gap", "growth_ms",
    "route_query_ms", "mark_to_tree_ms",
]  # fmt: skip


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return fake_run.little_scenario(12.0)


@pytest.fixture(scope="module")
def ground() -> tuple[Terrain, NDArray[np.float32]]:
    rows, cols = np.mgrid[0:48, 0:64].astype(np.float32)
    elevation_m = 40 * np.sin(rows / 9) + 30 * np.cos(cols / 7)
    terrain = terrain_of_pace(np.full((48, 64), 0.1, np.float32), 25.0, elevation_m.astype(np.float32))
    truth = np.array(terrain.pace_s_per_m)
    truth[20:26, 10:40] = np.inf
    truth[5:12, 45:55] = 0.3
    return terrain, truth


@pytest.fixture(scope="module")
def played(scenario: Scenario, ground: tuple[Terrain, NDArray[np.float32]]) -> Recorder:
    return fake_run.played(*ground, scenario)


def test_the_report_has_every_number_that_was_asked_for(
    played: Recorder, ground: tuple[Terrain, NDArray[np.float32]], tmp_path: Path
) -> None:
    returned = make_report(played, ground[0], run_id="r1", startup_s=1.5)
    write_report(tmp_path, returned, played, ground[0], truth=ground[1])
    report = json.loads((tmp_path / "report.json").read_text())
    assert report == json.loads(json.dumps(returned)) | {"ground_shows": ["hidden"]}
    assert [name for name in ASKED_FOR if report.get(name) is None] == []
    assert report["startup_s"] == 1.5
    assert report["restarts"] == 0
    assert report["captures"] == len(played.captures) > 0
    assert report["marks"] == report["marked_cells"] > 0
    assert report["vehicles_routed"] == 10
    outcome = r"10 of 10 vehicles routed, \d+ captures?, no collision\. All went well\."
    assert re.fullmatch(outcome, report["verdict"])
    worse = {**report, "collisions": 1, "lost": 2}
    assert verdict(worse, ["agent-a0 did not end"]).endswith(
        "1 collision. Not all went well: agent-a0 did not end; collisions 1; 2 of 10 vehicles lost at the end."
    )
    assert set(report["gap"]) == {"mean", "p95", "max"}
    assert set(report["growth_ms"]) == {"p50", "p99"}
    assert len(report["series"]["t_s"]) == len(report["series"]["captures"]) >= 10
    image = imread(tmp_path / "report.png")
    assert image.shape[:2] == (round(picture.HEIGHT_IN * picture.DPI), round(picture.WIDTH_IN * picture.DPI))
    assert image[..., :3].std() > 0.1
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "ground.npz", "ground.webp", "groups.csv", "report.html", "report.json", "report.png", "targets.csv",
        "tracks.npz", "vehicles.csv",
    ]  # fmt: skip


def test_a_run_of_which_nothing_was_heard_still_leaves_a_report(scenario: Scenario, tmp_path: Path) -> None:
    terrain = terrain_of_pace(np.ones((1, 1), np.float32))
    recorder = Recorder(scenario, GridSpec(1, 1, 10.0))
    report = make_report(recorder, terrain)
    write_report(tmp_path, report, recorder, terrain)
    assert report["captures"] is None
    assert (tmp_path / "report.png").stat().st_size > 10_000
    # It may be stopped before a vehicle has reported its place.
    series = {"t_s": [0.5], **{state.name.lower(): [0] for state in VehicleState}}
    assert not plots.PLOTS[0].draw(Figure().add_subplot(), plots.PLOTS[0], {"series": series})


def test_a_folder_that_cannot_be_written_is_one_clear_sentence(scenario: Scenario, tmp_path: Path) -> None:
    terrain = terrain_of_pace(np.ones((4, 4), np.float32))
    recorder = Recorder(scenario, terrain.grid)
    report = make_report(recorder, terrain)
    with pytest.raises(StoreError, match=r"cannot write .*nowhere/report\.json: No such file"):
        write_report(tmp_path / "nowhere", report, recorder, terrain)
    for path in (Path("/dev/full"), Path("/sys/notes")):  # ENOSPC, EACCES
        with pytest.raises(StoreError, match=rf"cannot write {path}: (No space|Permission)"):
            write_file(path, b"1")
