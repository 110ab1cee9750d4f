"""What a swarm says of itself, for Prometheus: made into metric families of OpenMetrics, and served.

Names follow the conventions of Prometheus: the prefix `swarm_`, base units (seconds, bytes, metres, ratios) at the
end, `_total` on what only grows. A process that its launcher starts again goes on counting; one that was started by
hand begins at zero, which `rate()` expects.
"""

from __future__ import annotations

import math
import queue
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future
from email.message import Message
from pathlib import Path
from typing import Any, NamedTuple

from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from launch_scripts.observe.counts import Counts
from launch_scripts.observe.latest_state import LatestState
from launch_scripts.web import LOOPBACK, Reply
from launch_scripts.web.health_verdict import Process, health_pages
from launch_scripts.web.server import Server
from shared_map.keeper.service import THROTTLED
from swarm.clock import NS_PER_S
from swarm.runtime.stats import CAPTURES_OF, GAPS_TO, LEARNED, Histogram
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import RunInfo

_TABLES = tomllib.loads(Path(__file__).with_name("metric_names.toml").read_text(encoding="utf-8"))
HELP: dict[str, str] = _TABLES["help"]
BOUNDS = (*(step * 10.0**power for power in range(-4, 1) for step in (1, 2, 5)), 10.0)
"""Upper bounds of a histogram's buckets, in seconds or as ratio: 0.1 ms to 10 s, 0.01 % to 1,000 %."""
_TAKEN = ("_total", "_count", "_sum", "_bucket", "_created", "_info", "_gcount", "_gsum")
"""Endings with which families make the names of their samples."""
_UNITS = {"_ms": ("_seconds", 1e-3), "_us": ("_seconds", 1e-6), "_ns": ("_seconds", 1e-9)}
"""Ending of our names -> ending that Prometheus has for the unit, and what one is worth in it."""
_SPLIT = {
    "vehicles_": ("vehicles", "state", "Vehicles in each state"),
    THROTTLED: (
        "author_throttled",
        "author",
        "1 while a keeper delays the marks of an author that exceeds its quota",
    ),
    LEARNED: (
        "learned_pace_ratio",
        "ground",
        "What the prior pace of a class of ground is multiplied by, as vehicles have measured",
    ),
}
"""Beginning of our gauges' names -> their family, the label that holds the rest of the name, help."""
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
_SCRAPE_WAITS_S = 5.0
"""Prometheus gives up after 10 s."""


class Run(NamedTuple):
    """The run which the figures are of."""

    run_id: str
    scenario: str
    started_ns: int


class Figures(NamedTuple):
    """What an observer knows of a run.

    run  None where it knows a part of the run only
    up   (role, id) of the processes that are alive
    """

    run: Run | None
    counts: Counts
    status: Mapping[str, PlannerStatus]
    up: Collection[tuple[str, str]]


def figures_of(run: RunInfo | None, latest: LatestState | None) -> Figures:
    """The figures of a run which is observed from outside; none before it is found."""
    if run is None or latest is None:
        return Figures(None, Counts(), {}, [])
    return Figures(Run(run.run_id, run.scenario, run.started_ns), latest, latest.status, latest.up())


class _Families:
    """Metric families by name. A name belongs to whoever adds to it first: what processes count has names from the
    network, and none of them takes the place of ours."""

    def __init__(self) -> None:
        self.made: dict[str, tuple[str, Any]] = {}

    def add(self, kind: Any, name: str, text: str, labels: Mapping[str, str], *value: object, of: str = "") -> None:
        """Adds a sample.

        value  as `kind.add_metric` takes it
        of     the name on the wire; empty for families of ours
        """
        first = (of, kind(f"swarm_{name}", text, labels=tuple(labels)))
        owner, family = self.made.setdefault(name, first)
        if owner == of and type(family) is kind:
            family.add_metric(tuple(labels.values()), *value)


def families(figures: Figures) -> list[Metric]:
    """All metric families, each once, in order of name."""
    made = _Families()
    if figures.run is not None:
        told = {"run_id": figures.run.run_id, "scenario": figures.run.scenario}
        made.add(InfoMetricFamily, "run", "The run that all other figures are of", {}, told)
        text = "When the run began, in seconds of Unix time"
        made.add(GaugeMetricFamily, "run_start_time_seconds", text, {}, figures.run.started_ns / NS_PER_S)
    _add_targets(made, figures)
    _add_processes(made, figures)
    return [family for _, (_, family) in sorted(made.made.items(), key=lambda item: item[0])]


def _add_targets(made: _Families, figures: Figures) -> None:
    for target, count in figures.counts.counts_by(CAPTURES_OF).items():
        text = "Times that the target was captured"
        made.add(CounterMetricFamily, "target_captures", text, {"target": target}, count)
    for target, gaps in figures.counts.histograms_by(GAPS_TO).items():
        text = "Proven distance from the optimum of routes that vehicles began, as a share of the optimum"
        labels = {"target": target}
        made.add(HistogramMetricFamily, "target_certified_gap_ratio", text, labels, *_buckets(gaps.buckets, 1.0))
    for target, status in sorted(figures.status.items()):
        for name, text, value in _STATUS:
            if (told := value(status)) is not None:
                made.add(GaugeMetricFamily, f"target_{name}", text, {"target": target}, told)


def _add_processes(made: _Families, figures: Figures) -> None:
    newest = {key: ({"role": key[0], "id": key[1]}, stats) for key, stats in figures.counts.newest().items()}
    for role, id in sorted({*figures.up, *newest}):
        text, alive = "1 while the process is alive", float((role, id) in figures.up)
        made.add(GaugeMetricFamily, "process_up", text, {"role": role, "id": id}, alive)
    for process, stats in newest.values():
        text = "When the process began, in seconds of Unix time"
        made.add(GaugeMetricFamily, "process_start_time_seconds", text, process, stats.incarnation / NS_PER_S)
        text = "When the process told its figures last, in seconds of Unix time by its own clock"
        made.add(GaugeMetricFamily, "process_reported_timestamp_seconds", text, process, stats.stamp_ns / NS_PER_S)
    for kind, field in (
        (CounterMetricFamily, "counts"),
        (GaugeMetricFamily, "gauges"),
        (HistogramMetricFamily, "histograms"),
    ):
        told = [(process, getattr(stats, field)) for process, stats in newest.values()]
        for wire in sorted({name for _, values in told for name in values}):
            name, worth, text = named(wire)
            split = next((start for start in _SPLIT if field == "gauges" and wire.startswith(start)), None)
            for process, values in told:
                if wire not in values:
                    continue
                value = values[wire]
                if split is not None:
                    family, label, about = _SPLIT[split]
                    rest = {label: wire.removeprefix(split)}
                    made.add(kind, family, about, {**process, **rest}, value, of=split)
                elif field == "histograms":
                    made.add(kind, name, text, process, *_buckets(value, worth), of=wire)
                else:
                    made.add(kind, name, text, process, value * worth, of=wire)


def named(wire: str) -> tuple[str, float, str]:
    """Name of a family without its prefix, what one is worth in its unit, and its help, from a name on the wire:
    any text at all."""
    ours = _TABLES["renamed"].get(wire, wire)
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
    return f"{word}{ending}", worth, HELP.get(wire, f"What processes count as {word}")


def _buckets(buckets: Mapping[int, int], worth: float) -> tuple[list[tuple[str, float]], float]:
    """Cumulative counts under `BOUNDS`, and the sum of all values, each within the 2 % of our own buckets."""
    histogram = Histogram(buckets)
    values = [(value * worth, count) for value, count in histogram.values()]
    under = [(str(bound), float(sum(count for value, count in values if value <= bound))) for bound in BOUNDS]
    return [*under, ("+Inf", float(histogram.count))], math.fsum(value * count for value, count in values)


class OneScrape(Collector):
    """What `choose_encoder`'s formats take for a registry."""

    def __init__(self, families: Iterable[Metric]) -> None:
        self._families = families

    def collect(self) -> Iterable[Metric]:
        return self._families


class MetricsEndpoint:
    """Answers `/metrics`, in the format that the visitor asks for, with what the owner of the figures makes at its
    next call of `answer`: a visitor's thread only leaves a question and waits. Nobody asks, nothing is made. Probes
    are answered at once. Raises BusError if the port is taken; 0 is any.

    processes  whose health is told; called on visitors' threads
    """

    def __init__(self, port: int, processes: Callable[[], Sequence[Process]], address: str = LOOPBACK) -> None:
        self._waiting: queue.SimpleQueue[Future[list[Metric]]] = queue.SimpleQueue()
        pages = {"/metrics": self._scraped, **health_pages(processes)}
        self._server = Server("metrics port", port, pages, address)
        self.url = f"{self._server.url}/metrics"
        self.close = self._server.close

    def answer(self, make: Callable[[], list[Metric]]) -> None:
        """Answers all who wait. Called by the thread that owns the figures, several times a second."""
        made: list[Metric] | None = None
        while not self._waiting.empty():
            waiting = self._waiting.get()
            made = make() if made is None else made
            waiting.set_result(made)

    def _scraped(self, query: str, headers: Message) -> Reply:
        waiting: Future[list[Metric]] = Future()
        self._waiting.put(waiting)
        try:
            found = waiting.result(_SCRAPE_WAITS_S)
        except TimeoutError:
            return Reply(503, "text/plain", b"the swarm's observer is busy; ask again\n")
        encode, content_type = choose_encoder(headers.get("accept", ""))
        return Reply(200, content_type, encode(OneScrape(found)))
