"""What the processes of a run have counted, all together. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from swarm.runtime.stats import Histogram, merged
from swarm.wire.messages.processes import Stats


class Counts:
    """The newest counts of every incarnation of every process."""

    def __init__(self) -> None:
        self._stats: dict[tuple[str, str, int], Stats] = {}

    def count(self, stats: Stats) -> tuple[str, str, int]:
        """Take in what a process says; returns whose incarnation it is."""
        key = (stats.role, stats.id, stats.incarnation)
        known = self._stats.get(key)
        if known is None or stats.stamp_ns >= known.stamp_ns:
            self._stats[key] = stats
        return key

    def total(self, name: str) -> int | None:
        """A count, summed over processes and incarnations; None if no process has published it."""
        told = [stats.counts[name] for stats in self._stats.values() if name in stats.counts]
        return sum(told) if told else None

    def gauge(self, name: str) -> float | None:
        """A gauge, summed over the newest incarnation of each process; None if no process has published it."""
        told = [stats.gauges[name] for _, stats in sorted(self.newest().items()) if name in stats.gauges]
        return sum(told) if told else None

    def newest(self) -> dict[tuple[str, str], Stats]:
        """(role, id) -> what the newest incarnation of each process says."""
        found: dict[tuple[str, str], Stats] = {}
        for (role, id, incarnation), stats in self._stats.items():
            if (role, id) not in found or incarnation > found[role, id].incarnation:
                found[role, id] = stats
        return found

    def counts_by(self, name: str) -> dict[str, int]:
        """Counts per target or vehicle, summed as `total`."""
        counts: Counter[str] = Counter()
        for stats in self._stats.values():
            counts.update(stats.counts_by.get(name, {}))
        return dict(sorted(counts.items()))

    def histograms_by(self, name: str) -> dict[str, Histogram]:
        """Histograms per target or vehicle, over all processes."""
        parts: dict[str, list[Mapping[int, int]]] = {}
        for stats in self._stats.values():
            for id, buckets in stats.histograms_by.get(name, {}).items():
                parts.setdefault(id, []).append(buckets)
        return {id: merged(each) for id, each in sorted(parts.items())}

    def histogram(self, name: str) -> Histogram:
        """Histogram of a name, over all incarnations of all processes."""
        return merged(stats.histograms.get(name, {}) for stats in self._stats.values())
