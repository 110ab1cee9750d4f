"""Counts of processes between two instants, from the counters that each publishes. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from swarm.clock import NS_PER_S
from swarm.runtime.stats import Histogram, merged
from swarm.wire.messages.processes import Stats

_Key = tuple[str, str, int]
"""Role, id, incarnation."""


class StatsWindow:
    """The newest counters of each process, and those at the beginning of a window of time."""

    def __init__(self) -> None:
        self._newest: dict[_Key, Stats] = {}
        self._first: dict[_Key, Stats] = {}

    def hear(self, stats: Stats) -> None:
        key = (stats.role, stats.id, stats.incarnation)
        known = self._newest.get(key)
        if known is None or stats.stamp_ns >= known.stamp_ns:
            self._newest[key] = stats

    def begin(self) -> None:
        """Starts to count from the current state."""
        self._first = dict(self._newest)

    @property
    def spans(self) -> list[StatsSpan]:
        """One for each process that has published before and in the window."""
        return [
            StatsSpan(first, last)
            for key, first in sorted(self._first.items())
            if (last := self._newest[key]).stamp_ns > first.stamp_ns
        ]

    def silent(self, expected: Iterable[tuple[str, str]]) -> list[str]:
        """Those of the expected (role, id) which have not published twice, as `role id`."""
        heard = {(span.role, span.id) for span in self.spans}
        return [f"{role} {id}" for role, id in expected if (role, id) not in heard]


class StatsSpan:
    """The counts of one process between two of its publications."""

    def __init__(self, first: Stats, last: Stats) -> None:
        self._first, self._last = first, last
        self.role, self.id = last.role, last.id
        self.seconds = (last.stamp_ns - first.stamp_ns) / NS_PER_S

    def count(self, name: str) -> int:
        return self._last.counts.get(name, 0) - self._first.counts.get(name, 0)

    def per_s(self, name: str) -> float:
        return self.count(name) / self.seconds

    def buckets(self, name: str) -> dict[int, int]:
        """The part of a histogram that was added."""
        before = self._first.histograms.get(name, {})
        now = self._last.histograms.get(name, {})
        return {bucket: added for bucket, count in now.items() if (added := count - before.get(bucket, 0)) > 0}

    @property
    def ticks_due(self) -> int:
        """Ticks taken and ticks dropped."""
        return sum(self.buckets("tick_ms").values()) + self.count("ticks_dropped")


def ticks(spans: Iterable[StatsSpan]) -> dict[str, float | int | None]:
    """Lateness of the ticks of some processes: shares of those that were due; None if none was due."""
    spans = list(spans)
    due = sum(span.ticks_due for span in spans)
    worst = max((span.count("ticks_late") / span.ticks_due for span in spans if span.ticks_due), default=None)
    took = histogram(spans, "tick_ms")
    return {
        "due": due,
        "late_share": sum(span.count("ticks_late") for span in spans) / due if due else None,
        "dropped_share": sum(span.count("ticks_dropped") for span in spans) / due if due else None,
        "worst_late_share": worst,
        "p50_ms": took.quantile(0.5),
        "p99_ms": took.quantile(0.99),
    }


def histogram(spans: Iterable[StatsSpan], name: str) -> Histogram:
    return merged(span.buckets(name) for span in spans)
