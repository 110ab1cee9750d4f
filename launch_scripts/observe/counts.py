"""What the processes of a run have counted, all together. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from swarm.liveness import job_of
from swarm.runtime.stats import Histogram, merged
from swarm.wire.messages.processes import Stats


class Counts:
    """The newest counts of every incarnation of every process."""

    def __init__(self) -> None:
        self._stats: dict[tuple[str, str, int], Stats] = {}
        self._counting: list[Stats] | None = None
        """Those that are summed; None since the last that was new."""
        self._newest: dict[tuple[str, str], Stats] = {}
        """(role, id) -> of its newest incarnation."""

    def count(self, stats: Stats) -> tuple[str, str, int]:
        """Take in what a process says; returns whose incarnation it is."""
        key = (stats.role, stats.id, stats.incarnation)
        known = self._stats.get(key)
        if known is None or stats.stamp_ns >= known.stamp_ns:
            self._stats[key] = stats
            self._counting = None
            newest = self._newest.get((stats.role, stats.id))
            if newest is None or stats.incarnation >= newest.incarnation:
                self._newest[stats.role, stats.id] = stats
        return key

    def newest_stats(self, role: str, id: str) -> Stats | None:
        """What the newest incarnation of a process has said last."""
        return self._newest.get((role, id))

    def newest(self) -> dict[tuple[str, str], Stats]:
        """(role, id) -> what its newest incarnation has said last, in order."""
        return dict(sorted(self._newest.items()))

    def _summed(self) -> list[Stats]:
        """What is summed: of lives whose counts a later one carries on only the later."""
        if self._counting is None:
            self._counting = []
            before: dict[tuple[str, str], int] = {}
            """(role, id) -> the incarnation from which on all is counted."""
            for (role, id, incarnation), stats in sorted(self._stats.items(), reverse=True):
                if incarnation < before.get((role, id), incarnation + 1):
                    self._counting.append(stats)
                    before[role, id] = min(stats.since or incarnation, incarnation)
        return self._counting

    def total(self, name: str) -> int | None:
        """A count, summed over processes and incarnations; None if no process has published it."""
        told = [stats.counts[name] for stats in self._summed() if name in stats.counts]
        return sum(told) if told else None

    def of_job(self, role: str, job: str, *names: str) -> int | None:
        """Counts of the processes with one job, such as a target's planner and its standbys, summed; None if none
        of them has published any."""
        told = [
            stats.counts[name]
            for stats in self._summed()
            if stats.role == role and job_of(stats.id) == job
            for name in names
            if name in stats.counts
        ]
        return sum(told) if told else None

    def gauge(self, name: str) -> float | None:
        """A gauge, summed over the newest incarnation of each process; None if no process has published it."""
        told = [stats.gauges[name] for _, stats in self.newest().items() if name in stats.gauges]
        return sum(told) if told else None

    def counts_by(self, name: str) -> dict[str, int]:
        """Counts per target or vehicle, summed as `total`."""
        counts: Counter[str] = Counter()
        for stats in self._summed():
            counts.update(stats.counts_by.get(name, {}))
        return dict(sorted(counts.items()))

    def histograms_by(self, name: str) -> dict[str, Histogram]:
        """Histograms per target or vehicle, over all processes."""
        parts: dict[str, list[Mapping[int, int]]] = {}
        for stats in self._summed():
            for id, buckets in stats.histograms_by.get(name, {}).items():
                parts.setdefault(id, []).append(buckets)
        return {id: merged(each) for id, each in sorted(parts.items())}

    def histogram(self, name: str) -> Histogram:
        """Histogram of a name, over all incarnations of all processes."""
        return merged(stats.histograms.get(name, {}) for stats in self._summed())
