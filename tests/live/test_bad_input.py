"""Scenarios that no swarm can run: a sentence and an exit code, soon, and no process left behind."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.live_swarm import swarm, write_scenario

pytestmark = [pytest.mark.network, pytest.mark.slow]


@pytest.mark.parametrize(
    ("old", "new", "code", "sentence"),
    [
        ('source = "synthetic"', 'source = "nowhere.tif"', 3, "terrain.source: no such file"),
        (
            "roads = 4",
            "roads = 0\n[cost]\nmax_slope_deg = 0.0001",
            3,
            "every cell of the terrain is lethal",
        ),
        ('walk = "waypoints"', "start = [500, 3]", 2, "start is [500, 3], outside the terrain: 96 x 128 cells"),
        ("vehicles = 12", "vehicles = 12\ncells = [[3, 500]]", 2, "cells is [3, 500], outside the terrain"),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_sentence(
    tmp_path: Path, old: str, new: str, code: int, sentence: str
) -> None:
    path = write_scenario(tmp_path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    told = swarm("up", path, "--runs", tmp_path / "runs", "--plain", timeout_s=100)
    assert told.returncode == code, told.stdout + told.stderr
    assert sentence in told.stderr
    assert told.stderr.count("\n") == 1
    assert "Traceback" not in told.stdout + told.stderr
