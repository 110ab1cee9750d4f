"""Uphill is not downhill: the table of rises, and terrains of directed ground."""

from typing import get_args

import numpy as np
import pytest

from shared_map.terrain.slope_and_climb import Climb, climb_of
from shared_map.terrain.synthetic import mountain_noise
from shared_map.terrain.terrain import build_terrain
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.scenario import Scenario, Strategy
from swarm.config.scenario_files import parse_scenario
from swarm.errors import ConfigError
from swarm.grid import GridSpec

RES = 10.0


def climb_on(elevation_m, rule="energy", res=RES, **cost) -> Climb:
    heights = np.asarray(elevation_m, np.float32)
    climb = climb_of(GridSpec(*heights.shape, res), heights, CostConfig(directional=True, slope_rule=rule, **cost))
    assert climb is not None
    return climb


def ramp(rows=3, cols=12, per_cell_m=1.0):
    """Ground that rises to the east, 10 % steep."""
    return np.tile(np.arange(cols, dtype=np.float32) * per_cell_m, (rows, 1))


# --- the table --------------------------------------------------------------------------------------------------


def test_a_step_beside_a_void_is_level():
    heights = ramp()
    heights[1, 5] = np.nan
    climb = climb_on(heights)
    assert climb.of_step(16, 17) == climb.of_step(17, 18) == 1.0
    np.testing.assert_array_equal(climb.along(np.array([16, 17]), np.array([17, 18])), 1.0)


# --- in a run ---------------------------------------------------------------------------------------------------


def test_one_step_and_many_steps_read_the_same_table():
    rng = np.random.default_rng(4)
    climb = climb_on(mountain_noise(rng, 30, 40, 10.0).whole() * 60, "tobler")
    pairs = [(c, n) for c in range(0, 1200, 7) for _, n in climb.grid.neighbours(c)]
    tails, heads = np.array(pairs).T
    alone = np.array([climb.of_step(a, b) for a, b in pairs])
    np.testing.assert_array_equal(climb.along(tails, heads), alone.astype(np.float32))


def scenario(**cost) -> Scenario:
    return Scenario(
        terrain=TerrainConfig(source="synthetic", rows=48, cols=64), cost=CostConfig(directional=True, **cost)
    )


def test_the_paces_of_a_directional_terrain_are_those_of_level_ground(tmp_path):
    both_ways, one_way = build_terrain(scenario(classes=False)), build_terrain(scenario(classes=False))
    paces = one_way.pace_s_per_m[~one_way.lethal]
    np.testing.assert_allclose(paces, 0.1)
    assert one_way.digest == both_ways.digest
    assert any("level ground" in note for note in one_way.notes)
    assert build_terrain(scenario(classes=False, slope_rule="tobler")).digest != one_way.digest


def test_every_strategy_goes_with_direction_and_a_price_of_length_does_not():
    for strategy in get_args(Strategy):
        parse_scenario(f'[cost]\ndirectional = true\n[planner]\nstrategy = "{strategy}"')
    with pytest.raises(ConfigError, match="leave it out"):
        parse_scenario("[cost]\ndirectional = true\n[planner]\nlength_weight = 0.1")
