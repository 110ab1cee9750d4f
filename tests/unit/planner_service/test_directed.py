"""Uphill is not downhill: the table of rises, trees on directed ground, and what vehicles drive on it."""

import math
from typing import get_args

import numpy as np
import pytest
from support.makers import route_reply
from support.shard_tables import grants_of

from planner_service.target_tree import TargetTree
from shared_map.terrain.step_climb import ENTRIES, Climb, climb_of
from shared_map.terrain.store import load_prepared, save_prepared
from shared_map.terrain.synthetic.noise import mountain_noise
from shared_map.terrain.terrain import build_terrain
from swarm.config.agents import plan_agents
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.load import parse_scenario
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.config.setting_types import Strategy
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.right_of_way.holdings import Holdings
from swarm.right_of_way.lock_regions import Shards
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.traffic import Granted
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
    shards, plan = Shards(grid, ["a0"]), plan_agents(scenario)[0]
    holdings = Holdings(shards, plan.id, plan.vehicle_ids)
    holdings.begin(1, [])
    agent = Agent(plan, scenario, local_map, TruthSensor(grid, level, 20.0), holdings)

    def grant(seq: int, cells: list[int]) -> None:
        """Acts as the leader of the only shard, which has no other host to consider."""
        leader, grants = shards.leader(0, 1), grants_of(holdings, seq, {"a0-00": cells})
        granted = Granted(
            shard=0, host="a0", agent=leader, epoch=1, seq=seq, generation=1, heard=seq, grants=grants
        )
        agent.place(holdings.hear_granted(granted, seq))

    grant(1, [start])
    agent.set_planners({"t": 1}, 0)
    x_m, y_m = grid.centre_m(target)
    agent.take_pose(TargetPose(target="t", incarnation=1, seq=1, stamp_ns=0, cell=target, x_m=x_m, y_m=y_m), 0)
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
                reply = route_reply(tree.routes(asked.cells), grid, target="t", target_cell=target)
                agent.routes_given(asked.request, reply, now_ns)
    raise AssertionError("the vehicle never arrived")


def test_vehicles_drive_up_and_down_as_long_as_the_planner_says():
    west, east = 3 * 12 + 1, 3 * 12 + 10
    up_s, promised_up_s = driven_s(west, east, ramp(7, 12))
    down_s, promised_down_s = driven_s(east, west, ramp(7, 12))
    assert (promised_up_s, promised_down_s) == (pytest.approx(20.2, abs=0.1), pytest.approx(9.0))
    assert up_s == pytest.approx(promised_up_s, abs=0.15)
    assert down_s == pytest.approx(promised_down_s, abs=0.15)
