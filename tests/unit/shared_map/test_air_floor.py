"""The surface on which air classes fly: its law, beside a slow twin."""

import heapq
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.effort import few

from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from shared_map.vehicle_class_grounds import air_ground, clearance_floor, lifted_floor
from swarm.config.scenario import PlannerConfig
from swarm.config.vehicle_classes import AirConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

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
