"""The queue of a thread: in order, bounded, with an end."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from swarm.bus.zenoh_intake import Arrivals


@given(st.integers(1, 5), st.lists(st.booleans(), max_size=40))
def test_arrivals_are_taken_in_order_and_the_newest_are_dropped_when_full(most: int, comes: list[bool]):
    arrivals = Arrivals(most)
    waiting: list[int] = []
    for number, comes_one in enumerate(comes):
        if comes_one:
            arrivals.put(number)
            waiting = [*waiting, number][:most]
        elif waiting:
            assert arrivals.take() == waiting.pop(0)
    arrivals.end()
    assert list(iter(arrivals.take, None)) == waiting
