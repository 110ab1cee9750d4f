"""The messages of a simulated run, as an observer receives them."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from launch_scripts.observe.recorder import Recorder
from launch_scripts.report.report_and_tracks import make_report, write_report
from launch_scripts.simulation.simulate import EPOCH_NS as BEGAN_NS
from launch_scripts.simulation.simulate import Simulation
from shared_map.array_files import Floats
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import parse_scenario, scenario_text
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.wire.messages import Message
from swarm.wire.messages.processes import Note

GRID = GridSpec(48, 64, 25.0, 500_000.0, 5_200_000.0, "EPSG:32632")
HOSTILE = "<script>alert(1)</script>\"'><img src=http://example.org/x onerror=alert(2)>"


def fake_run(terrain: Terrain, truth: Floats, scenario: Scenario) -> Iterator[tuple[int, Message | Peer]]:
    """(time, message or peer that came up) in order of time, from 0 on."""
    simulation = _simulation(terrain, truth, scenario)
    told: list[tuple[int, Message | Peer]] = []

    def heard(message: Message, now_ns: int) -> None:
        told.append((now_ns - BEGAN_NS, message))

    def alive(peer: Peer, up: bool, now_ns: int) -> None:
        if up:
            told.append((now_ns - BEGAN_NS, peer))

    simulation.recorder.on_message, simulation.recorder.alive = heard, alive  # type: ignore[method-assign]
    simulation.run_until(scenario.seconds)
    yield from told


def little_scenario(seconds: float = 6.0, vehicles: int = 10, time_scale: int = 10, more: str = "") -> Scenario:
    """Two targets, and vehicles of one group."""
    return parse_scenario(
        f'name = "little"\nseed = 3\nseconds = {seconds}\ntime_scale = {time_scale}\n'
        f'[[targets]]\nname = "t"\ncount = 2\n[[groups]]\nvehicles = {vehicles}\n{more}'
    )


def played(terrain: Terrain, truth: Floats, scenario: Scenario) -> Recorder:
    """The recorder of a run which began at BEGAN_NS: it has heard all of it."""
    simulation = _simulation(terrain, truth, scenario)
    simulation.run_until(scenario.seconds)
    return simulation.recorder


def leave_run(folder: Path) -> Recorder:
    """Writes what a run leaves into a folder, but an empty picture: that is another test's. Returns its recorder.

    A note of the run, and its scenario, hold a name that would rather be a script.
    """
    zone = "[[cost.zones]]\nkind = 'forbidden'\npolygon_m = [[200, 200], [800, 200], [800, 600], [200, 600]]\n"
    scenario = little_scenario(20.0, vehicles=4, more=zone)
    pace = np.full((48, 64), 0.1, np.float32)
    pace[30:, 20:40], pace[8:24, 8:32] = 0.4, np.inf
    terrain = dataclasses.replace(terrain_of_pace(pace, 25.0), grid=GRID)
    truth = np.array(pace)
    truth[28:40, 8:60], truth[5:12, 45:55] = np.inf, 0.3
    recorder = played(terrain, truth, scenario)
    note = Note(role="agent", id="a0", stamp_ns=1, kind="odd", text=HOSTILE, cell=None, target=None)
    recorder.on_message(note, recorder.observed.last_ns or 0)
    (folder / "scenario.toml").write_text(f"# {HOSTILE}\n" + scenario_text(scenario, folder))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("launch_scripts.report.run_page_and_map.save_picture", lambda half, *_: half.touch())
        write_report(folder, make_report(recorder, terrain, run_id="r1"), recorder, terrain, truth=truth)
    return recorder


def _simulation(terrain: Terrain, truth: Floats, scenario: Scenario) -> Simulation:
    simulation = Simulation(scenario, terrain=terrain)
    simulation.truth = truth
    return simulation
