"""Grounds of classes of vehicles: prepared in a run's folder, mapped by every process."""

from pathlib import Path

import numpy as np
import pytest

from shared_map import vehicle_class_grounds as module
from shared_map.terrain.store import load_beside, prepare, scenario_key
from shared_map.vehicle_class_grounds import (
    class_grounds,
    class_terrains,
    class_truths,
    load_classes,
    prepare_classes,
)
from swarm.config.toml_files import parse_scenario
from swarm.errors import TerrainError
from swarm.runtime.role_setup import RoleSetup

_TEXT = """
seed = 5
terrain = {{ source = "synthetic", rows = 48, cols = 64, relief_m = 400.0, hidden = {{ rubble_fields = 3 }} }}
cost = {{ max_slope_deg = 20.0, directional = {directional} }}
groups = [{{ vehicles = 1 }}, {{ name = "walkers", class = "walker", vehicles = 1 }}]
[[classes]]
name = "walker"
max_speed_m_per_s = {speed}
cost = {{ max_slope_deg = 40.0, vehicle_radius_m = 9.0 }}
"""


@pytest.mark.parametrize("directional", ["false", "true"])
def test_what_is_prepared_is_what_would_be_made(tmp_path, directional, monkeypatch):
    scenario = parse_scenario(_TEXT.format(speed=1.5, directional=directional))
    terrain, truth = prepare(tmp_path, scenario)
    made = class_grounds(scenario, terrain, truth)
    prepare_classes(tmp_path, scenario, terrain, truth)
    again, truth_again = prepare(tmp_path, scenario)
    monkeypatch.setattr(module, "build_terrain", None)  # nothing is built twice
    load_classes(RoleSetup(scenario, "run", "agent", "a0", 1, 1, run_dir=tmp_path), again)
    found = class_grounds(scenario, again, truth_again)
    assert np.array_equal(load_beside(tmp_path, "homes", scenario_key(scenario)), made["ground"].homes)
    assert load_beside(tmp_path, "homes", "another") is None
    assert list(found) == list(made) == ["ground", "walker"]
    for name, ground in found.items():
        for array in ("truth", "homes"):
            assert np.array_equal(getattr(ground, array), getattr(made[name], array))
        for array in ("pace_s_per_m", "ground_s_per_m", "elevation_m"):
            same = getattr(ground.terrain, array), getattr(made[name].terrain, array)
            assert np.array_equal(*same, equal_nan=True)
        assert ground.terrain.digest == made[name].terrain.digest
        assert ground.terrain.least_s_per_m == made[name].terrain.least_s_per_m
        assert (ground.terrain.climb is None) == (directional == "false")
    assert class_terrains(scenario, again)["walker"] is found["walker"].terrain
    assert class_truths(scenario, again, truth_again)["walker"] is found["walker"].truth


def test_a_folder_of_another_class_is_none(tmp_path: Path) -> None:
    slow, quick = (parse_scenario(_TEXT.format(speed=speed, directional="false")) for speed in (0.5, 1.5))
    terrain, truth = prepare(tmp_path, slow)
    prepare_classes(tmp_path, slow, terrain, truth)
    load_classes(RoleSetup(quick, "run", "agent", "a0", 1, 1, run_dir=tmp_path), terrain)
    walker = class_grounds(quick, terrain, truth)["walker"]
    assert 1 / 1.5 <= float(walker.truth.min()) < 1.0


def test_a_launcher_makes_a_damaged_folder_again_and_another_process_says_it_in_one_sentence(tmp_path):
    scenario = parse_scenario(_TEXT.format(speed=1.5, directional="false"))
    terrain, truth = prepare(tmp_path, scenario)
    prepare_classes(tmp_path, scenario, terrain, truth)
    pace, description = (tmp_path / "classes/walker" / name for name in ("pace.npy", "class.json"))
    whole = pace.read_bytes()
    pace.unlink()  # it may be linked to the kept one
    pace.write_bytes(whole[:-2] + bytes([whole[-2] ^ 1]) + whole[-1:])
    description.write_text("{")
    with pytest.raises(TerrainError, match=r"prepared class .* is damaged .*; delete the folder"):
        load_classes(RoleSetup(scenario, "run", "agent", "a0", 1, 1, run_dir=tmp_path), terrain)
    prepare_classes(tmp_path, scenario, terrain, truth)
    assert pace.read_bytes() == whole


def test_a_class_that_can_stand_nowhere_in_truth_is_said() -> None:
    scenario = parse_scenario(_TEXT.format(speed=1.5, directional="false").replace("= 40.0", "= 10.0"))
    terrain = module.build_terrain(scenario)
    with pytest.raises(TerrainError, match="class walker: no cell that it can drive by the map is so in truth"):
        class_grounds(scenario, terrain, np.full_like(terrain.pace_s_per_m, np.inf))


def test_a_surface_that_is_prepared_keeps_its_wind_and_another_wind_is_another_surface(tmp_path: Path) -> None:
    text = """
terrain = { source = "synthetic", rows = 32, cols = 48, relief_m = 200.0 }
groups = [{ vehicles = 1 }, { name = "drones", class = "drone", vehicles = 1 }]
classes = [{ name = "drone", air = { speed_m_per_s = 10 } }]
"""
    west, south = (parse_scenario(f"{text}wind = {{ speed_m_per_s = 4, from_deg = {of} }}") for of in (270, 180))
    terrain, truth = prepare(tmp_path, west)
    prepare_classes(tmp_path, west, terrain, truth)
    made = class_terrains(west, terrain)["drone"]
    again, _ = prepare(tmp_path, west)
    load_classes(RoleSetup(west, "run", "agent", "a0", 1, 1, run_dir=tmp_path), again)
    found = class_terrains(west, again)["drone"]
    assert found is not made
    assert found.climb.wind == made.climb.wind
    assert found.climb.windy
    assert np.array_equal(found.climb.table, made.climb.table)
    assert (found.digest, found.notes) == (made.digest, made.notes)
    other = class_terrains(south, again)["drone"]
    assert other.digest != found.digest
    assert other.climb.wind != found.climb.wind
