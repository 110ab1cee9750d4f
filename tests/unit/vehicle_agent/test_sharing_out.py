"""Balanced assignment: each target's pursuers come first, and every agent of the group finds the same ones."""

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
    HYSTERESIS,
    Assigner,
    AssignmentWorld,
    Balanced,
    Cheapest,
    CostTable,
    assigner_of,
    need_first,
    shares_costs,
)
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.target_choice import Assignment, GroupCosts

Costs = NDArray[np.float64]
Problem = tuple[Costs, list[int], int]
PERIOD_S = 5.0
PERIOD_NS = int(PERIOD_S * NS_PER_S)


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    targets, vehicles = draw(st.integers(1, 5)), draw(st.integers(1, 10))
    finite = st.integers(1, 40).map(float)
    cost = finite | st.just(math.inf) if draw(st.booleans()) else finite
    row = st.lists(cost, min_size=vehicles, max_size=vehicles)
    costs_s = np.array(draw(st.lists(row, min_size=targets, max_size=targets)))
    current = draw(st.lists(st.integers(-1, targets - 1), min_size=vehicles, max_size=vehicles))
    return costs_s, current, draw(st.integers(1, 3))


def discounted(costs_s: Costs, current: list[int]) -> Costs:
    cheaper = costs_s.copy()
    for vehicle, target in enumerate(current):
        if target >= 0:
            cheaper[target, vehicle] *= 1.0 - HYSTERESIS
    return cheaper


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


@given(problems())
def test_as_many_targets_as_can_be_get_each_of_their_pursuers_at_the_least_total_cost(problem: Problem) -> None:
    costs_s, current, pursuers = problem
    chosen = need_first(costs_s, current, pursuers)
    paid = discounted(costs_s, current)
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


# --- agents -----------------------------------------------------------------------------------------------------


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


@given(problems(), st.data())
def test_every_agent_finds_the_same_whatever_it_hosts_and_in_whichever_order(problem, data):
    costs_s, current, pursuers = problem
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

    named = NamedPlugin(PLUGIN_KINDS["assignment"], "vehicles.assignment", "my:Nosy", {})
    plugin = Plugin(named, lambda world, options: Nosy(), {})
    faults: list[str] = []
    assigner = assigner_of(plugin, AssignmentWorld("a0", "all", (), 1), faults.append)
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
        grid = GridSpec(10, 10, 10.0)
        self.vehicles = {
            agent: {f"{agent}-{n:02d}": Vehicle(f"{agent}-{n:02d}", grid, n) for n in range(len(rows[0]))}
            for agent, rows in costs_s.items()
        }
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


def test_two_agents_share_out_the_targets_between_all_of_their_vehicles() -> None:
    """a1's first vehicle is the nearest to t1, so no vehicle of a0 has to go there."""
    two = Two(NEAR_T0)
    for n in range(3):
        two.reassign("a0", 2 * n * PERIOD_NS)
        two.reassign("a1", (2 * n + 1) * PERIOD_NS)
    assert two.chased("a0") == ["t0", "t0"]
    assert two.chased("a1") == ["t1", "t1"]


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


def test_a_target_that_nobody_can_reach_is_left_out_and_one_that_only_others_know_is_not() -> None:
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


def test_however_many_agents_strangers_invent_only_so_many_are_kept() -> None:
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
        ({"costs_s": pack_column([math.nan], "<f4")}, "costs_s"),
        ({"costs_s": pack_column([-1.0], "<f4")}, "costs_s"),
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
