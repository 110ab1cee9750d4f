"""Grounds of classes of vehicles: prepared in a run's folder, mapped by every process."""

import heapq
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.effort import few

from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map import vehicle_class_grounds as module
from shared_map.array_files import Floats
from shared_map.terrain.store import load_beside, prepare, scenario_key
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import (
    air_ground,
    class_grounds,
    class_terrains,
    class_truths,
    clearance_floor,
    lifted_floor,
    load_classes,
    prepare_classes,
)
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.config.scenario_files import parse_scenario
from swarm.config.vehicle_classes import AirConfig
from swarm.errors import TerrainError
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
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


def prepared(folder: Path, scenario: Scenario) -> tuple[Terrain, Floats, RoleSetup]:
    """A run's folder with its terrain, truth and grounds of classes; and a process of that run."""
    terrain, truth = prepare(folder, scenario)
    prepare_classes(folder, scenario, terrain, truth)
    return terrain, truth, RoleSetup(scenario, "run", "agent", "a0", 1, 1, run_dir=folder)


@pytest.mark.parametrize("directional", ["false", "true"])
def test_what_is_prepared_is_what_would_be_made(tmp_path, directional, monkeypatch):
    scenario = parse_scenario(_TEXT.format(speed=1.5, directional=directional))
    made = class_grounds(scenario, *prepare(tmp_path, scenario))
    _, _, setup = prepared(tmp_path, scenario)
    again, truth_again = prepare(tmp_path, scenario)
    monkeypatch.setattr(module, "build_terrain", None)  # nothing is built twice
    load_classes(setup, again)
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
        assert ground.terrain.vehicle_radius_m == made[name].terrain.vehicle_radius_m
        assert (ground.terrain.climb is None) == (directional == "false")
    assert class_terrains(scenario, again)["walker"] is found["walker"].terrain
    assert class_truths(scenario, again, truth_again)["walker"] is found["walker"].truth


def test_a_folder_of_another_class_is_none(tmp_path: Path) -> None:
    slow, quick = (parse_scenario(_TEXT.format(speed=speed, directional="false")) for speed in (0.5, 1.5))
    terrain, truth, _ = prepared(tmp_path, slow)
    load_classes(RoleSetup(quick, "run", "agent", "a0", 1, 1, run_dir=tmp_path), terrain)
    walker = class_grounds(quick, terrain, truth)["walker"]
    assert 1 / 1.5 <= float(walker.truth.min()) < 1.0


def test_a_launcher_makes_a_damaged_folder_again_and_another_process_says_it_in_one_sentence(tmp_path):
    scenario = parse_scenario(_TEXT.format(speed=1.5, directional="false"))
    terrain, truth, setup = prepared(tmp_path, scenario)
    pace, description = (tmp_path / "classes/walker" / name for name in ("pace.npy", "class.json"))
    whole = pace.read_bytes()
    pace.unlink()  # it may be linked to the kept one
    pace.write_bytes(whole[:-2] + bytes([whole[-2] ^ 1]) + whole[-1:])
    description.write_text("{")
    with pytest.raises(TerrainError, match=r"prepared class .* is damaged .*; delete the folder"):
        load_classes(setup, terrain)
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
    terrain, _, setup = prepared(tmp_path, west)
    made = class_terrains(west, terrain)["drone"]
    again, _ = prepare(tmp_path, west)
    load_classes(setup, again)
    found = class_terrains(west, again)["drone"]
    assert found is not made
    assert found.climb.wind == made.climb.wind
    assert found.climb.windy
    assert np.array_equal(found.climb.table, made.climb.table)
    assert (found.digest, found.notes) == (made.digest, made.notes)
    other = class_terrains(south, again)["drone"]
    assert other.digest != found.digest
    assert other.climb.wind != found.climb.wind


# --- the surface on which air classes fly ---------------------------------------------------------------------


STEPS = tuple(zip(STEP_ROW, STEP_COL, strict=True))


@st.composite
def ground(draw: st.DrawFn) -> NDArray[np.float32]:
    """Hills, cliffs, needles and voids."""
    rows, cols = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    heights = rng.normal(800, draw(st.sampled_from([1.0, 40.0, 700.0])), (rows, cols))
    if draw(st.booleans()):
        heights[rng.random((rows, cols)) < 0.1] += 2000
    if draw(st.booleans()):
        heights[rng.random((rows, cols)) < 0.05] = np.nan
    return heights.astype(np.float32)


def slow_lift(floor: NDArray[np.float64], grade: float, resolution_m: float) -> NDArray[np.float64]:
    """The highest first, each over its neighbours: Dijkstra's algorithm, whose fronts fall instead of rise."""
    lifted = np.where(np.isnan(floor), -np.inf, floor)
    queue = [(-height, cell) for cell, height in np.ndenumerate(lifted)]
    heapq.heapify(queue)
    while queue:
        height, (row, col) = heapq.heappop(queue)
        if -height < lifted[row, col]:
            continue
        for south, east in STEPS:
            r, c = row + south, col + east
            if 0 <= r < len(lifted) and 0 <= c < len(lifted[0]):
                fallen = -height - grade * resolution_m * math.hypot(south, east)
                if fallen > lifted[r, c]:
                    lifted[r, c] = fallen
                    heapq.heappush(queue, (-fallen, (r, c)))
    lifted[np.isnan(floor)] = np.nan
    return lifted


@given(ground(), st.sampled_from([0.02, 0.15, 1.0]), st.sampled_from([1.0, 30.0]))
def test_a_lifted_floor_is_that_of_its_slow_twin_and_no_step_is_steeper(heights, grade, resolution_m):
    floor = clearance_floor(heights, 60.0)
    lifted = lifted_floor(floor, grade, resolution_m)
    np.testing.assert_allclose(lifted, slow_lift(floor, grade, resolution_m), rtol=2e-7)
    known = ~np.isnan(lifted)
    assert (lifted[known] >= floor[known]).all()
    for south, east in STEPS:
        length_m = resolution_m * math.hypot(south, east)
        for (row, col), height in np.ndenumerate(lifted):
            r, c = row + south, col + east
            if 0 <= r < len(lifted) and 0 <= c < len(lifted[0]) and known[row, col] and known[r, c]:
                assert abs(float(lifted[r, c]) - float(height)) <= grade * length_m + 1e-3


@given(ground(), st.integers(0, 2**32), st.sampled_from([5.0, 60.0]))
@settings(max_examples=few(60))
def test_along_every_route_of_an_air_class_the_clearance_is_kept_between_centres_too(heights, seed, clearance_m):
    grid = GridSpec(*heights.shape, 30.0)
    closed = np.random.default_rng(seed).random(heights.shape) < 0.1
    flown = air_ground(grid, heights, AirConfig(clearance_m=clearance_m), closed=closed)
    free = np.flatnonzero(np.isfinite(flown.pace_s_per_m))
    assert not closed.reshape(-1)[free].any()
    assert not np.isnan(heights.reshape(-1)[free]).any()
    if not len(free):
        return
    costs = CostGrid(grid, PlannerConfig(), flown.climb)
    costs.load(flown.pace_s_per_m)
    tree = CostToGoTree(costs)
    tree.grow(int(free[seed % len(free)]))
    reached = free[np.isfinite(tree.cost_at(costs.pad_all(free)))]
    filled = np.where(np.isnan(heights), -np.inf, heights).astype(np.float64)
    walks = costs.walk(tree.parent, grid_root := costs.pad(tree.root), costs.pad_all(reached), 0, costs.time_cost)
    assert grid_root >= 0
    assert (walks.ends >= 0).all()
    for cell in reached.tolist():
        way = _way(costs, tree, cell)
        for tail, head in itertools.pairwise(way):
            (r0, c0), (r1, c1) = divmod(tail, grid.cols), divmod(head, grid.cols)
            under = filled[min(r0, r1) : max(r0, r1) + 1, min(c0, c1) : max(c0, c1) + 1].max()
            heights_m = flown.height_m[r0, c0], flown.height_m[r1, c1]
            assert min(heights_m) >= under + clearance_m


def _way(costs: CostGrid, tree: CostToGoTree, cell: int) -> list[int]:
    """Cells of the route from a cell, by its parents one by one."""
    way = [cell]
    while way[-1] != tree.root:
        code = int(tree.parent[costs.pad(way[-1])])
        way.append(way[-1] + STEP_ROW[code] * costs.grid.cols + STEP_COL[code])
        assert len(way) <= costs.grid.cells
    return way


def test_flat_ground_is_flown_over_at_the_clearance_and_level() -> None:
    flown = air_ground(GridSpec(4, 5, 10.0), np.full((4, 5), 100, np.float32), AirConfig(speed_m_per_s=20.0))
    assert (flown.height_m == 160).all()
    assert (flown.pace_s_per_m == np.float32(0.05)).all()
    assert flown.climb.of_step(0, 1) == 1.0


@pytest.mark.parametrize(("rise", "factor"), [(0.1, 1 + 15 * 0.1 / 3), (-0.1, 1 + 15 * 0.1 / 10)])
def test_a_climb_costs_what_the_class_says(rise: float, factor: float) -> None:
    grid = GridSpec(1, 40, 100.0)
    heights = (100 + 100 * rise * np.arange(40, dtype=np.float32))[None]
    flown = air_ground(grid, heights, AirConfig(grade=0.2))
    assert flown.climb.of_step(20, 21) == pytest.approx(factor, rel=1e-3)
