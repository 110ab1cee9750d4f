"""The counts of all processes of a run, summed; the certified gap, which is made of them; and CPU, memory and late
ticks of each process. Pure.

This is the one place which makes the certified gap from what agents count, for the live table, the report, the view
and `swarm status`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeVar

from msgspec.structs import replace

from swarm.clock import NS_PER_S
from swarm.peers import job_of
from swarm.runtime import stats as counters
from swarm.runtime.stats import Histogram, merged
from swarm.wire.messages.processes import Stats

LONG_SILENCE_NS = 10 * NS_PER_S
"""A process says its counts once a second. After a longer time without them it is named at the end of the run."""
Number = TypeVar("Number", int, float)


def sum_of(values: Iterable[Number | None]) -> Number | None:
    """Returns the sum of known values; None if there are none."""
    known = [value for value in values if value is not None]
    return sum(known) if known else None


_LEAST_NS = NS_PER_S // 2
"""Over a shorter time no rate is measured."""
_MOST_GENERATIONS = 1 << 13
"""Generations of processes that are counted: names may be made up by strangers."""


@dataclass(frozen=True, kw_only=True)
class ProcessLoad:
    """Load of one process, over the last second or so; None where it is unknown.

    cpu_percent  100 is one core
    late_per_s   ticks that came later than half a period, or not at all
    pid          of a process on this machine
    """

    role: str
    cpu_percent: float | None
    rss_bytes: float | None
    late_per_s: float | None
    messages_per_s: float | None
    restarts: int
    id: str
    alive: bool
    up_s: float
    pid: int | None = None

    @property
    def name(self) -> str:
        return f"{self.role}-{self.id}"


class Counts:
    """The newest counts of every process, and of earlier generations only counts that no later one continues, so
    restarts cost no memory."""

    def __init__(self) -> None:
        self._generations: dict[tuple[str, str], dict[int, Stats]] = {}
        """(role, id) -> incarnation -> its last `Stats`."""
        self._newest: dict[tuple[str, str], Stats] = {}
        """(role, id) -> of its newest incarnation."""
        self._before: dict[tuple[str, str], Stats] = {}
        """(role, id) -> of the same incarnation, at least `_LEAST_NS` earlier; without what no rate is
        made of, which takes most of the memory."""
        self.silences: dict[tuple[str, str], tuple[int, int]] = {}
        """(role, id) -> begin and end of the longest time without counts in one generation, if that was long."""

    def count(self, stats: Stats) -> None:
        """Takes in what a process says."""
        of = (stats.role, stats.id)
        generations = self._generations.get(of, {})
        known = generations.get(stats.incarnation)
        if known is None:
            if any(_carries(each, stats.incarnation) for each in generations.values()):
                return
            if sum(map(len, self._generations.values())) >= _MOST_GENERATIONS:
                return
            self._generations[of] = generations = {
                generation: each for generation, each in generations.items() if not _carries(stats, generation)
            }
        elif stats.stamp_ns < known.stamp_ns:
            return
        generations[stats.incarnation] = stats
        newest = self._newest[of] = generations[max(generations)]
        if newest is stats and known is None:
            self._before.pop(of, None)
        elif newest is stats and known is not None and stats.stamp_ns - known.stamp_ns >= _LEAST_NS:
            self._before[of] = replace(known, histograms={}, counts_by={}, histograms_by={})
        began_ns, end_ns = self.silences.get(of, (0, LONG_SILENCE_NS))
        if known is not None and stats.stamp_ns - known.stamp_ns > end_ns - began_ns:
            self.silences[of] = (known.stamp_ns, stats.stamp_ns)

    def newest_stats(self, role: str, id: str) -> Stats | None:
        """Returns the last `Stats` of a process's newest incarnation."""
        return self._newest.get((role, id))

    def newest(self) -> dict[tuple[str, str], Stats]:
        """(role, id) -> what its newest incarnation has said last, in order."""
        return dict(sorted(self._newest.items()))

    def _summed(self) -> Iterator[Stats]:
        return (stats for generations in self._generations.values() for stats in generations.values())

    def total(self, name: str) -> int | None:
        """A count, summed over processes and incarnations; None if no process has published it."""
        return sum_of(stats.counts.get(name) for stats in self._summed())

    def of_job(self, role: str, job: str, *names: str) -> int | None:
        """Counts of the processes with one job, such as a target's planner and its standbys, summed; None if none
        of them has published any."""
        of = [stats.counts for stats in self._summed() if stats.role == role and job_of(stats.id) == job]
        return sum_of(counts.get(name) for counts in of for name in names)

    def gauge(self, name: str) -> float | None:
        """A gauge, summed over the newest incarnation of each process; None if no process has published it."""
        return sum_of(stats.gauges.get(name) for stats in self.newest().values())

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

    def loads(self, up: Collection[tuple[str, str]]) -> list[ProcessLoad]:
        """Returns every process with a known load, in order.

        up  (role, id) of those that are alive
        """
        return [
            ProcessLoad(
                role=role,
                id=id,
                alive=(role, id) in up,
                up_s=max(now.stamp_ns - now.incarnation, 0) / NS_PER_S,
                cpu_percent=_rate(before, now, "gauges", counters.CPU_S, 100.0),
                rss_bytes=now.gauges.get(counters.RSS_BYTES),
                late_per_s=_rate(before, now, "counts", "ticks_late"),
                messages_per_s=now.gauges.get(counters.MESSAGES_PER_S),
                restarts=round(now.gauges.get(counters.RESTARTS, 0.0)),
            )
            for (role, id), now in self.newest().items()
            for before in [self._before.get((role, id))]
        ]


def _carries(stats: Stats, incarnation: int) -> bool:
    """Returns True if a generation counts on where an earlier one ended."""
    return 0 < stats.since <= incarnation < stats.incarnation


# --- the certified gap --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CertifiedGap:
    """Certified gap of some routes at most: 1.05 is proven to be at most 5 % above the optimum.

    mean, p95, max  cost over proven lower bound; None without a proven route
    routes          that vehicles began
    unproven        of these, routes without a lower bound; they are in no mean
    """

    mean: float | None = None
    p95: float | None = None
    max: float | None = None
    routes: int = 0
    unproven: int = 0

    def fields(self) -> dict[str, float | None]:
        """The gap for a report."""
        return {"mean": self.mean, "p95": self.p95, "max": self.max, "unproven": self.unproven}


def gap_text(fields: Mapping[str, float | None]) -> str:
    """The fields of a `CertifiedGap` for people."""
    unproven = f"{fields['unproven']:g} unproven" if fields.get("unproven") else ""
    if fields.get("mean") is None:
        return unproven or "-"
    proven = ", ".join(f"{name} {percent(fields[name])}" for name in ("mean", "p95", "max"))
    return f"{proven}, {unproven}" if unproven else proven


def certified_gap(counted: Counts) -> CertifiedGap:
    """The gap of all routes of a run."""
    return gap_of(counted.histogram("followed_gap_excess"), counted.total("followed_unproven") or 0)


def gaps_to(counted: Counts) -> dict[str, CertifiedGap]:
    """The gap per target, of the routes to it."""
    return _gaps(counted.histograms_by(counters.GAPS_TO), counted.counts_by(counters.UNPROVEN_TO))


def gaps_of(counted: Counts) -> dict[str, CertifiedGap]:
    """The gap per vehicle, of the routes which it began."""
    return _gaps(counted.histograms_by(counters.GAPS_OF), counted.counts_by(counters.UNPROVEN_OF))


def _gaps(proven: Mapping[str, Histogram], unproven: Mapping[str, int]) -> dict[str, CertifiedGap]:
    ids = sorted({*proven, *unproven})
    return {id: gap_of(proven.get(id, Histogram()), unproven.get(id, 0)) for id in ids}


def gap_of(excess: Histogram, unproven: int) -> CertifiedGap:
    """The gap from a histogram of gap - 1."""
    return CertifiedGap(**of_excess(excess), routes=excess.count + unproven, unproven=unproven)


def of_excess(histogram: Histogram) -> dict[str, float | None]:
    """Mean, p95 and max of gaps, from a histogram of gap - 1."""
    values = {"mean": histogram.mean(), "p95": histogram.quantile(0.95), "max": histogram.quantile(1.0)}
    return {name: None if value is None else 1.0 + value for name, value in values.items()}


def percent(gap: float | None) -> str:
    """The excess of a gap over 1, for people."""
    return "-" if gap is None else f"{max(gap - 1, 0):.2%}"


def _rate(before: Stats | None, now: Stats, where: str, name: str, times: float = 1.0) -> float | None:
    """By how much it grew a second."""
    earlier = None if before is None else getattr(before, where).get(name)
    later = getattr(now, where).get(name)
    if before is None or earlier is None or later is None:
        return None
    return float(max(later - earlier, 0) * times * NS_PER_S / (now.stamp_ns - before.stamp_ns))
