"""Counters and mergeable histograms that every process publishes about itself."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import msgspec

from swarm.wire.fields import MOST_IDS, TOP_BUCKET, ZERO_BUCKET, np
from swarm.wire.messages.processes import Stats

if TYPE_CHECKING:
    from numpy.typing import NDArray

CAPTURES_OF = "captures_of"
"""Per target, by the process that moves the targets."""
CAPTURES_BY = "captures_by"
"""Per vehicle, by the same."""
GAPS_TO = "followed_gap_excess_to"
"""Per target, by agents: cost of each route that a vehicle begins over its proven lower bound, less 1."""
GAPS_OF = "followed_gap_excess_of"
"""The same per vehicle."""
UNPROVEN_TO = "followed_unproven_to"
"""Per target, by agents: routes begun without a lower bound."""
UNPROVEN_OF = "followed_unproven_of"
"""The same per vehicle."""

LEARNED = "learned."
"""Gauges, each followed by a class of ground: by what its prior pace is multiplied, as vehicles have measured."""
CPU_S = "cpu_s"
"""Gauge: seconds of CPU that a process has used since it began."""
VIEWERS = "viewers"
"""Gauge of a monitor: connections of people who look at the live view now."""
RSS_BYTES = "rss_bytes"
"""Gauge: memory that a process has in use, with what it shares."""
ENDED = "ended"
"""Gauge: 1 in the last words of a process that ends because it was asked to."""
RESTARTS = "restarts"
"""Gauge: how often the process was started again in this run."""
MESSAGES_PER_S = "messages_per_s"
"""Gauge: messages that the process sent per second, over the last second or so."""
FIRST_USES = "first_uses"
"""Counter: modules and kernels that were loaded in the loop of a process, which waited for them; must be 0."""

READY = "ready"
"""Gauge: 1 while the process has all that its role needs."""

_BASE = 1.04
"""Width of a bucket: quantiles are within half of it, 2 %."""
_LOG_BASE = math.log(_BASE)


_FEW = 8
"""Up to this number of values a loop is faster than arrays."""


class Histogram:
    """Positive values in logarithmic buckets 4 % wide: merged by adding, quantiles within 2 %.

    A plain sample reservoir cannot be merged across processes, and fixed buckets (as of Prometheus) are too
    coarse for latencies from microseconds to seconds.
    """

    def __init__(self, buckets: Mapping[int, int] | None = None) -> None:
        self.buckets: dict[int, int] = dict(buckets or {})

    def add(self, value: float, times: int = 1) -> None:
        """Counts a value. Zero and below count as zero; infinities and NaN are ignored."""
        if not math.isfinite(value):
            return
        bucket = ZERO_BUCKET if value <= 0 else min(round(math.log(value) / _LOG_BASE), TOP_BUCKET)
        self.buckets[bucket] = self.buckets.get(bucket, 0) + times

    def add_all(self, values: NDArray[np.float64]) -> None:
        """Counts each value as `add` does, in a fixed order because the order of buckets reaches the wire: positive
        values from the least to the greatest, then all others."""
        if values.size <= _FEW:
            for value in sorted(filter(math.isfinite, values.tolist()), key=lambda value: (value <= 0, value)):
                self.add(value)
            return
        values = values[np.isfinite(values)]
        positive = values[values > 0]
        found = np.minimum(np.rint(np.log(positive) / _LOG_BASE), TOP_BUCKET).astype(np.int64)
        buckets, counts = np.unique(found, return_counts=True)
        self.merge(dict(zip(buckets.tolist(), counts.tolist(), strict=True)))
        if positive.size < values.size:
            self.merge({ZERO_BUCKET: values.size - positive.size})

    def merge(self, buckets: Mapping[int, int]) -> None:
        """Adds the counts of another histogram's buckets."""
        for bucket, count in buckets.items():
            self.buckets[bucket] = self.buckets.get(bucket, 0) + count

    @property
    def count(self) -> int:
        return sum(self.buckets.values())

    def values(self) -> list[tuple[float, int]]:
        """Middles of the buckets, rising, and how many values are in each."""
        return [(_value(bucket), count) for bucket, count in sorted(self.buckets.items())]

    def quantile(self, q: float) -> float | None:
        """The value below which a share `q` of all values lies, within 2 %; None if there are none."""
        total = self.count
        if total == 0:
            return None
        rank = min(total - 1, int(q * total))
        seen = 0
        for bucket in sorted(self.buckets):
            seen += self.buckets[bucket]
            if seen > rank:
                return _value(bucket)
        raise AssertionError("unreachable")

    def mean(self) -> float | None:
        """The mean within 2 %; None if there are no values."""
        total = self.count
        if total == 0:
            return None
        # In order, so that the sum does not depend on the order of merging.
        return math.fsum(value * count for value, count in self.values()) / total


@functools.lru_cache(maxsize=4096)
def _value(bucket: int) -> float:
    return 0.0 if bucket == ZERO_BUCKET else math.exp(bucket * _LOG_BASE)


def merged(parts: Iterable[Mapping[int, int]]) -> Histogram:
    """The histogram of all values of many processes, from their buckets."""
    whole = Histogram()
    for part in parts:
        whole.merge(part)
    return whole


def figures(stats: Stats) -> int:
    """Returns the number of figures in counters: what they take in memory, in 100 bytes."""
    histograms = [
        *stats.histograms.values(),
        *(each for of in stats.histograms_by.values() for each in of.values()),
    ]
    by = sum(map(len, stats.counts_by.values()))
    return len(stats.counts) + len(stats.gauges) + by + sum(1 + len(each) for each in histograms)


def carried(before: Stats, own: Stats) -> Stats:
    """The statistics of a generation that continues the counts of the previous one. Gauges are only the new
    generation's."""
    return msgspec.structs.replace(
        own,
        counts=_summed(before.counts, own.counts),
        histograms=_merged_each(before.histograms, own.histograms),
        counts_by={
            name: _summed(before.counts_by.get(name, {}), own.counts_by.get(name, {}))
            for name in {**before.counts_by, **own.counts_by}
        },
        histograms_by={
            name: _merged_each(before.histograms_by.get(name, {}), own.histograms_by.get(name, {}))
            for name in {**before.histograms_by, **own.histograms_by}
        },
        since=before.since or before.incarnation,
    )


def _summed(one: Mapping[str, int], other: Mapping[str, int]) -> dict[str, int]:
    names = dict.fromkeys([*one, *other])
    return {name: one.get(name, 0) + other.get(name, 0) for name in list(names)[:MOST_IDS]}


def _merged_each(
    one: Mapping[str, Mapping[int, int]], other: Mapping[str, Mapping[int, int]]
) -> dict[str, dict[int, int]]:
    names = dict.fromkeys([*one, *other])
    return {name: merged((one.get(name, {}), other.get(name, {}))).buckets for name in list(names)[:MOST_IDS]}


class Counters:
    """Counts, measured values and times of a process, by name. Names carry units: `route_query_ms`.

    Used by the thread that owns the service only; published by `Member` and never reset.
    """

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.gauges: dict[str, float] = {}
        self.histograms: dict[str, Histogram] = {}
        self.counts_by: dict[str, dict[str, int]] = {}
        self.histograms_by: dict[str, dict[str, Histogram]] = {}

    def count_by(self, name: str, id: str) -> None:
        """Counts for one target or vehicle; those beyond `MOST_IDS` are counted as `ids_uncounted` only."""
        counts = self.counts_by.setdefault(name, {})
        if id in counts or len(counts) < MOST_IDS:
            counts[id] = counts.get(id, 0) + 1
        else:
            self.count("ids_uncounted")

    def observe_by(self, name: str, id: str, value: float) -> None:
        """Adds a value to the histogram of one target or vehicle; bounded as `count_by`."""
        histograms = self.histograms_by.setdefault(name, {})
        if id in histograms or len(histograms) < MOST_IDS:
            _named(id, histograms).add(value)
        else:
            self.count("ids_uncounted")

    def count(self, name: str, by: int = 1) -> None:
        self.counts[name] = self.counts.get(name, 0) + by

    def set_counts(self, counts: Mapping[str, int]) -> None:
        """Copies counters of another object, under its names."""
        self.counts.update(counts)

    def gauge(self, name: str, value: float) -> None:
        """Sets the present value; infinities and NaN remove it."""
        if math.isfinite(value):
            self.gauges[name] = value
        else:
            self.gauges.pop(name, None)

    def observe(self, name: str, value: float) -> None:
        """Adds a value to a histogram."""
        _named(name, self.histograms).add(value)

    def observe_all(self, name: str, values: NDArray[np.float64]) -> None:
        if values.size:
            _named(name, self.histograms).add_all(values)


def _named(name: str, histograms: dict[str, Histogram]) -> Histogram:
    """The histogram of a name, which is there from now on."""
    found = histograms.get(name)
    if found is None:  # `setdefault` would make one each time
        found = histograms[name] = Histogram()
    return found
