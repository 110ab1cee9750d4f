"""What a swarm says of itself, as metric families of OpenMetrics. Pure: no bus, no socket, no clock.

Names follow the conventions of Prometheus: the prefix `swarm_`, base units (seconds, bytes, metres, ratios) at the
end, `_total` on what only grows. A process that its launcher
starts again goes on counting; one that was started by hand begins at zero, which `rate()` expects.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import NamedTuple

from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)

from launch_scripts.observe.counts import Counts
from launch_scripts.observe.latest_state import LatestState
from shared_map.keeper.service import THROTTLED
from swarm.clock import NS_PER_S
from swarm.runtime.stats import CAPTURES_OF, GAPS_TO, LEARNED, Histogram
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import RunInfo, Stats

PREFIX = "swarm_"
_PROCESS, _TARGET = ("role", "id"), ("target",)
BOUNDS = (*(step * 10.0**power for power in range(-4, 1) for step in (1, 2, 5)), 10.0)
"""Upper bounds of a histogram's buckets, in seconds or as ratio: 0.1 ms to 10 s, 0.01 % to 1,000 %."""
_STATE = "vehicles_"
"""Of gauges, each followed by a state."""

_RENAMED = {
    "messages_out": "messages_sent",
    "messages_in": "messages_received",
    "bytes_out": "sent_bytes",
    "bytes_in": "received_bytes",
    "window_growths": "tree_window_growths",
    "growths": "tree_growths",
    "growth_ms": "tree_growth_ms",
    "window_ms": "tree_window_growth_ms",
    "repair_ms": "tree_repair_ms",
    "cpu_s": "cpu_seconds",
}
"""Counters, gauges and histograms whose names say little beside those of other programs."""
_TAKEN = ("_total", "_count", "_sum", "_bucket", "_created", "_info", "_gcount", "_gsum")
"""Endings with which families make the names of their samples."""
_UNITS: dict[str, tuple[str, float]] = {
    "_ms": ("_seconds", 1e-3),
    "_us": ("_seconds", 1e-6),
    "_ns": ("_seconds", 1e-9),
}
"""Ending of our names -> ending that Prometheus has for the unit, and what one is worth in it."""

HELP = {
    "ticks_late": "Ticks that came later than half a period, or not at all",
    "ticks_dropped": "Ticks that did not come at all",
    "payloads_dropped": "Payloads that were no valid message",
    "asks_expired": "Questions refused as their askers had left",
    "events_dropped": "Samples or questions that found an inbox full",
    "captures": "Targets captured",
    "collisions": "Times that two vehicles were in one cell",
    "lethal_entries": "Times that a vehicle entered lethal ground",
    "reroute_requests": "Routes asked for by vehicles",
    "routes_served": "Routes answered by planners",
    "routes_pushed": "Newer routes that agents were given unasked",
    "marks": "Marks written by agents",
    "growths": "Trees grown whole",
    "window_growths": "Windows of trees grown",
    "messages_out": "Messages sent",
    "messages_in": "Messages received",
    "bytes_out": "Bytes of payloads sent",
    "bytes_in": "Bytes of payloads received",
    "growth_ms": "Time to grow a tree whole",
    "window_ms": "Time to grow a window of a tree",
    "repair_ms": "Time to take changes of the map into a tree",
    "route_query_ms": "Time from an agent's question to the route",
    "body_ms": "Time to take in bodies at a tick",
    "tick_ms": "Time that a tick took",
    "mark_to_tree_ms": "Time from a mark to the tree that knows it",
    "certified_gap_excess": "Proven distance of served routes from the optimum, as a share of the optimum",
    "broken_certificates": "Routes that were better than their proven bound: more than none is a bug",
    "followed_gap_excess": "The same of routes that vehicles have begun",
    "saves_failed": "Writes that the keeper's store refused",
    "blocked_ticks": "Ticks at which a vehicle had to wait for another",
    "sets_without_room": "Sets of marks refused as the map was full",
    "plugin_failed": "Times that a plug-in was left out for what it did",
    "driven_into": "Times that a vehicle drove into a body",
    "hit_by_bodies": "Times that a body met a vehicle",
    "strangers": "Processes of another run, or with another terrain, that were heard",
    "cpu_s": "CPU that the process has used",
    "rss_bytes": "Memory that the process has in use, with what it shares",
    "ready": "1 while the process has all that its role needs",
    "ended": "1 in the last figures of a process that ends as asked",
    "trackers_lost": "Times that a target's tracker fell silent",
}


_STATUS: tuple[tuple[str, str, Callable[[PlannerStatus], float | None]], ...] = (
    ("vehicles_following", "Vehicles on a route to the target", lambda status: status.following),
    (
        "tree_age_seconds",
        "Age of the planner's tree when it last said so",
        lambda status: status.tree_age_ms * 1e-3,
    ),
    ("pose_age_seconds", "Time since the target's last pose", lambda status: status.pose_age_s),
    ("lost", "1 while nobody tracks the target", lambda status: float(status.tracker_lost)),
)


class Run(NamedTuple):
    """Of which run the figures are."""

    run_id: str
    scenario: str
    started_ns: int


def figures_of(run: RunInfo | None, latest: LatestState | None) -> Figures:
    """The figures of a run which is observed from outside; none before it is found."""
    if run is None or latest is None:
        return Figures(None, Counts(), {}, [])
    return Figures(Run(run.run_id, run.scenario, run.started_ns), latest, latest.status, latest.up())


class Figures(NamedTuple):
    """What an observer knows of a run.

    run  None where it knows a part of the run only
    up  (role, id) of the processes that are alive
    """

    run: Run | None
    counts: Counts
    status: Mapping[str, PlannerStatus]
    up: Collection[tuple[str, str]]


def families(figures: Figures) -> Iterator[Metric]:
    """All metric families, each once, in order of name. Our own come first: what processes count has names from the
    network, none of which can take the place of these."""
    made: dict[str, Metric] = {}
    for family in _all(figures):
        if family.samples:
            made.setdefault(family.name, family)
    return iter([made[name] for name in sorted(made)])


def _all(figures: Figures) -> Iterator[Metric]:
    if figures.run is not None:
        info = InfoMetricFamily(f"{PREFIX}run", "The run that all other figures are of")
        info.add_metric((), {"run_id": figures.run.run_id, "scenario": figures.run.scenario})
        yield info
        yield GaugeMetricFamily(
            f"{PREFIX}run_start_time_seconds",
            "When the run began, in seconds of Unix time",
            value=figures.run.started_ns / NS_PER_S,
        )
    yield from _of_targets(figures)
    yield from _of_processes(figures)


def _of_processes(figures: Figures) -> Iterator[Metric]:
    newest = figures.counts.newest()
    up = GaugeMetricFamily(f"{PREFIX}process_up", "1 while the process is alive", labels=_PROCESS)
    for key in sorted({*figures.up, *newest}):
        up.add_metric(key, float(key in figures.up))
    yield up
    began = GaugeMetricFamily(
        f"{PREFIX}process_start_time_seconds", "When the process began, in seconds of Unix time", labels=_PROCESS
    )
    reported = GaugeMetricFamily(
        f"{PREFIX}process_reported_timestamp_seconds",
        "When the process told its figures last, in seconds of Unix time by its own clock",
        labels=_PROCESS,
    )
    for key, stats in sorted(newest.items()):
        began.add_metric(key, stats.incarnation / NS_PER_S)
        reported.add_metric(key, stats.stamp_ns / NS_PER_S)
    yield began
    yield reported
    for name in _names(stats.counts for stats in newest.values()):
        full, worth, text = named(name)
        counter = CounterMetricFamily(full, text, labels=_PROCESS)
        for key, stats in sorted(newest.items()):
            if name in stats.counts:
                counter.add_metric(key, stats.counts[name] * worth)
        yield counter
    yield from _gauges(newest)
    for name in _names(stats.histograms for stats in newest.values()):
        full, worth, text = named(name)
        family = HistogramMetricFamily(full, text, labels=_PROCESS)
        for key, stats in sorted(newest.items()):
            if name in stats.histograms:
                family.add_metric(key, *_buckets(stats.histograms[name], worth))
        yield family


def _gauges(newest: Mapping[tuple[str, str], Stats]) -> Iterator[Metric]:
    throttled = GaugeMetricFamily(
        f"{PREFIX}author_throttled",
        "1 while a keeper delays the marks of an author that exceeds its quota",
        labels=(*_PROCESS, "author"),
    )
    states = GaugeMetricFamily(f"{PREFIX}vehicles", "Vehicles in each state", labels=(*_PROCESS, "state"))
    learned = GaugeMetricFamily(
        f"{PREFIX}learned_pace_ratio",
        "What the prior pace of a class of ground is multiplied by, as vehicles have measured",
        labels=(*_PROCESS, "ground"),
    )
    for name in _names(stats.gauges for stats in newest.values()):
        full, worth, text = named(name)
        plain = GaugeMetricFamily(full, text, labels=_PROCESS)
        for key, stats in sorted(newest.items()):
            if name not in stats.gauges:
                continue
            value = stats.gauges[name]
            if name.startswith(THROTTLED):
                throttled.add_metric((*key, name.removeprefix(THROTTLED)), value)
            elif name.startswith(LEARNED):
                learned.add_metric((*key, name.removeprefix(LEARNED)), value)
            elif name.startswith(_STATE):
                states.add_metric((*key, name.removeprefix(_STATE)), value)
            else:
                plain.add_metric(key, value * worth)
        yield plain
    yield throttled
    yield states
    yield learned


def _of_targets(figures: Figures) -> Iterator[Metric]:
    captures = CounterMetricFamily(f"{PREFIX}target_captures", "Times that the target was captured", labels=_TARGET)
    for target, count in figures.counts.counts_by(CAPTURES_OF).items():
        captures.add_metric((target,), count)
    yield captures
    gap = HistogramMetricFamily(
        f"{PREFIX}target_certified_gap_ratio",
        "Proven distance from the optimum of routes that vehicles began, as a share of the optimum",
        labels=_TARGET,
    )
    for target, histogram in figures.counts.histograms_by(GAPS_TO).items():
        gap.add_metric((target,), *_buckets(histogram.buckets, 1.0))
    yield gap
    for name, text, value in _STATUS:
        family = GaugeMetricFamily(f"{PREFIX}target_{name}", text, labels=_TARGET)
        for target, status in sorted(figures.status.items()):
            told = value(status)
            if told is not None:
                family.add_metric((target,), told)
        yield family


def named(name: str) -> tuple[str, float, str]:
    """Name of a family, what one is worth in its unit, and its help, from a name on the wire: any text at all."""
    ours = _RENAMED.get(name, name)
    ending, worth = "", 1.0
    for unit, (base, value) in _UNITS.items():
        if ours.endswith(unit):
            ours, ending, worth = ours.removesuffix(unit), base, value
    if ours.endswith(("_excess", "gap")):
        ending = "_ratio"
    word = re.sub(r"[^a-z0-9]+", "_", ours.lower()).strip("_")
    while word.endswith(_TAKEN):
        word = word.rpartition("_")[0]
    word = word or "unnamed"
    return f"{PREFIX}{word}{ending}", worth, HELP.get(name, f"What processes count as {word}")


def _names(told: Iterable[Mapping[str, object]]) -> list[str]:
    return sorted({name for each in told for name in each})


def _buckets(buckets: Mapping[int, int], worth: float) -> tuple[list[tuple[str, float]], float]:
    """Cumulative counts under `BOUNDS`, and the sum of all values, each within the 2 % of our own buckets."""
    histogram = Histogram(buckets)
    values = [(value * worth, count) for value, count in histogram.values()]
    under = [(str(bound), float(sum(count for value, count in values if value <= bound))) for bound in BOUNDS]
    return [*under, ("+Inf", float(histogram.count))], math.fsum(value * count for value, count in values)
