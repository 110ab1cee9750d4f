"""The agent's decisions without any bus: whom it asks, which target it takes, where it starts."""

import dataclasses
import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.makers import route_reply
from support.shard_tables import granted_cells, holdings_of

from shared_map.terrain.terrain import terrain_of_pace
from shared_map.vehicle_class_grounds import class_grounds
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, plan_agents
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec
from swarm.right_of_way.shards import Shards
from swarm.wire.fields import column
from swarm.wire.messages.vehicles import VehicleState
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus
from vehicle_agent.agent import Agent, AskRoutes
from vehicle_agent.agent_maps import LocalMap
from vehicle_agent.driving.driven_vehicle import Places, Vehicle
from vehicle_agent.position_reports import FleetReport
from vehicle_agent.sensing.sensor import TruthSensor
from vehicle_agent.start_cells import Spawning, spawn_cells
from vehicle_agent.target_choice import AskCosts, choose, have_answered

GRID = GridSpec(12, 12, 10.0)
LEVEL = np.full((12, 12), 0.1, np.float32)
TEXT = """
seed = 5
targets = [{ name = "t", count = 2 }]
groups = [{ vehicles = 4, cells = [[5, 5], [5, 7]] }]
vehicles = { per_agent = 2 }
"""
S = 1_000_000_000


def agent_of(scenario: Scenario, index: int = 0) -> Agent:
    ground = LocalMap(GRID, LEVEL, LEVEL, LEVEL, LEVEL)
    plan = plan_agents(scenario)[index]
    holdings = holdings_of(plan.id, plan.vehicle_ids, Shards(GRID, ["a0", "a1"]))
    return Agent(plan, scenario, ground, TruthSensor(GRID, LEVEL, 20.0), holdings)


def grant(agent: Agent, seq: int, **cells: list[int]) -> None:
    """The leader of a shard grants cells to a0-00 and a0-01, named by their last digit."""
    leader = Shards(GRID, ["a0", "a1"]).leader(0, 1)
    named = {f"a0-0{name[1:]}": each for name, each in cells.items()}
    granted = granted_cells(agent.holdings, leader, seq, named)
    agent.place(agent.holdings.hear_granted(granted, seq))


@pytest.fixture
def agent() -> Agent:
    agent = agent_of(parse_scenario(TEXT))
    grant(agent, 1, v0=[GRID.cell(5, 5)], v1=[GRID.cell(5, 7)])
    agent.set_planners({"t0": 1, "t1": 1}, 0)
    return agent


def answer_costs(agent: Agent, asked: AskCosts, now_ns: int, **costs_s: list[float]) -> None:
    for target, values in costs_s.items():
        agent.assignment.costs_given(asked.request, target, np.array(values, np.float32))
    agent.costs_ended(asked.request, now_ns)


def test_one_request_per_target_and_tick_for_all_who_need_a_route(agent):
    (asked,) = agent.decide(0)
    assert isinstance(asked, AskCosts)
    answer_costs(agent, asked, 0, t0=[5.0, 6.0], t1=[math.inf, math.inf])
    (routes,) = agent.decide(S // 10)
    cells = (GRID.cell(5, 5), GRID.cell(5, 7))
    assert routes == AskRoutes(2, "t0", ("a0-00", "a0-01"), cells, force=False, reroutes=0)
    assert agent.routes_given(routes.request, route_reply(RouteBatch.of([]), GRID), S // 5) == []
    (again,) = agent.decide(S)
    ended = RouteBatch.of([Route(status=RouteStatus.OK, start=cell, cost_s=0.0) for cell in cells])
    agent.routes_given(again.request, route_reply(ended, GRID), S)
    (forced,) = agent.decide(2 * S)
    assert (again.force, forced.force, forced.reroutes) == (False, True, 2), "their routes have run out"


def test_a_vehicle_that_finds_its_place_after_the_others_is_assigned_soon() -> None:
    agent = agent_of(parse_scenario(TEXT))
    agent.set_planners({"t0": 1, "t1": 1}, 0)
    asks = []
    for tenth in range(30):
        if tenth in (0, 10):
            grant(agent, 1 + tenth, v0=[GRID.cell(5, 5)], **({"v1": [GRID.cell(5, 7)]} if tenth else {}))
        now_ns = tenth * S // 10
        for asked in agent.decide(now_ns):
            if isinstance(asked, AskCosts):
                asks.append((tenth, asked.vehicles))
                many = len(asked.vehicles)
                answer_costs(agent, asked, now_ns, t0=[5.0] * many, t1=[9.0] * many)
    assert asks[0] == (0, ("a0-00",))
    assert min(tenth for tenth, vehicles in asks if "a0-01" in vehicles) <= 20


def test_once_all_living_planners_have_answered_the_end_of_a_question_is_not_waited_for(agent: Agent) -> None:
    (asked,) = agent.decide(0)
    costs_s = np.array([5.0, 6.0], np.float32)
    assert not agent.costs_given(asked.request, "t0", costs_s)
    assert not agent.costs_given(asked.request, "t1", costs_s[:1])
    assert agent.costs_given(asked.request, "t1", costs_s)
    agent.costs_ended(asked.request, 0)
    assert not agent.costs_given(asked.request, "t1", costs_s)
    agent.set_planners({"t0": 1}, S)
    (asked, *_) = [each for each in agent.decide(10 * S) if isinstance(each, AskCosts)]
    assert agent.costs_given(asked.request, "t0", costs_s)


def test_vehicles_whose_planner_is_gone_are_lost_and_ask_the_one_that_comes_after_it(agent: Agent) -> None:
    (asked,) = agent.decide(0)
    answer_costs(agent, asked, 0, t0=[5.0, 6.0], t1=[math.inf, math.inf])
    agent.set_planners({"t1": 1}, S)
    assert {vehicle.state for vehicle in agent.vehicles.values()} == {VehicleState.LOST}
    agent.set_planners({"t0": 2, "t1": 1}, 2 * S)
    (routes,) = [each for each in agent.decide(3 * S) if isinstance(each, AskRoutes)]
    assert (routes.target, routes.vehicles) == ("t0", ("a0-00", "a0-01"))


def test_who_gets_no_costs_that_count_asks_again_soon(agent: Agent) -> None:
    """Not those of the wrong length, or of another request."""
    (asked,) = agent.decide(0)
    agent.assignment.costs_given(asked.request, "t0", np.array([1.0], np.float32))
    agent.assignment.costs_given(asked.request + 7, "t0", np.array([1.0, 1.0], np.float32))
    agent.costs_ended(asked.request, S)
    assert {vehicle.target for vehicle in agent.vehicles.values()} == {None}
    assert agent.decide(S + S // 10) == []
    assert len(agent.decide(2 * S)) == 1


def close(agent: Agent, cell: int, now_ns: int) -> None:
    """A cell is found lethal."""
    agent._map = dataclasses.replace(agent._map, pace=LEVEL.copy())
    agent._steering._pace = agent._map.pace.reshape(-1)
    agent._steering._pace[cell] = np.inf
    agent.map_changed([GRID.window], now_ns)


@pytest.mark.parametrize("beside", [GRID.cell(5, 6), GRID.cell(6, 5)])
def test_a_corner_that_is_found_lethal_is_not_cut_though_the_cell_behind_it_is_granted(beside: int) -> None:
    """It would come into a pocket that nothing leads out of."""
    agent = agent_of(parse_scenario(TEXT))
    here, behind = GRID.cell(5, 5), GRID.cell(6, 6)
    grant(agent, 1, v0=[here])
    grant(agent, 2, v0=[here, behind])
    agent.begin_drive(0)
    agent.begin_drive(S // 10)
    agent.drive()
    assert agent.vehicles["a0-00"].motion.head == behind
    close(agent, beside, S // 5)
    assert list(agent.holdings.path("a0-00")) == [here]
    agent.begin_drive(2 * S)
    while agent.drive() is not None:
        pass
    assert agent.vehicles["a0-00"].cell == here


# --- assignment ---------------------------------------------------------------------------------------------

ALIVE = {"t0": 1, "t1": 1, "t2": 1}
TARGETS = ["t0", "t1", "t2"]


@pytest.mark.parametrize(
    ("costs_s", "alive", "current", "keep_silent", "chosen"),
    [
        ({"t0": 9.0, "t1": 5.0, "t2": 6.0, "t3": 1.0}, ALIVE, None, True, "t1"),  # t3 is not allowed
        ({"t0": 10.0, "t1": 8.6}, {"t0": 1}, "t0", True, "t0"),
        ({"t0": 10.0, "t1": 8.4}, {"t0": 1}, "t0", True, "t1"),
        ({"t0": math.inf, "t1": 1e6}, ALIVE, "t0", True, "t1"),
        ({"t1": 1.0}, {"t1": 1}, "t0", True, "t0"),
        ({"t1": 1.0}, {"t1": 1}, "t0", False, "t1"),
    ],
)
def test_the_cheapest_target_is_chosen_if_it_is_worth_the_change_from_one_whose_planner_is_not_given_up(
    costs_s: dict[str, float], alive: dict[str, int], current: str | None, keep_silent: bool, chosen: str
) -> None:
    assert choose(costs_s, TARGETS, alive, current, keep_silent) == chosen


def test_no_way_is_certain_only_when_all_live_planners_have_said_so() -> None:
    walled_in = {"t0": math.inf, "t1": math.inf}
    assert choose(walled_in, TARGETS, ALIVE, None, True) is None
    assert not have_answered(walled_in, TARGETS, ALIVE)
    assert have_answered(walled_in, TARGETS, {"t0": 1, "t1": 1})
    assert not have_answered({}, TARGETS, {})


# --- where they start ---------------------------------------------------------------------------------------


def spawns_of(text: str, prior: NDArray[np.float32], truth: NDArray[np.float32]) -> dict[str, dict[str, int]]:
    scenario = parse_scenario(text)
    return spawn_cells(scenario, GRID, class_grounds(scenario, terrain_of_pace(prior), truth))


@settings(deadline=None)  # the first one imports scipy
@given(st.integers(0, 1000), st.sampled_from(["spread", "cluster"]), st.integers(0, 25))
def test_all_vehicles_start_on_different_passable_cells_of_one_part(seed: int, start: str, walls: int) -> None:
    chance = random.Random(seed)
    prior = LEVEL.copy()
    prior.reshape(-1)[chance.sample(range(144), walls)] = np.inf
    text = f'seed = {seed}\n[[groups]]\nvehicles = 30\nstart = "{start}"\n[vehicles]\nper_agent = 7\n'
    spawns = spawns_of(text, prior, prior)
    cells = [cell for vehicles in spawns.values() for cell in vehicles.values()]
    assert len(set(cells)) == 30
    assert np.isfinite(prior.reshape(-1)[cells]).all()
    assert [len(vehicles) for vehicles in spawns.values()] == [7, 7, 7, 7, 2]


def test_no_one_starts_on_an_island_or_on_what_is_lethal_in_truth() -> None:
    prior, truth = LEVEL.copy(), LEVEL.copy()
    prior[:, 3] = np.inf  # three columns of 36 cells are cut off
    truth[:, 8] = np.inf
    text = "[[groups]]\nvehicles = 40\n"
    spawns = spawns_of(text, prior, truth)
    columns = {cell % 12 for vehicles in spawns.values() for cell in vehicles.values()}
    assert columns <= {4, 5, 6, 7}


def test_explicit_places_come_first_and_are_left_free_by_all_others() -> None:
    spawns = spawns_of(TEXT, LEVEL, LEVEL)
    assert spawns["a0"] == {"a0-00": GRID.cell(5, 5), "a0-01": GRID.cell(5, 7)}
    assert not set(spawns["a1"].values()) & set(spawns["a0"].values())


# --- reports ----------------------------------------------------------------------------------------------------


def test_a_region_that_the_vehicles_have_left_is_told_so_once() -> None:
    grid = GridSpec(300, 300, 1.0)
    report = FleetReport("a0.1", "all")
    near, far = Vehicle("u", grid, grid.cell(0, 0)), Vehicle("v", grid, grid.cell(0, 299))
    told = dict(report.reports(Places(grid, [near, far]), S))
    assert [told[0].ids, told[1].ids] == [["u"], ["v"]]
    assert column(told[1].east_m, "<f4").tolist() == [299.5]
    told = dict(report.reports(Places(grid, [near]), 2 * S))
    assert [told[0].ids, told[1].ids] == [["u"], []]
    assert told[0].seq == told[1].seq == 2
    assert list(dict(report.reports(Places(grid, [near]), 3 * S))) == [0]


# --- vehicles of an added agent enter the map on free cells: no obstacle, and no zone -----------------------------


class Held:
    """Holdings of which leaders grant nothing by themselves."""

    def __init__(self) -> None:
        self.generation, self.replaced = 1, False
        self.asked: list[tuple[str, int]] = []
        self.paths: dict[str, list[int]] = {}

    def path(self, vehicle: str) -> list[int]:
        return self.paths.get(vehicle, [])

    def enter(self, vehicle: str, cell: int) -> None:
        self.asked.append((vehicle, cell))


def entering(closed: set[int], at_s: float = 2.0) -> tuple[Spawning, Held]:
    held = Held()
    made = Spawning(["v"], [1, 2, 3], held, lambda cell: cell not in closed)  # type: ignore[arg-type]
    made.tick(False, 0)
    made.tick(True, int(at_s * NS_PER_S))
    return made, held


def test_closed_cells_are_not_asked_for() -> None:
    closed = {1, 2, 3}
    made, held = entering(closed)
    assert held.asked == []
    closed.remove(2)
    made.tick(True, 3 * NS_PER_S)
    assert held.asked == [("v", 2)]


def test_a_cell_that_is_closed_while_it_is_asked_for_is_not_taken_and_another_is_asked_for_at_once() -> None:
    closed: set[int] = set()
    made, held = entering(closed)
    closed.add(1)
    assert not made.may_stand("v", 1)
    made.tick(True, 2 * NS_PER_S + 1)
    assert held.asked == [("v", 1), ("v", 2)]
    assert made.may_stand("v", 2)


def test_who_is_found_where_an_earlier_generation_left_it_stands_there_whatever_closes_the_cell() -> None:
    made, _ = entering({7}, at_s=0.0)
    assert made.may_stand("v", 7)
