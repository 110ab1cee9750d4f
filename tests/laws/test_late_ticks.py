"""Right of way with late ticks: vehicles drive the same distance in a number of ticks, however long these take."""

from functools import cache
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.effort import few
from support.traffic_world import TICK_NS, Faults, TrafficWorld

from vehicle_agent.right_of_way_sync import OwnTime

TICKS = 120


@cache
def drive(seed: int, times_as_long: int) -> TrafficWorld:
    world = TrafficWorld(seed, 5, 4, 16, 8, Faults(tick_ns=times_as_long * TICK_NS))
    world.run(TICKS * times_as_long * TICK_NS / 1e9)
    return world


@pytest.mark.parametrize("times_as_long", [4, 12, 40])
def test_late_ticks_do_not_cost_vehicles_more_than_the_time_they_take(times_as_long: int) -> None:
    for seed in range(few(3)):
        on_time, late = drive(seed, 1), drive(seed, times_as_long)
        assert not late.collisions
        # A message is received a tick later, so a step takes longer; by wall time it would be a tenth.
        assert sum(late.moves.values()) > 0.5 * sum(on_time.moves.values())
        assert late.takeovers <= 2 * on_time.takeovers
        assert late.messages < 1.1 * on_time.messages


@given(
    period_ns=st.integers(1, 10**9),
    start_ns=st.integers(0, 10**18),
    steps=st.lists(st.tuples(st.integers(-(10**9), 10**11), st.booleans()), max_size=50),
)
def test_own_time_never_goes_back_and_counts_a_period_for_a_tick_at_most(
    period_ns: int, start_ns: int, steps: list[tuple[int, bool]]
) -> None:
    own, now_ns = OwnTime(period_ns), start_ns
    told = [own.tick(now_ns)]
    ticks = [told[0]]
    for step_ns, is_tick in steps:
        now_ns += step_ns
        told.append(own.at(now_ns))
        if is_tick:
            ticks.append(own.tick(now_ns))
            assert ticks[-1] == told[-1]
    assert all(0 <= later - earlier <= period_ns for earlier, later in pairwise(ticks))
    if all(step_ns >= 0 for step_ns, _ in steps):
        assert told == sorted(told)
        assert told[-1] <= now_ns


def test_on_time_it_is_the_time_of_the_wall() -> None:
    own = OwnTime(100)
    told = [own.at(7), own.tick(7), own.at(50), own.tick(107), own.at(207), own.tick(200)]
    assert told == [7, 7, 50, 107, 207, 200]
