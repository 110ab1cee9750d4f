"""What the loop of a process writes into its service's counters: an input of the service, as it publishes them."""

from __future__ import annotations

from collections.abc import Mapping

from swarm.recording.records import LoopFigures
from swarm.runtime.stats import Counters, Histogram


class LoopCounters(Counters):
    """The counters of a service, for its loop: the same figures, and which of them the loop writes."""

    def __init__(self, counters: Counters) -> None:
        self.counts = counters.counts
        self.gauges = counters.gauges
        self.histograms = counters.histograms
        self.counts_by = counters.counts_by
        self.histograms_by = counters.histograms_by
        self._counts: dict[str, int | None] = {}
        """Written by the loop, as last recorded; so are those below."""
        self._gauges: dict[str, float | None] = {}
        self._buckets: dict[str, dict[int, int]] = {}

    def count(self, name: str, by: int = 1) -> None:
        self._counts.setdefault(name, None)
        super().count(name, by)

    def set_counts(self, counts: Mapping[str, int]) -> None:
        for name in counts:
            self._counts.setdefault(name, None)
        super().set_counts(counts)

    def gauge(self, name: str, value: float) -> None:
        self._gauges.setdefault(name, None)
        super().gauge(name, value)

    def observe(self, name: str, value: float) -> None:
        self._buckets.setdefault(name, {})
        super().observe(name, value)

    def changed(self) -> LoopFigures | None:
        """What the loop has changed since this was called last; None if it has not changed anything."""
        counts = {name: self.counts[name] for name, told in self._counts.items() if self.counts[name] != told}
        gauges = {
            name: self.gauges[name]
            for name, told in self._gauges.items()
            if name in self.gauges and self.gauges[name] != told
        }
        buckets: dict[str, dict[int, int]] = {}
        for name, told_buckets in self._buckets.items():
            found = self.histograms[name].buckets
            new = {bucket: count for bucket, count in found.items() if count != told_buckets.get(bucket)}
            if new:
                buckets[name] = new
                told_buckets.update(new)
        if not counts and not gauges and not buckets:
            return None
        self._counts.update(counts)
        self._gauges.update(gauges)
        return LoopFigures(counts, gauges, buckets)


def set_figures(counters: Counters, figures: LoopFigures | None) -> None:
    """Write recorded figures into a service's counters."""
    if figures is None:
        return
    counters.set_counts(figures.counts)
    counters.gauges.update(figures.gauges)
    for name, buckets in figures.buckets.items():
        counters.histograms.setdefault(name, Histogram()).buckets.update(buckets)
