"""The hidden truth: seeded, as large as asked for, and never in the way of all paths."""

from collections.abc import Callable
from functools import partial

import msgspec
import numpy as np
import pytest
from scipy import ndimage

from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.synthetic import Noise, fractal_noise, mountain_noise
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.terrain.true_ground import build_truth
from swarm.config.ground import HiddenConfig, TerrainConfig, ZoneConfig
from swarm.config.scenario import Scenario

SYNTHETIC = TerrainConfig(source="synthetic", rows=80, cols=90, relief_m=200, roads=4)


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return build_terrain(scenario(HiddenConfig()))


def scenario(hidden: HiddenConfig, seed: int = 5) -> Scenario:
    return Scenario(seed=seed, terrain=msgspec.structs.replace(SYNTHETIC, hidden=hidden))


def largest(pace: np.ndarray) -> int:
    labels, count = ndimage.label(np.isfinite(pace))
    return int(np.bincount(labels.ravel())[1:].max()) if count else 0


def test_nothing_hidden_means_that_the_map_is_true(terrain: Terrain) -> None:
    np.testing.assert_array_equal(build_truth(scenario(HiddenConfig()), terrain), terrain.ground_s_per_m)


def test_a_seed_hides_the_same_things_again(terrain: Terrain) -> None:
    hidden = HiddenConfig(closed_roads=3, rubble_fields=4, flooded_share=0.02)
    first, again = (build_truth(scenario(hidden), terrain) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert (first != build_truth(scenario(hidden, seed=6), terrain)).any()


def test_a_closed_road_is_lethal_road_cells_and_little_else(terrain: Terrain) -> None:
    truth = build_truth(scenario(HiddenConfig(closed_roads=2)), terrain)
    hidden = np.isinf(truth) & np.isfinite(terrain.pace_s_per_m)
    assert (terrain.classes[hidden] == TerrainClass.ROAD).any()
    assert 2 <= hidden.sum() <= 2 * 25
    np.testing.assert_array_equal(truth[~hidden], terrain.pace_s_per_m[~hidden])


def test_rubble_is_three_times_the_pace_and_never_lethal(terrain: Terrain) -> None:
    truth = build_truth(scenario(HiddenConfig(rubble_fields=3)), terrain)
    changed = truth != terrain.pace_s_per_m
    assert changed.sum() > 20
    np.testing.assert_allclose(truth[changed] / terrain.pace_s_per_m[changed], 3.0, rtol=1e-6)


def test_a_flooded_valley_is_one_patch_of_the_share_asked_for_and_low(terrain: Terrain) -> None:
    truth = build_truth(scenario(HiddenConfig(flooded_share=0.02)), terrain)
    wet = np.isinf(truth) & np.isfinite(terrain.pace_s_per_m)
    assert wet.sum() == int(0.02 * np.isfinite(terrain.pace_s_per_m).sum())
    assert ndimage.label(wet, np.ones((3, 3)))[1] == 1
    assert terrain.elevation_m[wet].mean() < np.quantile(terrain.elevation_m, 0.4)


@pytest.mark.parametrize("seed", range(6))
def test_however_much_is_hidden_the_terrain_stays_in_one_piece(terrain: Terrain, seed: int) -> None:
    hidden = HiddenConfig(closed_roads=40, rubble_fields=10, flooded_share=0.05)
    truth = build_truth(scenario(hidden, seed), terrain)
    assert largest(truth) >= 0.8 * largest(terrain.pace_s_per_m)
    assert largest(truth) >= 0.85 * np.isfinite(truth).sum()


def test_a_hidden_zone_is_painted_on_the_truth_only(terrain: Terrain) -> None:
    square = ZoneConfig(kind="forbidden", polygon_m=((300, 300), (600, 300), (600, 600), (300, 600)))
    truth = build_truth(scenario(HiddenConfig(zones=(square,))), terrain)
    assert np.isinf(truth[10:20, 10:20]).all()
    assert np.isfinite(terrain.pace_s_per_m[10:20, 10:20]).any()


@pytest.mark.parametrize("noise", [fractal_noise, partial(mountain_noise, ridged=True)])
def test_a_part_of_noise_is_that_part_of_the_whole(noise: Callable[..., Noise]) -> None:
    made = noise(np.random.default_rng(3), 300, 211, 70.0)
    whole = made.whole()
    for row0, row1, col0, col1 in ((0, 300, 0, 211), (17, 18, 3, 200), (128, 300, 210, 211)):
        np.testing.assert_array_equal(made.part(row0, row1, col0, col1), whole[row0:row1, col0:col1])
