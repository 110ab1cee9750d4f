"""Metrics of a swarm for Prometheus: made into metric families of OpenMetrics, and served.

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
from prometheus_client.metrics_core import CounterMetricFamily as Counter
from prometheus_client.metrics_core import GaugeMetricFamily as Gauge
from prometheus_client.metrics_core import HistogramMetricFamily as HistogramOf
from prometheus_client.metrics_core import InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from launch_scripts.observe.summed_counts import Counts
from launch_scripts.web import LOOPBACK, Reply
from launch_scripts.web.health_pages import Process, health_pages
from launch_scripts.web.http_server import Server
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
    "vehicles_": ("vehicles", "state"),
    THROTTLED: ("author_throttled", "author"),
    LEARNED: ("learned_pace_ratio", "ground"),
}
"""Beginning of our gauges' names -> their family, and the label that holds the rest of the name."""
_SCRAPE_WAITS_S = 5.0
"""Prometheus gives up after 10 s."""


class Run(NamedTuple):
    """The run which the figures are of."""

    run_id: str
    scenario: str
    started_ns: int


class Families(Collector):
    """Metric families by name, which encoders collect. The first to add a name owns it: counters of processes have
    names from the network, and none of them replaces one of ours."""

    def __init__(self) -> None:
        self.made: dict[str, tuple[str, Any]] = {}

    def collect(self) -> list[Metric]:
        """All families, each once, in order of name."""
        return [family for _, (_, family) in sorted(self.made.items(), key=lambda item: item[0])]

    def add(
        self, kind: Any, name: str, labels: Mapping[str, str], *value: object, text: str = "", of: str = ""
    ) -> None:
        """Adds a sample.

        value  as `kind.add_metric` takes it
        text   the help; of families of ours that of the table
        of     the name on the wire; empty for families of ours
        """
        text = text or _TABLES["families"][name]
        first = (of, kind(f"swarm_{name}", text, labels=tuple(labels)))
        owner, family = self.made.setdefault(name, first)
        if owner == of and type(family) is kind:
            family.add_metric(tuple(labels.values()), *value)


def families(
    run: Run | RunInfo | None, counts: Counts, status: Mapping[str, PlannerStatus], up: Collection[tuple[str, str]]
) -> Families:
    """All metric families of what an observer knows.

    run  None where it knows a part of the run only
    up   (role, id) of the processes that are alive
    """
    made = Families()
    if run is not None:
        made.add(InfoMetricFamily, "run", {}, {"run_id": run.run_id, "scenario": run.scenario})
        made.add(Gauge, "run_start_time_seconds", {}, run.started_ns / NS_PER_S)
    _add_targets(made, counts, status)
    _add_processes(made, counts, up)
    return made


def _add_targets(made: Families, counts: Counts, status: Mapping[str, PlannerStatus]) -> None:
    for target, count in counts.counts_by(CAPTURES_OF).items():
        made.add(Counter, "target_captures", {"target": target}, count)
    for target, gaps in counts.histograms_by(GAPS_TO).items():
        made.add(HistogramOf, "target_certified_gap_ratio", {"target": target}, *_buckets(gaps.buckets, 1.0))
    for target, state in sorted(status.items()):
        for name, value in {
            "vehicles_following": state.following,
            "tree_age_seconds": state.tree_age_ms * 1e-3,
            "pose_age_seconds": state.pose_age_s,
            "lost": float(state.tracker_lost),
        }.items():
            if value is not None:
                made.add(Gauge, f"target_{name}", {"target": target}, value)


def _add_processes(made: Families, counts: Counts, up: Collection[tuple[str, str]]) -> None:
    newest = {key: ({"role": key[0], "id": key[1]}, stats) for key, stats in counts.newest().items()}
    for role, id in sorted({*up, *newest}):
        made.add(Gauge, "process_up", {"role": role, "id": id}, float((role, id) in up))
    for process, stats in newest.values():
        made.add(Gauge, "process_start_time_seconds", process, stats.incarnation / NS_PER_S)
        made.add(Gauge, "process_reported_timestamp_seconds", process, stats.stamp_ns / NS_PER_S)
    for kind, field in ((Counter, "counts"), (Gauge, "gauges"), (HistogramOf, "histograms")):
        samples = [(process, getattr(stats, field)) for process, stats in newest.values()]
        for wire in sorted({name for _, values in samples for name in values}):
            _add_counted(made, kind, wire, [(each, values[wire]) for each, values in samples if wire in values])


def _add_counted(made: Families, kind: Any, wire: str, samples: Iterable[tuple[dict[str, str], Any]]) -> None:
    """Adds what processes count under one name, which may be any text."""
    name, worth, text = named(wire)
    split = next((start for start in _SPLIT if kind is Gauge and wire.startswith(start)), None)
    for process, value in samples:
        if split is not None:
            family, label = _SPLIT[split]
            made.add(kind, family, {**process, label: wire.removeprefix(split)}, value, of=split)
        elif kind is HistogramOf:
            made.add(kind, name, process, *_buckets(value, worth), text=text, of=wire)
        else:
            made.add(kind, name, process, value * worth, text=text, of=wire)


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
    return f"{word}{ending}", worth, HELP.get(wire, f"Sum over processes of {word}")


def _buckets(buckets: Mapping[int, int], worth: float) -> tuple[list[tuple[str, float]], float]:
    """Cumulative counts under `BOUNDS`, and the sum of all values, each within the 2 % of our own buckets."""
    histogram = Histogram(buckets)
    values = [(value * worth, count) for value, count in histogram.values()]
    under = [(str(bound), float(sum(count for value, count in values if value <= bound))) for bound in BOUNDS]
    return [*under, ("+Inf", float(histogram.count))], math.fsum(value * count for value, count in values)


class MetricsEndpoint:
    """Answers `/metrics`, in the format that the visitor asks for, with what the owner of the figures makes at its
    next call of `answer`: a visitor's thread only leaves a question and waits. Without a scrape, nothing is made.
    Probes are answered at once. Raises BusError if the port is taken; 0 is any.

    processes  whose health is reported; called on visitors' threads
    """

    def __init__(self, port: int, processes: Callable[[], Sequence[Process]], address: str = LOOPBACK) -> None:
        self._waiting: queue.SimpleQueue[Future[Families]] = queue.SimpleQueue()
        pages = {"/metrics": self._scraped, **health_pages(processes)}
        self._server = Server("metrics port", port, pages, address)
        self.url = f"{self._server.url}/metrics"
        self.close = self._server.close

    def answer(self, make: Callable[[], Families]) -> None:
        """Answers all who wait. Called by the thread that owns the figures, several times a second."""
        made: Families | None = None
        while not self._waiting.empty():
            waiting = self._waiting.get()
            made = make() if made is None else made
            waiting.set_result(made)

    def _scraped(self, query: str, headers: Message) -> Reply:
        waiting: Future[Families] = Future()
        self._waiting.put(waiting)
        try:
            found = waiting.result(_SCRAPE_WAITS_S)
        except TimeoutError:
            return Reply(503, "text/plain", b"the swarm's observer is busy; ask again\n")
        encode, content_type = choose_encoder(headers.get("accept", ""))
        return Reply(200, content_type, encode(found))
