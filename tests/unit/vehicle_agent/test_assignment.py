"""The target of each vehicle of an agent."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm.config.plugin_names import PLUGIN_KINDS, NamedPlugin
from swarm.grid import GridSpec
from swarm.plugins import Plugin
from vehicle_agent.assignment import ASSIGNERS, HYSTERESIS, AssignmentWorld, CostTable, assigner_of, spread
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.target_choice import Assignment


@st.composite
def worlds(draw: st.DrawFn) -> tuple[NDArray[np.float64], list[int]]:
    targets, vehicles = draw(st.integers(1, 5)), draw(st.integers(1, 12))
    cost = st.sampled_from([1.0, 2.0, 3.0, 50.0, 51.0, math.inf])
    rows = st.lists(cost, min_size=vehicles, max_size=vehicles)
    costs_s = np.array(draw(st.lists(rows, min_size=targets, max_size=targets)))
    current = draw(st.lists(st.integers(-1, targets - 1), min_size=vehicles, max_size=vehicles))
    return costs_s, current


@given(worlds())
def test_no_target_gets_more_than_its_even_share_and_nobody_a_target_out_of_reach(world):
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


@given(worlds())
def test_no_vehicle_and_target_that_would_both_gain_are_kept_apart(world):
    """Stability: where another target is cheaper for a vehicle, those that go for it reach it at no higher cost."""
    costs_s, current = world
    costs_s = costs_s.copy()
    chosen = spread(costs_s, current)
    for vehicle, target in enumerate(current):
        if target >= 0:
            costs_s[target, vehicle] *= 1.0 - HYSTERESIS
    share = math.ceil(costs_s.shape[1] / costs_s.shape[0])
    for vehicle, target in enumerate(chosen.tolist()):
        own_s = math.inf if target < 0 else costs_s[target, vehicle]
        for other in np.flatnonzero(costs_s[:, vehicle] < own_s).tolist():
            those = np.flatnonzero(chosen == other)
            assert len(those) == share
            assert costs_s[other, those].max() <= costs_s[other, vehicle]


@given(worlds(), st.sampled_from(sorted(ASSIGNERS)))
def test_no_share_that_others_fill_keeps_a_vehicle_from_the_targets_it_can_reach_and_targets_soon_stay(world, name):
    """Restrictions are random: of a target that a vehicle may not chase its agent knows no cost."""
    costs_s, current = world
    targets = [f"t{n}" for n in range(len(costs_s))]
    vehicles = {f"a0-{n:02d}": Vehicle(f"a0-{n:02d}", GridSpec(4, 4, 10.0), n) for n in range(len(current))}
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


@given(worlds(), answers)
def test_whatever_a_plugin_assigns_vehicles_go_only_where_they_have_a_route(world, answer):
    costs_s, current = world
    given_s = costs_s.copy()
    told: list[str] = []

    class Says:
        def assign(self, table: CostTable) -> object:
            table.costs_s[:] = -1.0  # its changes to its own table harm no other
            return answer

    named = NamedPlugin(PLUGIN_KINDS["assignment"], "vehicles.assignment", "my:Own", {})
    plugin = Plugin(named, lambda world, options: Says(), {})
    assigner = assigner_of(plugin, AssignmentWorld("a0", "all", (), 1), told.append)
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
