"""The certified gap: how far above the optimum the routes that vehicles began can be at most. Pure.

The one place that makes it from what agents count, for the live table, the report, the view and `swarm status`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from launch_scripts.observe.counts import Counts
from swarm.runtime.stats import GAPS_OF, GAPS_TO, UNPROVEN_OF, UNPROVEN_TO, Histogram


@dataclass(frozen=True, slots=True)
class CertifiedGap:
    """Cost over proven lower bound of some routes: 1.05 is proven to be at most 5 % above the optimum.

    routes    that vehicles began
    unproven  of these, routes without a lower bound; they are in no mean
    """

    mean: float | None = None
    p95: float | None = None
    max: float | None = None
    routes: int = 0
    unproven: int = 0

    def fields(self) -> dict[str, float | None]:
        """For a report."""
        return {"mean": self.mean, "p95": self.p95, "max": self.max, "unproven": self.unproven}

    def __str__(self) -> str:
        return gap_text(self.fields())


def gap_text(fields: Mapping[str, float | None]) -> str:
    """The fields of a `CertifiedGap` for people."""
    unproven = f"{fields['unproven']:g} unproven" if fields.get("unproven") else ""
    if fields.get("mean") is None:
        return unproven or "-"
    proven = ", ".join(f"{name} {percent(fields[name])}" for name in ("mean", "p95", "max"))
    return f"{proven}, {unproven}" if unproven else proven


def certified_gap(counted: Counts) -> CertifiedGap:
    """Of all routes of a run."""
    return gap_of(counted.histogram("followed_gap_excess"), counted.total("followed_unproven") or 0)


def gaps_to(counted: Counts) -> dict[str, CertifiedGap]:
    """Per target, of the routes to it."""
    return _gaps(counted.histograms_by(GAPS_TO), counted.counts_by(UNPROVEN_TO))


def gaps_of(counted: Counts) -> dict[str, CertifiedGap]:
    """Per vehicle, of the routes that it began."""
    return _gaps(counted.histograms_by(GAPS_OF), counted.counts_by(UNPROVEN_OF))


def _gaps(proven: Mapping[str, Histogram], unproven: Mapping[str, int]) -> dict[str, CertifiedGap]:
    ids = sorted({*proven, *unproven})
    return {id: gap_of(proven.get(id, Histogram()), unproven.get(id, 0)) for id in ids}


def gap_of(excess: Histogram, unproven: int) -> CertifiedGap:
    """From a histogram of gap - 1."""
    proven = of_excess(excess)
    return CertifiedGap(proven["mean"], proven["p95"], proven["max"], excess.count + unproven, unproven)


def of_excess(histogram: Histogram) -> dict[str, float | None]:
    """Gaps from a histogram of gap - 1."""
    values = {"mean": histogram.mean(), "p95": histogram.quantile(0.95), "max": histogram.quantile(1.0)}
    return {name: None if value is None else 1.0 + value for name, value in values.items()}


def percent(gap: float | None) -> str:
    """How far a gap is above 1, for people: all of them see percentages."""
    return "-" if gap is None else f"{max(gap - 1, 0):.2%}"
