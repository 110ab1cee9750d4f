"""The queue of a thread: in order, bounded, with an end."""

from hypothesis import given
from hypothesis import strategies as st

from swarm.bus.zenoh_intake import Arrivals


@given(st.integers(1, 9), st.lists(st.none() | st.integers(1, 5), max_size=40))
def test_arrivals_are_taken_in_order_and_the_newest_are_dropped_when_full(most: int, comes: list[int | None]):
    """Each item comes with its weight."""
    arrivals = Arrivals(most, lambda weight: weight)
    waiting: list[int] = []
    for weight in comes:
        if weight is not None:
            fits = sum(waiting) + weight <= most
            assert arrivals.put(weight) == fits
            waiting += [weight] * fits
        elif waiting:
            assert arrivals.take() == waiting.pop(0)
    arrivals.end()
    assert list(iter(arrivals.take, None)) == waiting
