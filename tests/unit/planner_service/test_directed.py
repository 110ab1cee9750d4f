"""Uphill is not downhill: the table of rises, trees on directed ground, and what vehicles drive on it."""

from __future__ import annotations

import itertools
import math
from typing import get_args

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from planner_service.target_tree import TargetTree
from shared_map.terrain.step_climb import ENTRIES, Climb, climb_of
from shared_map.terrain.store import load_prepared, save_prepared
from shared_map.terrain.synthetic.noise import mountain_noise
from shared_map.terrain.terrain import build_terrain
from swarm.config.agents import plan_agents
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.load import parse_scenario
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.config.values import Strategy
from swarm.errors import ConfigError
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, Window, walk
from swarm.right_of_way.holdings import Holdings
from swarm.right_of_way.lock_regions import Plots
from swarm.wire.messages.planning import RouteReply, TargetPose
from swarm.wire.messages.traffic import Granted
from swarm.wire.routes import Route, RouteStatus
from vehicle_agent.agent import Agent, AskRoutes
from vehicle_agent.agent_maps import LocalMap
from vehicle_agent.sensing.sensor import TruthSensor
from vehicle_agent.target_choice import AskCosts

RES = 10.0


def climb_on(elevation_m, rule="energy", res=RES, **cost) -> Climb:
    heights = np.asarray(elevation_m, np.float32)
    climb = climb_of(GridSpec(*heights.shape, res), heights, CostConfig(directional=True, slope_rule=rule, **cost))
    assert climb is not None
    return climb


def ramp(rows=3, cols=12, per_cell_m=1.0):
    """Ground that rises to the east, 10 % steep."""
    return np.tile(np.arange(cols, dtype=np.float32) * per_cell_m, (rows, 1))


def slow_costs(pace, climb, root, octile=True, corners=False, four=False):
    """An independent Dijkstra over every step written out."""
    rows, cols = pace.shape
    cells, free = np.arange(pace.size).reshape(rows, cols), np.isfinite(pace)
    tails, heads, costs = [], [], []
    for k in range(0, 8, 2 if four else 1):
        dr, dc = STEP_ROW[k], STEP_COL[k]
        here = np.s_[max(0, -dr) : rows - max(0, dr), max(0, -dc) : cols - max(0, dc)]
        there = np.s_[max(0, dr) : rows - max(0, -dr), max(0, dc) : cols - max(0, -dc)]
        ok = free[here] & free[there]
        if k & 1 and not corners:
            ok &= free[here[0], there[1]] & free[there[0], here[1]]
        tail, head = cells[here][ok], cells[there][ok]
        length = climb.grid.resolution_m * (math.sqrt(2) if k & 1 and octile else 1.0)
        tails.append(tail)
        heads.append(head)
        costs.append(pace.reshape(-1)[head].astype(np.float64) * length * climb.along(tail, head))
    backward = (np.concatenate(heads), np.concatenate(tails))
    return dijkstra(csr_array((np.concatenate(costs), backward), shape=(pace.size,) * 2), indices=root)


def rough(rng, rows, cols, spread=1.0, walls=0.2):
    pace = (0.1 * np.exp(rng.normal(0, spread, (rows, cols)))).astype(np.float32)
    pace[rng.random((rows, cols)) < walls] = np.inf
    return pace


def recomputed(route: Route, pace, climb: Climb, octile=True) -> float:
    """What a route costs, cell by cell, as a vehicle drives it."""
    cells = walk(climb.grid, route.start, route.directions)
    total = 0.0
    for direction, (tail, head) in zip(route.directions, itertools.pairwise(cells), strict=True):
        length = climb.grid.resolution_m * (math.sqrt(2) if direction & 1 and octile else 1.0)
        total += length * float(pace.reshape(-1)[head]) * climb.of_step(tail, head)
    return total


# --- the table --------------------------------------------------------------------------------------------------


def test_up_a_tenth_costs_more_than_double_and_down_it_nothing_more():
    climb = climb_on(ramp())
    assert climb.of_step(4, 5) == pytest.approx(2.24, abs=0.02)  # (1 + 0.1 / 0.08) / sqrt(1.01)
    assert climb.of_step(5, 4) == 1.0
    assert climb.of_step(5, 17) == 1.0  # along the slope
    assert climb.of_step(5, 5) == 1.0  # a vehicle that turns back within its cell


def test_a_walker_is_fastest_gently_downhill():
    climb = climb_on(ramp(per_cell_m=0.5), "tobler")
    assert climb.of_step(5, 4) == pytest.approx(math.exp(-3.5 * 0.05), rel=3e-3)
    assert climb.lowest == pytest.approx(math.exp(-3.5 * 0.05), rel=3e-3)


@pytest.mark.parametrize("rule", ["linear", "quadratic", "tobler", "energy"])
@pytest.mark.parametrize("steepest_deg", [5, 35, 90])
def test_no_step_is_steeper_than_ground_may_be_and_level_ground_costs_its_pace(rule, steepest_deg):
    climb = climb_on(ramp(per_cell_m=1e4), rule, max_slope_deg=steepest_deg)
    assert np.isfinite(climb.factors[1:-1]).all()
    assert climb.factors[ENTRIES] == 1.0
    assert climb.of_step(0, 1) == climb.factors[-1]
    assert np.isinf(climb.factors[[0, -1]]).all() == (steepest_deg < 90)


def test_a_step_beside_a_void_is_level():
    heights = ramp()
    heights[1, 5] = np.nan
    climb = climb_on(heights)
    assert climb.of_step(16, 17) == climb.of_step(17, 18) == 1.0
    np.testing.assert_array_equal(climb.along(np.array([16, 17]), np.array([17, 18])), 1.0)


def test_one_step_and_many_steps_read_the_same_table():
    rng = np.random.default_rng(4)
    climb = climb_on(mountain_noise(rng, 30, 40, 10.0).whole() * 60, "tobler")
    pairs = [(c, n) for c in range(0, 1200, 7) for _, n in climb.grid.neighbours(c)]
    tails, heads = np.array(pairs).T
    alone = np.array([climb.of_step(a, b) for a, b in pairs])
    np.testing.assert_array_equal(climb.along(tails, heads), alone.astype(np.float32))


# --- trees ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("rule", ["quadratic", "tobler", "energy"])
def test_costs_equal_an_independent_dijkstra(seed, rule):
    rng = np.random.default_rng([seed, 1])
    rows, cols = (int(n) for n in rng.integers(4, 60, 2))
    climb = climb_on(mountain_noise(rng, rows, cols, 12.0).whole() * np.float32(rng.choice([0, 20, 200])), rule)
    pace = rough(rng, rows, cols, float(rng.choice([0.1, 1.0, 3.0])), float(rng.choice([0.0, 0.3])))
    root = int(rng.choice(np.flatnonzero(np.isfinite(pace))))
    octile, corners, four = bool(seed & 1), bool(seed & 2), seed % 5 == 4
    config = PlannerConfig(
        edge="octile" if octile else "paper", corner_cutting=corners, neighbours=4 if four else 8
    )
    tree = TargetTree(climb.grid, config, climb)
    assert tree.update(pace, root, [], 0).kind == "full"
    np.testing.assert_allclose(
        tree.cost_to_go_at(np.arange(pace.size)),
        np.where(np.isfinite(pace).reshape(-1), slow_costs(pace, climb, root, octile, corners, four), np.inf),
        rtol=3e-6,
    )


@pytest.mark.parametrize("seed", range(6))
def test_routes_end_at_the_target_over_passable_cells_and_cost_what_they_say(seed):
    rng = np.random.default_rng([seed, 2])
    climb = climb_on(
        mountain_noise(rng, 40, 50, 12.0).whole() * 150, "tobler" if seed & 1 else "energy", max_slope_deg=75
    )
    pace = rough(rng, 40, 50)
    root = int(rng.choice(np.flatnonzero(np.isfinite(pace))))
    tree = TargetTree(climb.grid, PlannerConfig(), climb)
    tree.update(pace, root, [], 0)
    routes = tree.routes(np.arange(pace.size))
    ways = [route for route in routes if route.status is RouteStatus.OK]
    assert len(ways) > 100
    for route in ways:
        cells = walk(climb.grid, route.start, route.directions)
        assert cells[-1] == root
        assert np.isfinite(pace.reshape(-1)[cells]).all()
        assert route.cost_s == pytest.approx(recomputed(route, pace, climb), rel=2e-3)
        assert 0 <= route.lower_bound_s <= route.cost_s <= route.lower_bound_s * 1.001
        for direction, cell in zip(route.directions, cells, strict=False):
            if direction & 1:
                row, col = divmod(cell, 50)
                assert np.isfinite(
                    [pace[row + STEP_ROW[direction], col], pace[row, col + STEP_COL[direction]]]
                ).all()


def test_a_part_of_a_route_says_what_is_left_of_it():
    climb = climb_on(ramp(5, 30))
    pace = np.full((5, 30), 0.1, np.float32)
    tree = TargetTree(climb.grid, PlannerConfig(), climb)
    tree.update(pace, 2 * 30 + 29, [], 0)
    whole, part = tree.routes([60], 0)[0], tree.routes([60], 7)[0]
    assert len(part.directions) == 7
    assert part.cost_s == pytest.approx(whole.cost_s)
    assert part.remaining_s == pytest.approx(whole.cost_s * 22 / 29)
    assert whole.cost_s == pytest.approx(29.0 * climb.of_step(0, 1))  # 10 m x 0.1 s/m: a second a cell on the level


def test_the_way_back_down_is_another_and_cheaper():
    """A hill in the way: up it costs, down it does not."""
    climb = climb_on(ramp(21, 40))
    pace = np.full((21, 40), 0.1, np.float32)
    low, high = 10 * 40, 10 * 40 + 39
    up, down = (TargetTree(climb.grid, PlannerConfig(), climb) for _ in range(2))
    up.update(pace, high, [], 0)
    down.update(pace, low, [], 0)
    assert up.cost_to_go_at([low])[0] > 2 * down.cost_to_go_at([high])[0]


def test_a_ridge_is_crossed_where_it_is_low_only_if_the_climb_is_worth_the_detour():
    heights = np.zeros((31, 31), np.float32)
    heights[:26, 15] = 30.0  # a wall of earth with a gap in the south, passable everywhere
    climb = climb_on(heights, max_slope_deg=80)
    pace = np.full((31, 31), 0.1, np.float32)
    tree = TargetTree(climb.grid, PlannerConfig(), climb)
    tree.update(pace, 20 * 31 + 30, [], 0)
    cells = walk(climb.grid, 20 * 31, tree.routes([20 * 31])[0].directions)
    assert all(heights.reshape(-1)[cell] == 0 for cell in cells)


def test_after_marks_the_tree_is_one_grown_from_scratch_and_still_exact():
    rng = np.random.default_rng(3)
    climb = climb_on(mountain_noise(rng, 40, 40, 12.0).whole() * 100)
    pace = rough(rng, 40, 40, 0.5, 0.1)
    pace[20, 20] = 0.1
    tree = TargetTree(climb.grid, PlannerConfig(), climb)
    tree.update(pace, 820, [], 0)
    for version, value in ((1, np.inf), (2, 0.05), (3, 0.4)):
        pace[5:9, 10:30] = value
        assert tree.update(pace, 820, [Window(5, 10, 9, 30)], version).kind in ("repair", "full")
        fresh = TargetTree(climb.grid, PlannerConfig(), climb)
        fresh.update(pace, 820, [], 0)
        every = np.arange(1600)
        np.testing.assert_array_equal(tree.cost_to_go_at(every), fresh.cost_to_go_at(every))


def test_a_tree_grown_by_a_worker_is_the_same():
    rng = np.random.default_rng(5)
    climb = climb_on(mountain_noise(rng, 40, 40, 12.0).whole() * 100)
    pace = rough(rng, 40, 40, 0.5, 0.0)
    tree = TargetTree(climb.grid, PlannerConfig(), climb)
    tree.update(pace, 820, [], 0)
    before = tree.cost_to_go_at(np.arange(1600))
    tree.adopt(tree.full_job(820)(), pace, 820, [], 0, np.arange(0, 1600, 50))
    np.testing.assert_array_equal(tree.cost_to_go_at(np.arange(1600)), before)
    np.testing.assert_allclose(tree.last_gaps, 1.0, rtol=1e-5)


def test_auto_grows_windows_where_whole_trees_are_too_dear():
    climb = climb_on(ramp(60, 60))
    pace = np.full((60, 60), 0.1, np.float32)
    tree = TargetTree(climb.grid, PlannerConfig(cpu_budget=0.01, k_min=0), climb)
    tree.times.observe_full_ns(10**9)
    kinds = [tree.update(pace, 1830 + step, [], step).kind for step in range(5)]
    assert kinds == ["full", *["window"] * 4]


# --- in a run ---------------------------------------------------------------------------------------------------


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


def test_a_prepared_terrain_keeps_its_climb(tmp_path):
    terrain = build_terrain(scenario(slope_rule="tobler"))
    save_prepared(tmp_path, terrain, terrain.ground_s_per_m)
    loaded = load_prepared(tmp_path)
    assert loaded is not None
    assert loaded.climb is not None
    assert terrain.climb is not None
    np.testing.assert_array_equal(loaded.climb.factors, terrain.climb.factors)
    assert loaded.climb.of_step(100, 101) == terrain.climb.of_step(100, 101)


def test_every_strategy_goes_with_direction_and_a_price_of_length_does_not():
    for strategy in get_args(Strategy):
        parse_scenario(f'[cost]\ndirectional = true\n[planner]\nstrategy = "{strategy}"')
    with pytest.raises(ConfigError, match="leave it out"):
        parse_scenario("[cost]\ndirectional = true\n[planner]\nlength_weight = 0.1")


def driven_s(start: int, target: int, elevation_m) -> tuple[float, float]:
    """(seconds from setting out to standing on the target, what the planner said), of one vehicle on its own."""
    climb = climb_on(elevation_m)
    grid, level = climb.grid, np.full(elevation_m.shape, 0.1, np.float32)
    tree = TargetTree(grid, PlannerConfig(), climb)
    tree.update(level, target, [], 0)
    row, col = grid.row_col(start)
    text = f"[[groups]]\nvehicles = 1\ncells = [[{row}, {col}]]\n[vehicles]\ncapture_range_m = 1\n"
    scenario = parse_scenario(text)
    local_map = LocalMap(grid, level, level, level, level, climb)
    plots, plan = Plots(grid, ["a0"]), plan_agents(scenario)[0]
    holdings = Holdings(plots, plan.id, plan.vehicle_ids)
    holdings.begin(1, [])
    agent = Agent(plan, scenario, local_map, TruthSensor(grid, level, 20.0), holdings)

    def grant(seq: int, cells: list[int]) -> None:
        """As the warden of the only plot, which has nobody else to consider."""
        warden, grants = plots.warden(0, 1), {"a0-00": cells}
        granted = Granted(plot=0, host="a0", agent=warden, epoch=1, seq=seq, life=1, heard=seq, grants=grants)
        agent.place(holdings.hear_granted(granted, lambda vehicle, found: found[0], seq))

    grant(1, [start])
    agent.set_planners({"t": 1}, 0)
    x_m, y_m = grid.centre_m(target)
    agent.hear_pose(TargetPose(target="t", incarnation=1, seq=1, stamp_ns=0, cell=target, x_m=x_m, y_m=y_m), 0)
    motion = agent.vehicles["a0-00"].motion
    set_out_s = None
    for tick in range(2000):
        now_ns = tick * 50_000_000
        agent.begin_drive(now_ns)
        while agent.drive() is not None:
            pass
        if set_out_s is None and not (motion.at_rest and motion.cell == start):
            set_out_s = (tick - 1) * 0.05
        if set_out_s is not None and motion.at_rest and motion.cell == target:
            return tick * 0.05 - set_out_s, tree.routes([start])[0].cost_s
        asks = agent.decide(now_ns)
        wish = agent.wishes["a0-00"]
        grant(tick + 2, [*holdings.path("a0-00"), *(wish.ahead or wish.wants[: wish.better][:1])])
        for asked in asks:
            if isinstance(asked, AskCosts):
                agent.assignment.costs_given(asked.request, "t", tree.cost_to_go_at(asked.cells))
                agent.costs_ended(asked.request, now_ns)
            elif isinstance(asked, AskRoutes):
                routes = tree.routes(asked.cells)
                reply = RouteReply(
                    target="t",
                    incarnation=1,
                    target_cell=target,
                    map_version=0,
                    tree_age_ms=0.0,
                    rows=grid.rows,
                    cols=grid.cols,
                    routes=routes.columns(),
                )
                agent.routes_given(asked.request, reply, now_ns)
    raise AssertionError("the vehicle never arrived")


def test_vehicles_drive_up_and_down_as_long_as_the_planner_says():
    west, east = 3 * 12 + 1, 3 * 12 + 10
    up_s, promised_up_s = driven_s(west, east, ramp(7, 12))
    down_s, promised_down_s = driven_s(east, west, ramp(7, 12))
    assert (promised_up_s, promised_down_s) == (pytest.approx(20.2, abs=0.1), pytest.approx(9.0))
    assert up_s == pytest.approx(promised_up_s, abs=0.15)
    assert down_s == pytest.approx(promised_down_s, abs=0.15)
