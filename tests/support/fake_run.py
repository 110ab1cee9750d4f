"""The messages of a simulated run, as an observer receives them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from launch_scripts.observe.recorder import Recorder
from launch_scripts.report.report_and_tracks import make_report, write_report
from launch_scripts.simulation.simulate import EPOCH_NS as BEGAN_NS
from launch_scripts.simulation.simulate import Simulation
from shared_map.array_files import Floats
from shared_map.terrain.terrain import Terrain
from swarm.config.scenario import Scenario
from swarm.config.toml_files import parse_scenario
from swarm.peers import Peer
from swarm.wire.messages import Message


def fake_run(terrain: Terrain, truth: Floats, scenario: Scenario) -> Iterator[tuple[int, Message | Peer]]:
    """(time, message or peer that came up) in order of time, from 0 on."""
    simulation = _simulation(terrain, truth, scenario)
    told: list[tuple[int, Message | Peer]] = []

    def heard(message: Message, now_ns: int) -> None:
        told.append((now_ns - BEGAN_NS, message))

    def alive(peer: Peer, up: bool, now_ns: int) -> None:
        if up:
            told.append((now_ns - BEGAN_NS, peer))

    simulation.recorder.heard, simulation.recorder.alive = heard, alive  # type: ignore[method-assign]
    simulation.run_until(scenario.seconds)
    yield from told


def little_scenario(seconds: float = 6.0, vehicles: int = 10, time_scale: int = 10, more: str = "") -> Scenario:
    """Two targets, and vehicles of one group."""
    return parse_scenario(
        f'name = "little"\nseed = 3\nseconds = {seconds}\ntime_scale = {time_scale}\n'
        f'[[targets]]\nname = "t"\ncount = 2\n[[groups]]\nvehicles = {vehicles}\n{more}'
    )


def leave(folder: Path, recorder: Recorder, terrain: Terrain, truth: Floats) -> None:
    """Writes what a run leaves into a new folder, but an empty picture: that is another test's."""
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("launch_scripts.report.run_page_and_map.save_picture", lambda half, *_: half.touch())
        write_report(folder, make_report(recorder, terrain, run_id="r1"), recorder, terrain, truth=truth)


def played(terrain: Terrain, truth: Floats, scenario: Scenario) -> Recorder:
    """The recorder of a run which began at BEGAN_NS: it has heard all of it."""
    simulation = _simulation(terrain, truth, scenario)
    simulation.run_until(scenario.seconds)
    return simulation.recorder


def _simulation(terrain: Terrain, truth: Floats, scenario: Scenario) -> Simulation:
    simulation = Simulation(scenario, terrain=terrain)
    simulation.truth = truth
    return simulation
