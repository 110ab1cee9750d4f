"""Cost layers of the user's own: where they stand among the other rules; all processes have the same map."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.plugin_modules import forgotten_afterwards

from launch_scripts.launcher.fetched_terrain import missing_files
from shared_map.terrain.store import kept_key, scenario_key
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.terrain.true_ground import build_truth
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import load_scenario
from swarm.errors import ConfigError, RunMismatchError, TerrainError
from swarm.runtime.membership import check_same_run
from swarm.runtime.role_setup import RoleSetup

SCENARIO = """
terrain = { source = "synthetic", rows = 40, cols = 50 }
[[cost.zones]]
kind = "forbidden"
polygon_m = [[0, 0], [200, 0], [200, 200], [0, 200]]
"""
LAYER = """
[[cost.layers]]
layer = "layers:{name}"
options = {{ by = {by} }}
"""
MODULE = """
import time, numpy as np
class Factor:
    def __init__(self, world, options): self.world, self.by = world, options["by"]
    def cost(self, pace): return pace * np.float32(self.by)
class Bridge(Factor):
    def cost(self, pace):
        pace[:] = 0.1
        return pace
class Wall(Factor):
    def cost(self, pace): return np.full_like(pace, np.inf)
class Zero(Factor):
    def cost(self, pace): return np.zeros_like(pace)
class Raises(Factor):
    def cost(self, pace): raise KeyError("snow")
class Writes(Factor):
    def cost(self, pace): self.world.elevation_m[0, 0] = 3
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "layers.py").write_text(MODULE)
    with forgotten_afterwards(tmp_path):
        yield tmp_path


def scenario(folder: Path, *layers: tuple[str, float]) -> Scenario:
    text = SCENARIO + "".join(LAYER.format(name=name, by=by) for name, by in layers)
    (folder / "scenario.toml").write_text(text)
    return load_scenario(folder / "scenario.toml")


def built(folder: Path, *layers: tuple[str, float]) -> Terrain:
    return build_terrain(scenario(folder, *layers))


def test_layers_are_applied_in_order_to_map_and_truth(folder: Path) -> None:
    plain, twice = built(folder), built(folder, ("Factor", 1.5), ("Factor", 2.0))
    once = np.where(
        np.isinf(plain.ground_s_per_m), np.inf, plain.ground_s_per_m * np.float32(1.5) * np.float32(2.0)
    )
    assert np.allclose(twice.ground_s_per_m, once)
    truth = build_truth(scenario(folder, ("Factor", 1.5), ("Factor", 2.0)), twice)
    assert np.array_equal(truth, twice.ground_s_per_m)
    bridged = built(folder, ("Bridge", 1.0), ("Factor", 3.0))
    assert set(np.unique(bridged.ground_s_per_m)) == {np.float32(0.1) * np.float32(3.0), np.float32(np.inf)}


def test_no_layer_opens_a_forbidden_zone(folder: Path) -> None:
    terrain = built(folder, ("Bridge", 1.0))
    reach = int(200 / terrain.grid.resolution_m)
    assert np.isinf(terrain.ground_s_per_m[:reach, :reach]).all()
    assert np.isfinite(terrain.ground_s_per_m).any()


def test_processes_with_other_layers_refuse_each_other(folder: Path) -> None:
    terrains = [built(folder, *layers) for layers in ([], [("Factor", 1.5)], [("Factor", 2.0)], [("Factor", 1.0)])]
    assert len({terrain.digest for terrain in terrains}) == 4
    assert built(folder, ("Factor", 1.5)).digest == terrains[1].digest
    infos = [
        RoleSetup(scenario(folder), "run", "agent", f"a{n}", 1, 1).info(terrain.grid, terrain.digest)
        for n, terrain in enumerate(terrains)
    ]
    with pytest.raises(RunMismatchError, match="terrain files or cost rules differ"):
        check_same_run(infos[1], infos[2])


def test_a_prepared_terrain_is_of_no_use_once_the_module_has_changed(folder: Path) -> None:
    before = scenario_key(scenario(folder, ("Factor", 1.5)))
    assert scenario_key(scenario(folder, ("Factor", 1.5))) == before
    (folder / "layers.py").write_text(MODULE.replace("return pace *", "return pace * 2 *"))
    assert scenario_key(scenario(folder, ("Factor", 1.5))) != before
    assert kept_key(scenario(folder, ("Factor", 1.5))) is None
    assert kept_key(scenario(folder)) is not None


def test_a_machine_that_lacks_the_module_has_to_fetch_the_map(folder: Path) -> None:
    assert missing_files(scenario(folder, ("Factor", 1.5))) == []
    (folder / "layers.py").unlink()
    assert missing_files(scenario(folder, ("Factor", 1.5))) == ["layers:Factor"]
    with pytest.raises(ConfigError, match=r"cost\.layers\[0\]\.layer: 'layers:Factor' could not be imported"):
        built(folder, ("Factor", 1.5))


@pytest.mark.parametrize(
    ("name", "by", "said"),
    [
        ("Raises", 1.0, "cost raised KeyError: 'snow' (layers.py:"),
        ("Writes", 1.0, "cost raised ValueError: assignment destination is read-only (layers.py:"),
        ("Zero", 1.0, "cost returned pace 0 at row "),
        ("Factor", -1.0, "cost returned pace -"),
        ("Factor", 1e9, "cost returned pace "),
        ("Factor", "nan", "cost returned pace nan at row "),
        ("Wall", 1.0, "every cell of the terrain is lethal"),
    ],
)
def test_there_is_no_map_without_a_layer_that_fails(name: str, by: float, said: str, folder: Path) -> None:
    with pytest.raises(TerrainError) as refused:
        built(folder, (name, by))
    assert said in str(refused.value)
    if name != "Wall":
        assert str(refused.value).startswith(f"cost_layer plug-in 'layers:{name}' of cost.layers[0].layer: ")
