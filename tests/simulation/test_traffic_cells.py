"""Cells of right of way that are smaller than those of the terrain: no two vehicles are in one, all arrive, and a
road carries more vehicles."""

import numpy as np
import pytest
from msgspec.structs import replace
from support.simulated import vehicles

from launch_scripts.simulation.faults import FaultPlan, random_plan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import crowd, of_file, seeded
from launch_scripts.simulation.simulate import Simulation
from shared_map.terrain.terrain import Terrain, build_terrain, terrain_of_pace
from swarm.config.scenario import Scenario, traffic_grid
from swarm.errors import ConfigError

SECONDS = 20.0


def in_parts(scenario: Scenario, terrain: Terrain, parts: int) -> Scenario:
    """The scenario with `parts` cells of right of way across a cell of its terrain."""
    side_m = terrain.grid.resolution_m / parts
    return replace(scenario, map=replace(scenario.map, traffic_cell_m=side_m))


@pytest.mark.parametrize("routes", ["grid", "pulled"])
@pytest.mark.parametrize("parts", [3, pytest.param(5, marks=pytest.mark.thorough)])
def test_no_law_breaks_in_a_crowd_with_every_fault_and_small_cells(parts, routes):
    scenario, terrain = crowd("maze", 1, vehicles=40, per_agent=5, side=19)
    scenario = replace(scenario, planner=replace(scenario.planner, routes=routes))
    simulation = Simulation(
        in_parts(scenario, terrain, parts), faults=random_plan(scenario, 1, SECONDS), terrain=terrain
    )
    assert LawBook(simulation).run(SECONDS) == []
    assert simulation.report(SECONDS)["captures"] > 5


@pytest.mark.seeds(1)
def test_no_law_breaks_on_ground_with_hidden_obstacles_and_small_cells(seed):
    scenario = seeded(seed)
    terrain = build_terrain(scenario)
    simulation = Simulation(in_parts(scenario, terrain, 3), faults=random_plan(scenario, seed, SECONDS))
    assert LawBook(simulation).run(SECONDS) == []
    assert simulation.report(SECONDS)["marks"] > 0


ROAD = 12
"""Columns of the road, between two halls."""


def through_the_road(parts: int, seconds: float) -> int:
    """Returns how many of 30 vehicles have driven through a road of one lane to the target behind it."""
    side = 10
    pace = np.full((side, 2 * side + ROAD), 0.1, np.float32)
    pace[:, side : side + ROAD] = np.inf
    pace[side // 2, side : side + ROAD] = 0.1
    terrain = terrain_of_pace(pace, 10.0)
    cells = [(row, col) for col in range(side - 5, side) for row in range(2, 8)]
    settings = {
        "terrain.rows": side, "terrain.cols": 2 * side + ROAD, "groups.0.vehicles": len(cells),
        "vehicles.per_agent": 10, "groups.0.cells": cells, "time_scale": 1.0,
        "targets": [{"name": "t", "walk": "still", "caught": "stay", "start": [side // 2, 2 * side + ROAD - 2]}],
    }  # fmt: skip
    scenario = of_file("crowd", settings)
    simulation = Simulation(in_parts(scenario, terrain, parts), faults=FaultPlan(), terrain=terrain)
    laws = LawBook(simulation)
    simulation.run_until(seconds)
    assert laws.collisions == laws.lethal == []
    there = [each.terrain_cell % terrain.grid.cols >= side + ROAD for each in vehicles(simulation).values()]
    assert len(there) == len(cells)
    return sum(there)


def test_a_road_of_one_lane_carries_more_vehicles_with_small_cells():
    few, many = through_the_road(1, 30.0), through_the_road(3, 30.0)
    assert many > 1.3 * few > 0


def test_a_side_that_does_not_divide_the_cell_is_refused():
    scenario, terrain = crowd("open", 1, vehicles=1, per_agent=1, side=5)
    for side_m in (4.0, 5.0, 20.0, 1e-4):
        wrong = replace(scenario, map=replace(scenario.map, traffic_cell_m=side_m))
        with pytest.raises(ConfigError, match=f"^map.traffic_cell_m is {side_m:g}"):
            traffic_grid(wrong, terrain.grid)
    assert traffic_grid(in_parts(scenario, terrain, 3), terrain.grid).shape == (15, 15)
