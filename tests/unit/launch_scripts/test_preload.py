"""Modules that the processes of a run share are loaded before the fork, and the command starts that first."""

import json
import os
import subprocess
import sys

import pytest

from launch_scripts import entry
from launch_scripts.launcher import forkserver

_ALL_ROLES = """
import json, sys
from shared_map.terrain import store
store.largest_part = lambda passable: passable
import launch_scripts.launcher.preloaded
from launch_scripts.simulation import simulate
simulate.build_truth = lambda scenario, terrain: terrain.pace_s_per_m
# A live run has both of them prepared, and imports nothing to find them.
from launch_scripts.simulation.sample_worlds import crowd
from swarm.endpoints import listening

from launch_scripts.simulation.world.walks import WAY_MODULES
from shared_map.keeper.zone_orders import ZONE_MODULES
from swarm.runtime.loop_health import Modules

Modules([*ZONE_MODULES, *WAY_MODULES]).wait()  # loaded beside the loops of one role each
scenario, terrain = crowd("open", 1, 8, 4)
simulation = simulate.Simulation(scenario, terrain=terrain)
before = set(sys.modules)
simulation.run_until(4.0)
listening("tcp/127.0.0.1:9")
print(json.dumps([simulation.report(4.0)["vehicles_routed"], sorted(set(sys.modules) - before)]))
"""


def _python(code: str) -> str:
    loads = {**os.environ, forkserver.LOADS: forkserver.ROLES_AND_KERNELS}
    return subprocess.run(
        [sys.executable, "-c", code], env=loads, capture_output=True, text=True, check=True
    ).stdout


def test_no_role_imports_for_itself_what_all_of_its_kind_need() -> None:
    routed, imported = json.loads(_python(_ALL_ROLES).splitlines()[-1])
    assert routed == 8
    assert imported == []


_LAUNCHER = """
import numpy as np
import launch_scripts.cli
from launch_scripts.launcher import up
from launch_scripts.simulation.sample_worlds import crowd

scenario, terrain = crowd("open", 1, 8, 4)
up.check_places(scenario, terrain, terrain.pace_s_per_m, np.isfinite(terrain.pace_s_per_m))
"""
_PROBE = """
import sys
from launch_scripts.entry import main

sys.argv = ["swarm", "health", "--url", "http://127.0.0.1:1"]
assert main() == 4
"""
_LARGE = {"rerun", "rasterio", "matplotlib", "PIL", "pyarrow"}
_OF_PROBES = {"typer", "click", "rich", "numpy", "msgspec", "zenoh", "asyncio", "http", "email", "ssl", "numba"}


@pytest.mark.parametrize(
    ("code", "needed", "left_out"),
    [
        ("import launch_scripts.cli", {"typer"}, {"zenoh", "numpy"}),
        ("import launch_scripts.launcher.preloaded", {"numba"}, {"typer", *_LARGE}),
        (_LAUNCHER, {"numpy"}, {"scipy", "numba", *_LARGE}),
        (_PROBE, {"socket"}, _OF_PROBES),
    ],
    ids=["help", "the fork server", "a launcher that checks a prepared terrain", "a probe"],
)
def test_what_is_large_is_not_loaded_where_it_is_not_needed(
    code: str, needed: set[str], left_out: set[str]
) -> None:
    shown = "\nimport json, sys\nprint(json.dumps([name.partition('.')[0] for name in sys.modules]))"
    loaded = set(json.loads(_python(code + shown).splitlines()[-1]))
    assert needed <= loaded
    assert left_out.isdisjoint(loaded)


@pytest.mark.parametrize(
    ("words", "starts"),
    [
        (["up", "jacksboro", "--port", "0"], True),
        (["demo"], True),
        (["up", "jacksboro", "--only", "agent"], False),
        (["up", "jacksboro", "--only=router"], False),
        (["up", "--help"], False),
        (["demo", "-h"], False),
        (["status", "up"], False),
        ([], False),
    ],
)
def test_a_command_that_starts_a_swarm_begins_with_what_takes_longest(
    words: list[str], starts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    monkeypatch.setattr(forkserver, "start_forkserver", lambda module: order.append(module))
    monkeypatch.setattr("launch_scripts.cli.main", lambda: order.append("cli") or 0)
    monkeypatch.setattr(sys, "argv", ["swarm", *words])
    assert entry.main() == 0
    assert order == [*([forkserver.ROLES_AND_KERNELS] if starts else []), "cli"]
