"""A machine without the terrain's file, played by a folder without it: it drives on what the keeper sends."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import from_origin
from support.height_models import written
from support.live_swarm import Hands, swarm, write_scenario
from support.processes import eventually

from swarm.config.scenario_files import load_scenario
from swarm.wire.route_columns import RouteStatus

pytestmark = [pytest.mark.network, pytest.mark.slow]

ROWS, COLS = 300, 280


def scenario_of_a_file(folder: Path) -> Path:
    """The small scenario, on `ridge.tif` beside it: a hill of 300 m, as a GeoTIFF of 30 m cells."""
    folder.mkdir(exist_ok=True)
    south, east = np.mgrid[0:ROWS, 0:COLS].astype(np.float32)
    height_m = 300 * np.exp(-((south - 150) ** 2 + (east - 140) ** 2) / 2 / 60**2).astype(np.float32)
    written(folder / "ridge.tif", height_m, transform=from_origin(500_000, 5_000_000, 30, 30))
    path = folder / "small.toml"
    text = write_scenario(folder).read_text()
    head, rest = text.split("[terrain]")
    hidden = rest.index("[terrain.hidden]")
    path.write_text(f'{head}[terrain]\nsource = "ridge.tif"\n\n{rest[hidden:]}')
    return path


def test_planner_and_agents_without_the_file_drive_on_the_keepers_base_map(hands: Hands) -> None:
    here = scenario_of_a_file(hands.folder / "here")
    there = hands.folder / "there" / "small.toml"
    there.parent.mkdir()
    there.write_text(here.read_text())
    hands.network = load_scenario(here).network
    endpoint = hands.network.connect[0]

    hands.start("role", "router", str(here))
    eventually(lambda: swarm("status", "--connect", endpoint).returncode == 0, 30, "the router")
    elsewhere = hands.folder / "elsewhere"  # another machine keeps its runs elsewhere
    planner = hands.start("role", "planner", str(there), "--target", "t0", runs=elsewhere)
    sentence = f"there is no file {there.parent / 'ridge.tif'} here: waiting for a keeper, which hands it out"
    eventually(lambda: hands.logs().count(sentence) == 1, 90, "a planner that waits for a keeper")
    time.sleep(3)
    assert planner.poll() is None
    assert hands.logs().count(sentence) == 1

    # A router belongs to no run: what starts beside it says which run it is.
    for role in ("keeper", "targets"):
        hands.start("role", role, str(here), "--run-id", "far")
    eventually(lambda: len(hands.members()) == 3, 60, "those with the file")
    hands.start("role", "agent", str(there), "--id", "a0", runs=elsewhere)
    eventually(lambda: len(hands.members()) == 5, 60, "all five")
    assert "there is no file" in hands.logs()
    assert "terrain.json" in {path.name for path in (elsewhere / "far").iterdir()}

    eventually(lambda: hands.route_status() is RouteStatus.OK, 60, "a route")
    status = json.loads(swarm("status", "--connect", endpoint, "--json").stdout)
    (agent,) = (process for process in status["processes"] if process["role"] == "agent")
    assert agent["counts"]["payloads_dropped"] == 0

    there.write_text(here.read_text() + "\n[cost]\nmax_slope_deg = 20\n")
    told = swarm("role", "agent", there, "--id", "a1", "--runs", there.parent / "runs", timeout_s=90)
    assert told.returncode == 3
    assert "are the [cost] sections of the scenarios the same?" in told.stderr
    assert "Traceback" not in told.stderr
