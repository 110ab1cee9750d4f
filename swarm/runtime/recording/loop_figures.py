"""What the loop of a process writes into its service's counters: an input of the service, as it publishes them."""

from __future__ import annotations

from swarm.runtime.process import LOOP_COUNTS, LOOP_GAUGES, LOOP_HISTOGRAMS
from swarm.runtime.recording.records import LoopFigures
from swarm.runtime.stats import Counters, Histogram


def figures_since(before: Counters, now: Counters) -> LoopFigures | None:
    """What has changed since the last call, which `before` is brought up to; None if nothing has."""
    counts = {
        name: now.counts[name]
        for name in LOOP_COUNTS
        if name in now.counts and now.counts[name] != before.counts.get(name)
    }
    gauges = {
        name: now.gauges[name]
        for name in LOOP_GAUGES
        if name in now.gauges and now.gauges[name] != before.gauges.get(name)
    }
    buckets: dict[str, dict[int, int]] = {}
    for name in LOOP_HISTOGRAMS:
        known, found = before.histograms.setdefault(name, Histogram()).buckets, now.histograms.get(name)
        if found is not None and (new := {at: n for at, n in found.buckets.items() if n != known.get(at)}):
            buckets[name] = new
            known.update(new)
    if not counts and not gauges and not buckets:
        return None
    before.counts.update(counts)
    before.gauges.update(gauges)
    return LoopFigures(counts, gauges, buckets)


def set_figures(counters: Counters, figures: LoopFigures | None) -> None:
    """Write recorded figures into a service's counters."""
    if figures is None:
        return
    counters.counts.update(figures.counts)
    counters.gauges.update(figures.gauges)
    for name, buckets in figures.buckets.items():
        counters.histograms.setdefault(name, Histogram()).buckets.update(buckets)
