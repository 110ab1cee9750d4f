"""Plots of a run over time, beside the map."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from launch_scripts.report.pictures.palette import (
    BLUE,
    DARK_GREEN,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    SKY,
    STATE_COLOURS,
    VIOLET,
)
from launch_scripts.report.recorder import Recorder
from launch_scripts.report.samples import Sample, messages_per_s
from swarm.runtime.stats import Histogram


def draw_plots(figure: Figure, recorder: Recorder) -> None:
    samples = recorder.samples.all()
    left, width, height, gap = 0.648, 0.304, 0.107, 0.0556
    axes = [figure.add_axes((left, 0.708 - n * (height + gap), width, height)) for n in range(5)]
    end_s = max((sample.time_s for sample in samples), default=1.0) or 1.0
    _plot_states(axes[0], samples)
    _plot_totals(axes[1], samples, recorder)
    _plot_gaps(axes[2], samples)
    _plot_messages(axes[3], samples)
    _plot_timings(axes[4], recorder)
    for each in axes[:4]:
        each.set_xlim(0, end_s)
        each.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} s" if value else "0"))
        each.tick_params(axis="both", length=0)
        each.tick_params(axis="x", labelbottom=each is axes[3])
        each.yaxis.set_major_locator(MaxNLocator(4, integer=each is not axes[2]))
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)


def _plot_states(axes: Axes, samples: list[Sample]) -> None:
    axes.set_title("Vehicles")
    if not samples:
        _nothing(axes)
        return
    time_s = [sample.time_s for sample in samples]
    order = list(STATE_COLOURS)
    counts = np.array([[sample.states[state] for sample in samples] for state in order])
    axes.stackplot(time_s, counts, colors=[STATE_COLOURS[state] for state in order], linewidth=0)
    axes.set_ylim(0, max(counts.sum(axis=0).max(), 1))
    shown = [state for state, row in zip(order, counts, strict=True) if row.any()]
    _legend_above(axes, [Patch(facecolor=STATE_COLOURS[state], label=state.name.lower()) for state in shown])


def _plot_totals(axes: Axes, samples: list[Sample], recorder: Recorder) -> None:
    axes.set_title("Captures and marks")
    marks = [(sample.time_s, sample.marks) for sample in samples if sample.marks is not None]
    captures = [(sample.time_s, sample.captures) for sample in samples if sample.captures is not None]
    if not marks and not captures:
        _nothing(axes)
        return
    handles = []
    if captures:
        axes.step(*zip(*captures, strict=True), where="post", color=GREEN, linewidth=2.2)
        axes.set_ylim(0, max(max(n for _, n in captures) * 1.08, 1))
        axes.tick_params(axis="y", colors=DARK_GREEN)
        handles.append(Line2D([], [], color=GREEN, linewidth=2.2, label="captures"))
    if marks:
        right = axes.twinx()
        right.plot(*zip(*marks, strict=True), color=VIOLET, linewidth=1.8)
        right.set_ylim(0, max(max(n for _, n in marks) * 1.08, 1))
        right.grid(False)
        right.tick_params(axis="y", colors=VIOLET, length=0)
        right.yaxis.set_major_locator(MaxNLocator(4, integer=True))
        right.yaxis.set_major_formatter(FuncFormatter(_short))
        right.spines[["top", "left", "right"]].set_visible(False)
        handles.append(Line2D([], [], color=VIOLET, linewidth=1.8, label="marks (right)"))
    _legend_above(axes, handles)


def _plot_gaps(axes: Axes, samples: list[Sample]) -> None:
    axes.set_title("Gap to optimum, %")
    series: dict[str, list[tuple[float, float]]] = {}
    for sample in samples:
        for id, gap in sample.gaps.items():
            if np.isfinite(gap):  # of a route without a proven bound it is infinite
                series.setdefault(id, []).append((sample.time_s, (gap - 1) * 100))
    if not series:
        _nothing(axes)
        return
    for points in series.values():
        axes.plot(*zip(*points, strict=True), color=SKY, linewidth=0.7, alpha=0.7)
    at: dict[float, list[float]] = {}
    for points in series.values():
        for when_s, gap in points:
            at.setdefault(when_s, []).append(gap)
    time_s = sorted(at)
    values = [np.array(at[when_s]) for when_s in time_s]
    axes.plot(time_s, [np.percentile(gaps, 95) for gaps in values], color=ORANGE, linewidth=1.4)
    axes.plot(time_s, [gaps.mean() for gaps in values], color=BLUE, linewidth=2.2)
    axes.set_ylim(0, max(float(np.percentile(np.concatenate(values), 99.5)) * 1.1, 0.1))
    lines = (("mean", BLUE, 2.2), ("p95", ORANGE, 1.4), ("each target", SKY, 0.9))
    _legend_above(axes, [Line2D([], [], color=c, linewidth=w, label=label) for label, c, w in lines])


def _plot_messages(axes: Axes, samples: list[Sample]) -> None:
    axes.set_title("Messages per second")
    rates = messages_per_s(samples)
    if not rates:
        _nothing(axes)
        return
    time_s, rate = zip(*rates, strict=True)
    axes.fill_between(time_s, rate, color=SKY, alpha=0.35, linewidth=0)
    axes.plot(time_s, rate, color=BLUE, linewidth=1.8)
    axes.set_ylim(0, max(rate) * 1.12 or 1)
    axes.yaxis.set_major_formatter(FuncFormatter(_short))


_TIMED = (
    ("growth_ms", "tree growth", GREEN),
    ("route_query_ms", "route query", BLUE),
    ("mark_to_tree_ms", "mark to tree", VIOLET),
)


def _plot_timings(axes: Axes, recorder: Recorder) -> None:
    axes.set_title("How long it takes")
    timed = [(label, colour, recorder.observed.histogram(name)) for name, label, colour in _TIMED]
    timed = [(label, colour, histogram) for label, colour, histogram in timed if histogram.count]
    if not timed:
        _nothing(axes)
        return
    axes.set_xscale("log")
    for row, (label, colour, histogram) in enumerate(reversed(timed)):
        values, heights = density(histogram)
        axes.fill_between(values, row, row + 0.8 * heights, color=colour, alpha=0.55, linewidth=0)
        axes.plot(values, row + 0.8 * heights, color=colour, linewidth=1.2)
        p50, p99 = (histogram.quantile(q) or 0.0 for q in (0.5, 0.99))
        axes.plot([p50, p50], [row, row + 0.8], color=INK, linewidth=1.4)
        text = f"{label}  p50 {duration(p50)}, p99 {duration(p99)}"
        axes.text(
            1.0, row + 0.62, text, transform=axes.get_yaxis_transform(), ha="right", va="center", fontsize=8.5,
            color=INK, path_effects=halo(),
        )  # fmt: skip
    low, high = axes.get_xlim()
    axes.set_xlim(low, high * (high / low) ** 1.1)  # room for the labels
    axes.set_ylim(0, len(timed))
    axes.set_yticks([])
    axes.tick_params(axis="x", which="both", length=0)
    axes.xaxis.set_major_locator(LogLocator(numticks=9))
    axes.xaxis.set_major_formatter(
        FuncFormatter(
            lambda value, _: "" if value > high else f"{value:g} ms" if value < 1000 else f"{value / 1000:g} s"
        )
    )
    axes.xaxis.set_minor_formatter(NullFormatter())


def density(histogram: Histogram) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values and heights (largest 1) of a histogram, smoothed over the logarithm of the value."""
    buckets = {bucket: count for bucket, count in histogram.buckets.items() if bucket > -1000}
    if not buckets:
        return np.array([0.001, 0.002]), np.array([1.0, 0.0])
    low, high = min(buckets) - 12, max(buckets) + 12
    counts = np.zeros(high - low + 1)
    for bucket, count in buckets.items():
        counts[bucket - low] = count
    kernel = np.exp(-0.5 * (np.arange(-8, 9) / 3.0) ** 2)
    smooth = np.convolve(counts, kernel, mode="same")
    return np.exp(np.arange(low, high + 1) * math.log(1.04)), smooth / smooth.max()


def _legend_above(axes: Axes, handles: Iterable[Any]) -> None:
    axes.legend(
        handles=list(handles), loc="lower right", bbox_to_anchor=(1.0, 0.985), ncol=6, handlelength=1.0,
        handletextpad=0.4, columnspacing=1.0, borderaxespad=0.2, fontsize=8.5,
    )  # fmt: skip


def _short(value: float, _: object = None) -> str:
    return f"{value / 1000:g}k" if abs(value) >= 1000 else f"{value:g}"


def _nothing(axes: Axes) -> None:
    axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center", color=FAINT)
    axes.set_yticks([])


def duration(milliseconds: float | None) -> str:
    """A number for a person to read."""
    if milliseconds is None:
        return "–"
    return f"{milliseconds:.3g} ms" if milliseconds < 999.5 else f"{milliseconds / 1000:.3g} s"


def halo() -> list[Any]:
    """Outline which keeps text readable on any background."""
    return [withStroke(linewidth=2.6, foreground="white")]
