"""The rate at which an agent asks all planners because targets jump: soon where they are few, seldom where many
do."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from vehicle_agent.assignment import Spread
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.target_choice import Assignment

PERIOD_S, SOON_S, TICK_S = 5.0, 0.5, 0.1
TICKS = 300


def asks_of(targets: int, jumps: set[int]) -> list[int]:
    """The ticks in which an agent of one vehicle asks, if targets jump in these; all planners answer at once."""
    names = [f"t{n}" for n in range(targets)]
    vehicles = {"a0-00": Vehicle("a0-00", GridSpec(10, 10, 10.0), 5)}
    assignment = Assignment(vehicles, names, Spread(), PERIOD_S, 1.0)
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
