"""Plug-ins in real processes: those that fail are named and gone on without."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.live_swarm import folders_of_runs, swarm, write_scenario

pytestmark = [pytest.mark.network, pytest.mark.slow]

FAILING = """
import itertools, math, numpy as np
from vehicle_agent.sensing.sensor import Sight
class Plugin:
    def __init__(self, world, options): self.world, self.calls = world, itertools.count()
class Hangs(Plugin):
    def look(self, cells):
        while next(self.calls) >= 20: pass
        return Sight(np.empty(0, int), np.empty(0))
class Raises(Plugin):
    def choose(self, cell, vehicles): raise OSError("no map of the way")
class Unspeakable(Plugin):
    def speed(self, stretch): return math.nan if next(self.calls) > 99 else 1e9
class Silent(Plugin):
    def assign(self, table): return None
    def row(self, growths): return None
"""


def test_a_swarm_all_whose_plugins_fail_names_each_and_goes_on(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, "[planner]\nstrategy = 'failing:Silent'\n")
    text = path.read_text().replace('walk = "waypoints"', "walk = 'failing:Raises'")
    names = "sensor = 'failing:Hangs'\nassignment = 'failing:Silent'\ndynamics = 'failing:Unspeakable'"
    path.write_text(text.replace("per_agent = 6", f"per_agent = 6\n{names}"))
    (tmp_path / "failing.py").write_text(FAILING)
    told = swarm("up", path, "--runs", tmp_path / "runs", "--seconds", 12, "--plain", timeout_s=110)
    said = told.stdout + told.stderr
    assert told.returncode == 0, said
    for sentence in (
        "sensor plug-in 'failing:Hangs' of vehicles.sensor: look took more than 2 s; this agent",
        "walk plug-in 'failing:Raises' of targets[0].walk: choose raised OSError: no map of the way (failing.py:",
        "dynamics plug-in 'failing:Unspeakable' of vehicles.dynamics: speed returned nan m/s",
        "assignment plug-in 'failing:Silent' of vehicles.assignment: assign returned object (), expected",
        "strategy plug-in 'failing:Silent' of planner.strategy: row returned NoneType, expected a StrategyRow",
    ):
        assert sentence in " ".join(said.split()), said
    (run_dir,) = folders_of_runs(tmp_path / "runs")
    numbers = json.loads((run_dir / "report.json").read_text())
    assert (numbers["vehicles_routed"], numbers["collisions"], numbers["lethal_entries"]) == (12, 0, 0)
    assert numbers["restarts"] == 0
