"""A target whose tracker is an outside process: served, never stolen, lost, regained, passed on."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.live_swarm import LiveSwarm, swarm
from support.processes import eventually

from swarm.wire.messages import schema_of

pytestmark = [pytest.mark.network, pytest.mark.slow]

EXTERNAL = """
[[targets]]
name = "x"
walk = "external"
caught = "stay"
"""
OUTSIDE = Path(__file__).parents[1] / "support" / "outside_tracker.py"
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "tracker.py"


class Outside:
    """The processes that are not ours."""

    def __init__(self, live: LiveSwarm) -> None:
        self._live = live
        self.started: list[subprocess.Popen[bytes]] = []

    def start(self, tracker: str, row: int, col: int) -> subprocess.Popen[bytes]:
        schema = schema_of("pose")
        return self._start(OUTSIDE, self._live.endpoint, schema, "x", tracker, *_place_m(row, col))

    def start_example(self, tracker: str, row: int, col: int) -> subprocess.Popen[bytes]:
        """The program in the documentation, which has nothing of ours either and puts JSON."""
        return self._start(EXAMPLE, self._live.endpoint, "x", tracker, *_place_m(row, col))

    def _start(self, *command: object) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, *map(str, command)], cwd="/")
        self.started.append(process)
        return process


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveSwarm]:
    running = LiveSwarm(tmp_path, "--no-live", also=EXTERNAL)
    try:
        yield running
    finally:
        running.kill()


def _place_m(row: int, col: int) -> tuple[float, float]:
    side_m = 30.0  # as the scenario says; its corner in the north-west is 0, 0
    return (col + 0.5) * side_m, -(row + 0.5) * side_m


def status_of_x(live: LiveSwarm) -> dict[str, Any]:
    told = json.loads(swarm("status", "--connect", live.endpoint, "--json").stdout)
    return next(dict(each) for each in told["planners"] if each["target"] == "x")


def route_to_x(live: LiveSwarm, *options: str) -> str:
    return swarm(
        "route", "--connect", live.endpoint, "--target", "x", "--from", "cell:40,40", "--steps", 1, *options
    ).stdout


@pytest.mark.thorough
def test_a_tracker_from_outside_owns_its_target_until_it_is_dead_or_hands_it_over(live: LiveSwarm) -> None:
    live.wait_until_up()
    outside = Outside(live)
    try:
        assert "no_target" in route_to_x(live)
        assert status_of_x(live)["pose_age_s"] is None
        first = outside.start("radar", 50, 60)
        eventually(lambda: status_of_x(live)["tracker"] == "radar", 20, "the first pose")
        reply = json.loads(route_to_x(live, "--json"))
        assert reply["target_cell"] == 50 * 128 + 60
        assert reply["pose_age_s"] < 2
        assert not reply["tracker_lost"]
        second = outside.start_example("camera", 20, 90)
        eventually(lambda: live.said("poses of tracker camera are refused, as tracker radar owns it"), 20, "a note")
        assert status_of_x(live)["target_cell"] == 50 * 128 + 60
        first.kill()
        eventually(lambda: status_of_x(live)["tracker"] == "camera", 20, "the second tracker")
        assert status_of_x(live)["target_cell"] == 20 * 128 + 90
        second.kill()
        eventually(lambda: bool(status_of_x(live)["tracker_lost"]), 20, "the loss")
        assert "x is lost: it has no tracker, and this is its position" in route_to_x(live)
        eventually(lambda: live.said("outdated") and live.said("target lost: "), 20, "the live line")
        third = outside.start("radar", 50, 61)
        eventually(lambda: not status_of_x(live)["tracker_lost"], 20, "the return")
        outside.start("camera", 20, 91)
        third.terminate()
        assert third.wait(10) == 0
        eventually(lambda: status_of_x(live)["tracker"] == "camera", 20, "the handover")
    finally:
        for process in outside.started:
            process.kill()
            process.wait(10)
    assert live.end() == 0
    tracking = json.loads((live.run_dir / "report.json").read_text())["tracking"]
    assert tracking["lost"] >= 1
    assert tracking["poses_refused"] > 0
    said = live.output.read_text()
    assert "Traceback" not in said
    for sentence in ("tracks it now, before that tracker radar did", "without a known position"):
        assert sentence in said
