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
from swarm.bus.endpoints import listening

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


def test_what_one_process_or_none_needs_is_not_loaded_for_all() -> None:
    loaded = json.loads(
        _python(
            "import json, sys\nimport launch_scripts.launcher.preloaded\n"
            "print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
        )
    )
    assert "numba" in loaded
    assert {"rerun", "rasterio", "matplotlib", "PIL", "pyarrow", "typer"}.isdisjoint(loaded)


_LAUNCHER = """
import json, sys
import numpy as np
import launch_scripts.cli
from launch_scripts.launcher import up
from launch_scripts.simulation.sample_worlds import crowd

scenario, terrain = crowd("open", 1, 8, 4)
up.check_places(scenario, terrain, terrain.pace_s_per_m, np.isfinite(terrain.pace_s_per_m))
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def test_a_launcher_checks_a_prepared_terrain_without_a_library_that_is_large() -> None:
    loaded = json.loads(_python(_LAUNCHER))
    assert "numpy" in loaded
    assert {"scipy", "numba", "rerun", "rasterio", "matplotlib", "PIL", "pyarrow"}.isdisjoint(loaded)


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
