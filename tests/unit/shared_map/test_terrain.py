"""Terrain: the same scenario gives the same digest, and a prepared terrain opens in a blink or is refused."""

import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import ndimage

from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.store import (
    load_beside,
    load_prepared,
    load_terrain,
    load_truth,
    prepare,
    save_prepared,
    scenario_key,
)
from shared_map.terrain.terrain import build_terrain, terrain_of_pace
from swarm.config.ground import CostConfig, TerrainConfig, ZoneConfig
from swarm.config.scenario import Scenario
from swarm.errors import StoreError, TerrainError
from swarm.runtime.role_setup import RoleSetup

SMALL = Scenario(seed=2, terrain=TerrainConfig(source="synthetic", rows=48, cols=64, relief_m=150))


def with_cost(**changes: object) -> Scenario:
    return msgspec.structs.replace(SMALL, cost=CostConfig(**changes))


def test_the_same_scenario_gives_the_same_digest_and_another_rule_another() -> None:
    digest = build_terrain(SMALL).digest
    assert len(digest) == 16
    assert build_terrain(SMALL).digest == digest
    assert build_terrain(with_cost(steep_factor=7.0)).digest != digest
    assert build_terrain(msgspec.structs.replace(SMALL, seed=3)).digest != digest


def test_a_prepared_terrain_is_the_same(tmp_path: Path) -> None:
    scenario = with_cost(vehicle_radius_m=40.0)
    terrain, truth = prepare(tmp_path / "run", scenario)
    again = load_prepared(tmp_path / "run", scenario_key(scenario))
    assert (again.grid, again.digest, again.notes) == (terrain.grid, terrain.digest, terrain.notes)
    for name in ("elevation_m", "photo", "pace_s_per_m", "ground_s_per_m", "classes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(terrain, name))
    np.testing.assert_array_equal(load_beside(tmp_path / "run", "truth"), truth)
    assert again.vehicle_radius_m == 40.0
    assert (terrain.ground_s_per_m != terrain.pace_s_per_m).any()


def test_a_prepared_terrain_of_another_scenario_is_not_taken(tmp_path: Path) -> None:
    prepare(tmp_path, SMALL)
    other = msgspec.structs.replace(SMALL, seed=9)
    setup = RoleSetup(other, "r", "agent", "a0", 1, 1, tmp_path)
    assert load_prepared(tmp_path, scenario_key(other)) is None
    terrain = load_terrain(setup)
    assert terrain.digest == build_terrain(other).digest
    assert load_truth(setup, terrain).shape == (48, 64)
    assert load_prepared(tmp_path / "nowhere") is None


@pytest.mark.parametrize("damage", ["terrain.json", "pace.npy", "elevation.npy"])
def test_a_damaged_prepared_terrain_is_refused_with_a_sentence(tmp_path: Path, damage: str) -> None:
    prepare(tmp_path, SMALL)
    path = tmp_path / damage
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(TerrainError, match="delete"):
        load_prepared(tmp_path)


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    terrain = terrain_of_pace(np.ones((4, 4), np.float32))
    with pytest.raises(StoreError, match="cannot write"):
        save_prepared(tmp_path / "file" / "run", terrain, terrain.pace_s_per_m)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"max_slope_deg": 0.001}, "max_slope_deg"),
        ({"vehicle_radius_m": 1e4, "max_slope_deg": 5.0}, "vehicle_radius_m"),
        (
            {"zones": (ZoneConfig(kind="forbidden", polygon_m=((-1, -1), (1e5, -1), (1e5, 1e5), (-1, 1e5))),)},
            "zones",
        ),
    ],
)
def test_a_terrain_on_which_all_is_lethal_is_refused_and_says_why(changes: dict[str, object], why: str) -> None:
    with pytest.raises(TerrainError, match=rf"every cell .* lethal.*{why}"):
        build_terrain(with_cost(**changes))


def test_agents_that_load_a_prepared_terrain_import_nothing_slow(tmp_path: Path) -> None:
    prepare(tmp_path, SMALL)
    slow = ("numba", "rasterio", "skimage", "sklearn", "matplotlib", "scipy")
    code = (
        "import sys; from pathlib import Path; from shared_map.terrain.store import load_prepared;"
        "import shared_map.cost_map;"
        f"assert load_prepared(Path({str(tmp_path)!r}));"
        f"found = [m for m in {slow!r} if m in sys.modules]; assert not found, found"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[3], timeout=60)


@pytest.mark.parametrize("size", [(120, 150), (700, 640)])
def test_rivers_cross_a_synthetic_terrain_and_can_be_forded(size: tuple[int, int]) -> None:
    rows, cols = size
    source = TerrainConfig(source="synthetic", rows=rows, cols=cols, rivers=2, roads=3)
    terrain = build_terrain(Scenario(seed=6, terrain=source, cost=CostConfig(max_slope_deg=60)))
    water = terrain.classes == TerrainClass.WATER
    assert rows / 2 < water.sum() < 6 * (rows + cols)
    assert water.any(axis=1).mean() > 0.75
    labels, _ = ndimage.label(np.isfinite(terrain.pace_s_per_m))
    assert np.bincount(labels.ravel())[1:].max() > 0.97 * np.isfinite(terrain.pace_s_per_m).sum()
    assert terrain.elevation_m[water].mean() < terrain.elevation_m.mean()


def test_a_small_synthetic_terrain_is_built_too() -> None:
    for rows, cols in ((1, 1), (2, 3), (9, 9)):
        source = TerrainConfig(source="synthetic", rows=rows, cols=cols, relief_m=1.0)
        assert build_terrain(Scenario(terrain=source)).grid.cells == rows * cols
