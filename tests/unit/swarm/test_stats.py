"""Histograms that merge by adding, and counters."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.makers import stats

from swarm.runtime.stats import Counters, Histogram, carried, merged
from swarm.wire.messages.processes import Stats

positive = st.floats(1e-6, 1e9)
samples = st.lists(positive, min_size=1, max_size=60)


def histogram(values: list[float]) -> Histogram:
    result = Histogram()
    for value in values:
        result.add(value)
    return result


@given(samples, st.floats(0, 1))
def test_a_quantile_and_the_mean_are_within_two_percent_of_the_true_ones(values, q):
    true = sorted(values)[min(len(values) - 1, int(q * len(values)))]
    assert histogram(values).quantile(q) == pytest.approx(true, rel=0.02)
    assert histogram(values).mean() == pytest.approx(math.fsum(values) / len(values), rel=0.02)


@given(st.lists(samples, max_size=5), st.randoms(use_true_random=False))
def test_merging_is_the_same_as_counting_everything_once_in_any_order(parts, random):
    whole = histogram([value for part in parts for value in part])
    pieces = [histogram(part).buckets for part in parts]
    random.shuffle(pieces)
    together = merged(pieces)
    assert together.buckets == whole.buckets
    assert together.mean() == whole.mean()
    assert together.count == sum(map(len, parts))


@given(st.floats())
def test_any_float_is_counted_or_left_out_and_never_raises(value):
    one = histogram([value])
    if math.isfinite(value) and value < 1e300:
        assert one.quantile(0.5) == pytest.approx(max(value, 0.0), rel=0.02)
    elif not math.isfinite(value):
        assert one.quantile(0.5) is None


def test_nothing_counted_has_no_quantile_and_no_mean():
    assert Histogram().quantile(0.5) is None
    assert Histogram().mean() is None
    assert merged([]).count == 0


def test_counters_count_gauge_and_observe():
    counters = Counters()
    counters.count("marks")
    counters.count("marks", 4)
    counters.count("lost", 0)
    counters.gauge("inbox", 3.0)
    counters.gauge("inbox", 2.0)
    counters.gauge("gap", 1.5)
    counters.gauge("gap", math.inf)
    counters.observe("tick_ms", 1.0)
    assert counters.counts == {"marks": 5, "lost": 0}
    assert counters.gauges == {"inbox": 2.0}
    assert counters.histograms["tick_ms"].count == 1


@given(st.lists(st.floats() | st.sampled_from([0.0, -1.0, 1.0, 1.02, 1e-300]), max_size=16))
def test_values_added_together_are_counted_as_one_by_one_the_positive_ones_first_and_in_order(values):
    together = Histogram()
    together.add_all(np.array(values, np.float64))
    finite = sorted(filter(math.isfinite, values), key=lambda value: (value <= 0, value))
    assert list(together.buckets.items()) == list(histogram(finite).buckets.items())


def test_a_later_generation_counts_on_and_says_since_when_the_first_has_counted() -> None:
    def generation(incarnation: int, marks: int) -> Stats:
        return stats(incarnation=incarnation, counts={"marks": marks})

    third = carried(carried(generation(10, 2), generation(20, 3)), generation(30, 4))
    assert (third.incarnation, third.since, third.counts) == (30, 10, {"marks": 9})
