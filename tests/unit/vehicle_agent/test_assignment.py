"""The target of each vehicle of an agent: even shares, or pursuers of a group first; when it asks."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from swarm.clock import NS_PER_S
from swarm.config.plugin_names import PLUGIN_KINDS, NamedPlugin
from swarm.errors import ProtocolError
from swarm.grid import GridSpec
from swarm.plugins import Plugin
from swarm.wire.codec import decode, encode
from swarm.wire.fields import pack_column
from swarm.wire.messages.vehicles import MOST_SHARED_TARGETS, NO_TARGET, SharedCosts
from vehicle_agent.assignment import (
    ASSIGNERS,
    HYSTERESIS,
    Assigner,
    AssignmentWorld,
    Balanced,
    Cheapest,
    CostTable,
    Spread,
    assigner_of,
    need_first,
    shares_costs,
    spread,
)
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.target_choice import Assignment, GroupCosts

Costs = NDArray[np.float64]
Problem = tuple[Costs, list[int]]
PERIOD_S = 5.0
PERIOD_NS = int(PERIOD_S * NS_PER_S)


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    """Costs of some targets, of which not all may be in reach, and what each vehicle chases now."""
    targets, vehicles = draw(st.integers(1, 5)), draw(st.integers(1, 12))
    finite = st.integers(1, 40).map(float) | st.sampled_from([1.0, 2.0, 50.0, 51.0])
    cost = finite | st.just(math.inf) if draw(st.booleans()) else finite
    row = st.lists(cost, min_size=vehicles, max_size=vehicles)
    costs_s = np.array(draw(st.lists(row, min_size=targets, max_size=targets)))
    return costs_s, draw(st.lists(st.integers(-1, targets - 1), min_size=vehicles, max_size=vehicles))


def discounted(costs_s: Costs, current: list[int]) -> Costs:
    cheaper = costs_s.copy()
    for vehicle, target in enumerate(current):
        if target >= 0:
            cheaper[target, vehicle] *= 1.0 - HYSTERESIS
    return cheaper


def vehicles_of(agent: str, count: int) -> dict[str, Vehicle]:
    grid = GridSpec(10, 10, 10.0)
    return {f"{agent}-{n:02d}": Vehicle(f"{agent}-{n:02d}", grid, n) for n in range(count)}


def plugged(made: object, told: list[str]) -> Assigner:
    """The assigner of a plug-in which is this; its faults are told."""
    named = NamedPlugin(PLUGIN_KINDS["assignment"], "vehicles.assignment", "my:Own", {})
    plugin = Plugin(named, lambda world, options: made, {})
    return assigner_of(plugin, AssignmentWorld("a0", "all", (), 1), told.append)


# --- even shares ---


@given(problems())
def test_no_target_gets_more_than_its_even_share_and_no_one_a_target_out_of_reach(world):
    costs_s, current = world
    targets, vehicles = costs_s.shape
    chosen = spread(costs_s, current)
    share = math.ceil(vehicles / targets)
    sizes = np.bincount(chosen[chosen >= 0], minlength=targets)
    assert sizes.max() <= share
    for vehicle, target in enumerate(chosen.tolist()):
        reachable = np.flatnonzero(np.isfinite(costs_s[:, vehicle]))
        if target >= 0:
            assert target in reachable
        else:
            assert all(sizes[each] == share for each in reachable)


@given(problems())
def test_no_vehicle_and_target_that_would_both_gain_are_kept_apart(world):
    """Stability: where another target is cheaper for a vehicle, those that go for it reach it at no higher cost."""
    costs_s, chosen = discounted(*world), spread(*world)
    share = math.ceil(costs_s.shape[1] / costs_s.shape[0])
    for vehicle, target in enumerate(chosen.tolist()):
        own_s = math.inf if target < 0 else costs_s[target, vehicle]
        for other in np.flatnonzero(costs_s[:, vehicle] < own_s).tolist():
            those = np.flatnonzero(chosen == other)
            assert len(those) == share
            assert costs_s[other, those].max() <= costs_s[other, vehicle]


@given(problems(), st.sampled_from(sorted(ASSIGNERS)))
def test_no_share_that_others_fill_keeps_a_vehicle_from_the_targets_it_can_reach_and_targets_soon_stay(world, name):
    """Restrictions are random: of a target that a vehicle may not chase its agent knows no cost."""
    costs_s, current = world
    targets = [f"t{n}" for n in range(len(costs_s))]
    vehicles = vehicles_of("a0", len(current))
    assignment = Assignment(vehicles, targets, ASSIGNERS[name](AssignmentWorld("a0", "all", (), 1)), 5.0, 1.0)
    seen = []
    for now_ns in range(len(vehicles) + 2):
        assignment.ask(now_ns, now_ns)
        for target, row in zip(targets, costs_s.astype(np.float32), strict=True):
            assignment.costs_given(now_ns, target, row)
        assignment.costs_ended(now_ns, dict.fromkeys(targets, 1), now_ns)
        seen.append([vehicle.target for vehicle in vehicles.values()])
        for chased, to_each_s in zip(seen[-1], costs_s.T, strict=True):
            assert not np.isfinite(to_each_s).any() or np.isfinite(to_each_s[targets.index(str(chased))])
    assert seen[-1] == seen[-2]


def test_those_that_have_a_target_keep_it_and_count_for_its_share() -> None:
    costs_s = np.array([[1.0] * 4, [100.0] * 4])
    assert spread(costs_s, [-1] * 4, np.array([-1, 0, 0, -1])).tolist() == [1, 0, 0, 1]
    assert spread(costs_s, [-1] * 4, np.array([0, 0, 0, -1])).tolist() == [0, 0, 0, 1]


def test_vehicles_keep_their_targets_unless_another_is_cheaper_by_15_percent() -> None:
    assert spread(np.array([[10.0, 10.0], [9.0, 8.0]]), [0, 0]).tolist() == [0, 1]
    assert spread(np.array([[10.0, 8.6], [8.6, 10.0]]), [0, 1]).tolist() == [0, 1]
    assert spread(np.array([[10.0, 8.4], [8.4, 10.0]]), [0, 1]).tolist() == [1, 0]


# --- plug-ins ---------------------------------------------------------------------------------------------------

answers = st.one_of(
    st.lists(st.integers(-3, 6), max_size=13),
    st.lists(st.floats(), max_size=3),
    st.none(),
    st.text(max_size=3),
    st.lists(st.lists(st.integers(0, 1), max_size=2), max_size=2),
)


@given(problems(), answers)
def test_whatever_a_plugin_assigns_vehicles_go_only_where_they_have_a_route(world, answer):
    costs_s, current = world
    given_s = costs_s.copy()
    told: list[str] = []

    class Says:
        def assign(self, table: CostTable) -> object:
            table.costs_s[:] = -1.0  # its changes to its own table harm no other
            return answer

    assigner = plugged(Says(), told)
    names = tuple(f"v{n}" for n in range(costs_s.shape[1]))
    table = CostTable(tuple(f"t{n}" for n in range(costs_s.shape[0])), names, costs_s, tuple(current))
    chosen = assigner.assign(table)
    assert np.array_equal(costs_s, given_s)
    assert chosen.shape == (len(names),)
    for vehicle, target in enumerate(chosen.tolist()):
        assert target == -1 or np.isfinite(costs_s[target, vehicle])
    if told:
        assert chosen.tolist() == spread(costs_s, current).tolist()
        assert "assignment plug-in 'my:Own' of vehicles.assignment: assign r" in told[0]
        assert told[0].endswith("this agent spreads its vehicles evenly now")
    else:
        assert chosen.tolist() == answer


# --- pursuers first ---


def shares_of(costs_s: Costs, pursuers: int) -> int:
    """Pursuers of each target that can be reached, by the vehicles that can reach any."""
    reached = np.isfinite(costs_s)
    targets, vehicles = int(reached.any(1).sum()), int(reached.any(0).sum())
    return min(pursuers, max(1, vehicles // targets)) if targets else 0


def best_of_all(costs_s: Costs, each: int) -> tuple[list[int], float]:
    """By SciPy: how many targets get a first, second ... pursuer, and the least total cost. A place that stays
    empty costs more than all else together, an earlier one more than all later ones."""
    targets, vehicles = costs_s.shape
    places = targets * each
    much = costs_s[np.isfinite(costs_s)].sum() + 1.0
    table = np.full((places, vehicles + places), np.inf)
    for place in range(places):
        table[place, :vehicles] = costs_s[place % targets]
        table[place, vehicles + place] = much * (places + 1.0) ** (each - 1 - place // targets)
    rows, columns = linear_sum_assignment(table)
    kept = columns < vehicles
    counts = [int((kept & (rows // targets == n)).sum()) for n in range(each)]
    return counts, float(table[rows[kept], columns[kept]].sum())


@given(problems(), st.integers(1, 3))
def test_as_many_targets_as_can_be_get_each_of_their_pursuers_at_the_least_total_cost(problem, pursuers):
    costs_s, current = problem
    chosen, paid = need_first(costs_s, current, pursuers), discounted(costs_s, current)
    at = np.flatnonzero(chosen >= 0)
    assert np.isfinite(paid[chosen[at], at]).all()
    each = shares_of(costs_s, pursuers)
    if not each:
        assert not at.size
        return
    counts, least_s = best_of_all(paid, each)
    sizes = np.bincount(chosen[at], minlength=len(costs_s))
    assert [int((sizes > n).sum()) for n in range(each)] == counts
    assert sizes.max() <= each
    assert paid[chosen[at], at].sum() == pytest.approx(least_s, abs=1e-3 * len(at))


def test_a_vehicle_changes_for_more_than_15_percent() -> None:
    assert need_first(np.array([[100.0, 84.0]]), [0, -1], 1).tolist() == [-1, 0]
    assert need_first(np.array([[100.0, 86.0]]), [0, -1], 1).tolist() == [0, -1]


def test_costs_beyond_all_bounds_leave_the_differences_of_the_others() -> None:
    """A vehicle that claims to need 1e38 s changes nothing for the rest."""
    costs_s = np.array([[3e38, 10.0, 20.0], [3e38, 11.0, 18.0]])
    assert need_first(costs_s, [-1, -1, -1], 1).tolist() == [-1, 0, 1]


# --- agents of a group ---


def table_of(costs_s: Costs, current: list[int], rows: list[int], columns: list[int]) -> CostTable:
    names = tuple(f"a{n // 4}-{n % 4:02d}" for n in columns)
    place = {row: n for n, row in enumerate(rows)} | {-1: -1}
    return CostTable(
        tuple(f"t{row}" for row in rows),
        names,
        costs_s[np.ix_(rows, columns)],
        tuple(place[current[n]] for n in columns),
    )


def said(assigner: Assigner, table: CostTable) -> dict[str, str | None]:
    chosen = assigner.assign(table).tolist()
    return {id: None if n < 0 else table.targets[n] for id, n in zip(table.vehicles, chosen, strict=True)}


@given(problems(), st.integers(1, 3), st.data())
def test_every_agent_finds_the_same_whatever_it_hosts_and_in_whichever_order(problem, pursuers, data):
    costs_s, current = problem
    targets, vehicles = costs_s.shape
    whole = said(Balanced(pursuers), table_of(costs_s, current, list(range(targets)), list(range(vehicles))))
    shuffled = data.draw(st.permutations(range(vehicles)))
    cut = data.draw(st.integers(0, vehicles))
    found: dict[str, str | None] = {}
    for own, others in ((shuffled[:cut], shuffled[cut:]), (shuffled[cut:], shuffled[:cut])):
        rows = data.draw(st.permutations(range(targets)))
        table = table_of(costs_s, current, rows, own)
        beside = table_of(costs_s, current, rows, others)
        found |= said(Balanced(pursuers), replace(table, others=beside))
    assert found == whole


def test_an_assigner_from_outside_that_asks_for_shared_costs_sees_them() -> None:
    seen: list[CostTable] = []

    class Nosy:
        shares_costs = True

        def assign(self, table: CostTable) -> NDArray[np.int64]:
            seen.append(table)
            return np.full(len(table.vehicles), -1, np.int64)

    faults: list[str] = []
    assigner = plugged(Nosy(), faults)
    assert shares_costs(assigner)
    assert not shares_costs(Cheapest())
    others = CostTable(("t0",), ("a1-00",), np.array([[7.0]]), (0,))
    assigner.assign(CostTable(("t0",), ("a0-00",), np.array([[3.0]]), (-1,), others))
    assert seen[0].others.vehicles == ("a1-00",)
    assert seen[0].others.costs_s.tolist() == [[7.0]]
    assert not faults


class Two:
    """Two agents of a group, of as many vehicles, and what they would ask planners."""

    def __init__(self, costs_s: dict[str, list[list[float]]], pursuers: int = 1) -> None:
        self.costs_s = costs_s
        self.targets = [f"t{n}" for n in range(len(costs_s["a0"]))]
        self.vehicles = {agent: vehicles_of(agent, len(rows[0])) for agent, rows in costs_s.items()}
        self.costs = {agent: GroupCosts(f"all.{agent}.1", "all", agent) for agent in costs_s}
        self.agents = {
            agent: Assignment(
                self.vehicles[agent], self.targets, Balanced(pursuers), PERIOD_S, 0.5, self.costs[agent]
            )
            for agent in costs_s
        }
        self.requests = 0

    def reassign(self, agent: str, now_ns: int, standing: tuple[str, ...] = ()) -> None:
        assignment = self.agents[agent]
        self.requests += 1
        assignment.ask(self.requests, now_ns)
        for target, row in zip(self.targets, self.costs_s[agent], strict=True):
            assignment.costs_given(self.requests, target, np.array(row, np.float32))
        alive = dict.fromkeys(self.targets, 1)
        told = assignment.costs_ended(self.requests, alive, now_ns, (), standing)
        for other, costs in self.costs.items():
            if other != agent:
                costs.receive(decode(encode(told), SharedCosts), now_ns)

    def chased(self, agent: str) -> list[str | None]:
        return [vehicle.target for vehicle in self.vehicles[agent].values()]


NEAR_T0 = {"a0": [[10.0, 12.0], [100.0, 90.0]], "a1": [[14.0, 16.0], [60.0, 95.0]]}


def test_a_dead_agent_is_reckoned_with_for_three_periods_at_most() -> None:
    two = Two(NEAR_T0)
    two.reassign("a1", 0)
    two.reassign("a0", PERIOD_NS)
    assert two.chased("a0") == ["t0", "t0"]
    two.reassign("a0", 4 * PERIOD_NS)
    assert two.chased("a0") == ["t0", "t1"]


def test_a_vehicle_that_an_operator_lets_stand_is_no_pursuer() -> None:
    two = Two(NEAR_T0)
    two.reassign("a1", 0, standing=("a1-00",))
    two.reassign("a0", PERIOD_NS)
    assert two.chased("a0") == ["t0", "t1"]


def test_a_target_that_no_one_can_reach_is_left_out_and_one_that_only_others_know_is_not() -> None:
    two = Two({"a0": [[10.0, 12.0], [math.inf, math.inf]], "a1": [[9.0, 16.0], [50.0, math.inf]]})
    for n in range(2):
        two.reassign("a1", 2 * n * PERIOD_NS)
        two.reassign("a0", (2 * n + 1) * PERIOD_NS)
    assert two.chased("a1") == ["t1", "t0"]
    assert two.chased("a0") == ["t0", "t0"]


def test_of_two_generations_of_an_agent_the_one_that_spoke_last_counts_and_none_speaks_for_another() -> None:
    costs = GroupCosts("all.a0.1", "all", "a0")
    costs.receive(told("all.a1.1", 5.0, stamp_ns=20), 20)
    costs.receive(told("all.a1.2", 6.0, stamp_ns=30), 30)
    costs.receive(told("all.a1.1", 7.0, stamp_ns=10), 40)
    costs.receive(told("all.a0.9", 8.0, stamp_ns=50), 50)
    assert costs.rows(["t0"])[1].tolist() == [[6.0]]


def test_of_the_agents_that_strangers_invent_a_bounded_number_is_kept() -> None:
    costs = GroupCosts("all.a0.1", "all", "a0")
    for n in range(1000):
        costs.receive(told(f"all.b{n}.1", 5.0, stamp_ns=n), n)
    assert len(costs.rows(["t0"])[0]) == 256


def told(author: str, cost_s: float, stamp_ns: int) -> SharedCosts:
    agent = author.split(".")[1]
    return SharedCosts(
        author=author, group="all", stamp_ns=stamp_ns, ids=[f"{agent}-00"], target_ids=["t0"],
        costs_s=pack_column([cost_s], "<f4"), targets=bytes([NO_TARGET]),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"costs_s": pack_column([1.0, 2.0], "<f4")}, "costs_s has 8 bytes"),
        ({"ids": ["a2-00"]}, "none of agent a1"),
        ({"ids": ["a1-00", "a1-00"], "costs_s": pack_column([1, 1], "<f4"), "targets": bytes(2)}, "twice"),
        ({"author": "north.a1.1"}, "no agent of the group"),
        ({"author": "all.a1"}, "no agent of the group"),
        ({"targets": bytes([1])}, "points past"),
        (
            {
                "target_ids": [f"t{n}" for n in range(10_000)],
                "costs_s": pack_column([1.0] * 10_000, "<f4"),
            },
            f"length <= {MOST_SHARED_TARGETS}",
        ),
    ],
)
def test_hostile_costs_are_refused_by_the_codec(changes: dict[str, object], found: str) -> None:
    fields = msgspec.msgpack.decode(encode(told("all.a1.1", 1.0, 1)))
    raw = msgspec.msgpack.encode({**fields, **changes})
    with pytest.raises(ProtocolError, match=found):
        decode(raw, SharedCosts)


# --- how often it is asked ---

SOON_S, TICK_S = 0.5, 0.1
TICKS = 300


def asks_of(targets: int, jumps: set[int]) -> list[int]:
    """The ticks in which an agent of one vehicle asks, if targets jump in these; all planners answer at once."""
    names = [f"t{n}" for n in range(targets)]
    assignment = Assignment(vehicles_of("a0", 1), names, Spread(), PERIOD_S, 1.0)
    asks = []
    for tick in range(TICKS):
        now_ns = round((1000 + tick * TICK_S) * NS_PER_S)
        if tick in jumps:
            assignment.target_jumped(now_ns)
        if assignment.due(now_ns):
            assignment.ask(tick, now_ns)
            for name in names:
                assignment.costs_given(tick, name, np.array([3.0], np.float32))
            assignment.costs_ended(tick, dict.fromkeys(names, 1), now_ns)
            asks.append(tick)
    return asks


histories = st.sets(st.integers(0, TICKS - 1), max_size=TICKS)


@given(st.integers(1, 25), histories)
def test_of_few_targets_each_jump_is_followed_by_a_request_within_half_a_second(targets, jumps):
    asks = asks_of(targets, jumps)
    soon = round(SOON_S / TICK_S)
    for jump in jumps:
        if jump + soon < TICKS:
            assert any(jump <= ask <= jump + soon for ask in asks), (jump, asks)


@given(st.integers(1, 1000), histories)
def test_however_many_targets_jump_an_agent_asks_each_planner_fifty_times_a_second_over_their_number(
    targets: int, jumps: set[int]
) -> None:
    asks = asks_of(targets, jumps)
    apart_s = np.diff(asks) * TICK_S
    least_s = min(PERIOD_S, max(targets / 50, TICK_S))
    assert (apart_s > least_s - 1e-6).all()
    assert (apart_s < PERIOD_S + 1e-6).all()
    assert asks
