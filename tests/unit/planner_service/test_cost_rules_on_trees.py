"""Trees, routes and certificates under every cost rule, where some steps are too steep, beside scipy's Dijkstra."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from support import slow_twins

from planner_service.strategy import STAGES
from planner_service.target_tree import TargetTree
from shared_map.terrain.layers import terrain_pace
from shared_map.terrain.slope_rules import SLOPE_RULES
from shared_map.terrain.step_climb import Climb, climb_of
from swarm.config.ground import CostConfig
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window, walk
from swarm.wire.route_columns import RouteStatus

GRID = GridSpec(18, 22, 10.0)


def landscape(rng: np.random.Generator) -> np.ndarray:
    """Hills, and steps of chance between cells, some of them steeper than vehicles may drive."""
    row, col = np.mgrid[: GRID.rows, : GRID.cols]
    hills = 12 * np.sin(row / rng.uniform(3, 8)) * np.cos(col / rng.uniform(3, 8))
    return (hills + rng.normal(0, 1.0, hills.shape)).astype(np.float32)


def climbs(rule: str, elevation_m: np.ndarray) -> Climb:
    points = ((-30.0, 3.0), (-4.0, 0.8), (0.0, 1.0), (20.0, 4.0))
    table = {"slope_table": points} if rule == "table" else {}
    limits = {"max_slope_deg": 40.0, "max_climb_deg": 18.0, "max_descent_deg": 25.0}
    cost = CostConfig(slope_rule=rule, directional=True, cross_slope_factor=1.5, **limits, **table)
    climb = climb_of(GRID, elevation_m, cost)
    assert climb is not None
    return climb


@pytest.mark.parametrize("rule", SLOPE_RULES)
def test_trees_and_certificates_hold_under_every_rule(rule: str) -> None:
    rng = np.random.default_rng(sorted(SLOPE_RULES).index(rule))
    climb = climbs(rule, landscape(rng))
    assert np.isinf(climb.along(np.arange(GRID.cells - 1), np.arange(1, GRID.cells))).any()
    pace = np.exp(rng.normal(-2, 0.7, (GRID.rows, GRID.cols))).astype(np.float32)
    pace[rng.random(pace.shape) < 0.08] = np.inf
    free = np.flatnonzero(np.isfinite(pace))
    tree = TargetTree(GRID, PlannerConfig(), climb)
    served = 0
    for version, root in enumerate(int(each) for each in rng.choice(free, 2, replace=False)):
        dirty = []
        if version:  # marks: more expensive, cheaper, and the target has moved
            row, col = GRID.row_col(int(rng.choice(free)))
            part = pace[row : row + 4, col : col + 4]
            part[np.isfinite(part)] *= np.float32(rng.choice([0.3, 4.0]))
            dirty = [Window(row, col, row + 4, col + 4)]
        tree.update(pace, root, dirty, version)
        best = slow_twins.cost_to_go(pace, root, climb=climb).reshape(-1) * GRID.resolution_m
        for route in tree.routes(np.arange(GRID.cells)):
            assert (route.status is RouteStatus.OK) == bool(
                np.isfinite(best[route.start]) and np.isfinite(pace.reshape(-1)[route.start])
            )
            if route.status is not RouteStatus.OK:
                continue
            cells = walk(GRID, route.start, route.directions)
            assert all(climb.allows(tail, head) for tail, head in pairwise(cells))
            assert route.cost_s == pytest.approx(best[route.start], rel=1e-4, abs=1e-6)
            assert route.lower_bound_s <= best[route.start] * (1 + 1e-9)
            assert route.lower_bound_s >= 0.99 * best[route.start]  # the tree is exact
            served += 1
    assert served > 100


@pytest.mark.parametrize("rule", SLOPE_RULES)
@pytest.mark.parametrize("directional", [False, True])
def test_certificates_hold_while_the_tree_follows_a_target_by_windows(rule: str, directional: bool) -> None:
    rng = np.random.default_rng(40 + sorted(SLOPE_RULES).index(rule))
    climb = climbs(rule, landscape(rng)) if directional else None
    grades = np.abs(rng.normal(0, 0.3, (GRID.rows, GRID.cols))).astype(np.float32)
    table = {"slope_table": ((-30.0, 0.6), (0.0, 1.0), (20.0, 4.0))} if rule == "table" else {}
    pace = terrain_pace(grades, np.zeros(grades.shape, np.uint8), CostConfig(slope_rule=rule, **table))
    tree = TargetTree(GRID, PlannerConfig(k_min=0), climb, chosen_by=STAGES["rotate"])
    root = int(np.flatnonzero(np.isfinite(pace))[30])
    served = 0
    for version in range(4):
        tree.update(pace, root, [], version)
        best = slow_twins.cost_to_go(pace, root, climb=climb).reshape(-1) * GRID.resolution_m
        for route in tree.routes(np.arange(0, GRID.cells, 3)):
            if route.status is RouteStatus.OK:
                assert route.lower_bound_s <= best[route.start] * (1 + 1e-6)
                assert route.cost_s >= best[route.start] * (1 - 1e-4)
                served += 1
        near = [cell for _, cell in GRID.neighbours(root) if np.isfinite(pace.reshape(-1)[cell])]
        root = near[version % len(near)]
    assert served > 50
