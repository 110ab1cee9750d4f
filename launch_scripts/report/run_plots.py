"""Plots of a run, drawn from its report: for the picture, the page and comparisons."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from launch_scripts.observe import palette
from launch_scripts.observe.counts import percent
from launch_scripts.observe.facts import duration

Report = Mapping[str, Any]
_SHOWN_PERCENT = 0.005
"""What is smaller is 0.00% wherever gaps are shown."""
_WIDE = 1.7
_HALF = 0.5
_TITLE_PT = 10.5


@dataclass(frozen=True)
class Plot:
    """draw  draws it, from a report, on axes whose title is set; False if the run did not measure it
    over_time  whether its horizontal axis is the run's seconds
    """

    name: str
    title: str
    meaning: str
    draw: Callable[[Axes, Report], bool]
    over_time: bool = True


def draw_plot(axes: Axes, plot: Plot, report: Report, *, titled: bool = True) -> None:
    """Draw one plot and its axes."""
    if titled:
        axes.set_title(plot.title)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="both", length=0)
    if not plot.draw(axes, report):
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center", color=palette.FAINT)
        axes.set_yticks([])
        axes.set_xticks([])
    elif plot.over_time:
        axes.set_xlim(0, max(report["series"]["t_s"], default=1.0) or 1.0)
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} s" if value else "0"))


def told(report: Report, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and values of a series, where there are values."""
    series = report.get("series", {})
    pairs = [(t, v) for t, v in zip(series.get("t_s", []), series.get(name, []), strict=False) if v is not None]
    times, values = np.array(pairs, np.float64).reshape(-1, 2).T
    return times, values


# --- over time --------------------------------------------------------------------------------------------------


def _states(axes: Axes, report: Report) -> bool:
    series = report["series"]
    counts = {state: series.get(state.name.lower()) for state in palette.STATE_COLOURS}
    if not series["t_s"] or None in counts.values():
        return False
    shown = {state: np.array(row) for state, row in counts.items() if any(row)}
    if not shown:  # stopped before any vehicle had told where it is
        return False
    axes.stackplot(
        series["t_s"], *shown.values(), colors=[palette.STATE_COLOURS[state] for state in shown], linewidth=0
    )
    axes.set_ylim(0, max(sum(shown.values(), np.zeros(1)).max(), 1))
    _whole(axes)
    legend_above(axes, [Patch(facecolor=palette.STATE_COLOURS[state], label=state.name.lower()) for state in shown])
    return True


def _line(colour: str, label: str, width: float = _WIDE, dash: Any = "solid") -> Line2D:
    """A line of a plot and of its legend: one look for both."""
    return Line2D([], [], color=colour, linewidth=width, linestyle=dash, label=label)


def _look(line: Line2D) -> dict[str, Any]:
    return {"color": line.get_color(), "linewidth": line.get_linewidth(), "linestyle": line.get_linestyle()}


def _totals(axes: Axes, report: Report) -> bool:
    captures, marks = _line(palette.GREEN, "captures", 2.0), _line(palette.VIOLET, "marks (right)", dash="--")
    right = axes.twinx()
    right.grid(False)
    right.tick_params(axis="y", colors=palette.VIOLET, length=0)
    right.spines[["top", "left", "right"]].set_visible(False)
    shown = []
    for name, line, where in (("captures", captures, axes), ("marks", marks, right)):
        times, values = told(report, name)
        if len(values):
            where.step(times, values, where="post", **_look(line))
            where.set_ylim(0, max(values.max() * 1.08, 1))
            _whole(where)
            shown.append(line)
        elif where is right:
            right.set_axis_off()
    legend_above(axes, shown)
    return bool(shown)


def _gaps(axes: Axes, report: Report) -> bool:
    (time_s, mean), (p95_s, p95) = told(report, "certified_gap_mean"), told(report, "certified_gap_p95")
    if not len(mean):
        return False
    mean, p95 = (np.maximum(values - 1, 0) * 100 for values in (mean, p95))
    whole = report["certified_gap"]
    lines = [
        _line(palette.BLUE, f"mean {percent(whole['mean'])}", 2.0),
        _line(palette.ORANGE, f"p95 {percent(whole['p95'])}", 1.3),
    ]
    dots: dict[str, Any] = {"marker": "o", "markersize": 2.2} if len(mean) < 80 else {}
    axes.fill_between(time_s, mean, p95, color=palette.ORANGE, alpha=0.2, linewidth=0)
    for line, times, values in zip(lines, (time_s, p95_s), (mean, p95), strict=True):
        axes.plot(times, values, clip_on=False, **_look(line), **dots)
    axes.set_ylim(0, max(float(p95.max()) * 1.12, 0.1))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}%"))
    if p95.max() < _SHOWN_PERCENT:
        _say(axes, f"all below {_SHOWN_PERCENT:g}%: as good as optimal")
    legend_above(axes, lines)
    return True


def _courses(axes: Axes, report: Report, **lines: Line2D) -> bool:
    """Series over time, the area below the first one filled."""
    values = {name: told(report, name) for name in lines}
    times, first = next(iter(values.values()))
    if not len(first):
        return False
    axes.fill_between(times, first, color=next(iter(lines.values())).get_color(), alpha=0.3, linewidth=0)
    for name, line in lines.items():
        axes.plot(*values[name], **_look(line))
    axes.set_ylim(0, max(max(row.max(initial=0) for _, row in values.values()) * 1.12, 1e-3))
    _whole(axes)
    if len(lines) > 1:
        legend_above(axes, lines.values())
    return True


def _waiting(axes: Axes, report: Report) -> bool:
    waiting, standing = _line(palette.ORANGE, "for a route"), _line(palette.BLUE, "with a route", 1.4, "--")
    measured = _courses(axes, report, waiting_at_once=waiting, standing_at_once=standing)
    if measured and axes.get_ylim()[1] < 0.1:
        axes.set_ylim(0, 1)
        _say(axes, "nobody waited")
    return measured


def _growing(axes: Axes, report: Report) -> bool:
    measured = _courses(axes, report, growth_ms_mean=_line(palette.GREEN, "growth"))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _tick_ms(value) if value else "0"))
    return measured


def _messages(axes: Axes, report: Report) -> bool:
    return _courses(axes, report, messages_per_s=_line(palette.BLUE, "messages"))


# --- of all -----------------------------------------------------------------------------------------------------


def _shares(axes: Axes, report: Report) -> bool:
    """Share of the routes that are proven to be within so much of the optimum."""
    excess = np.array(report.get("distributions", {}).get("followed_gap_excess", []), np.float64).reshape(-1, 2)
    unproven = report["certified_gap"].get("unproven") or 0
    routes = excess[:, 1].sum() + unproven
    if not routes:
        return False
    least, most = 0.01, 100.0
    above = np.clip(100 * excess[:, 0], least, None)
    edges = np.concatenate([[least], above, [above.max(initial=most)]])
    below = np.concatenate([[0.0], np.cumsum(excess[:, 1]), [excess[:, 1].sum()]]) / routes * 100
    below[edges <= least] = below[edges <= least][-1]
    axes.set_xscale("log")
    axes.fill_between(edges, below, step="post", color=palette.BLUE, alpha=0.2, linewidth=0)
    axes.step(edges, below, where="post", color=palette.BLUE, linewidth=2.0)
    axes.set_xlim(least, edges[-1])
    axes.set_ylim(0, 105)
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}%"))
    axes.xaxis.set_major_locator(LogLocator(numticks=6))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}%"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    legend_above(axes, [_line(palette.BLUE, f"of {routes:,.0f} routes", 2.0)])
    return True


TIMED = (
    ("growth_ms", "tree growth", palette.GREEN),
    ("route_query_ms", "route query", palette.BLUE),
    ("mark_to_tree_ms", "mark to tree", palette.VIOLET),
)


def _timings(axes: Axes, report: Report) -> bool:
    distributions = report.get("distributions", {})
    timed = [(label, colour, distributions.get(name), report[name]) for name, label, colour in TIMED]
    timed = [row for row in timed if row[2]]
    if not timed:
        return False
    axes.set_xscale("log")
    for row, (label, colour, counts, quantiles) in enumerate(reversed(timed)):
        values, heights = density(counts)
        axes.fill_between(values, row, row + _HALF * heights, color=colour, alpha=0.55, linewidth=0)
        axes.plot(values, row + _HALF * heights, color=colour, linewidth=1.2)
        p50 = quantiles["p50"] or values[0]
        axes.plot([p50, p50], [row, row + _HALF], color=palette.INK, linewidth=1.4)
        text = f"{label}: p50 {duration(quantiles['p50'])}, p99 {duration(quantiles['p99'])}"
        axes.text(
            0.995, row + 0.76, text, transform=axes.get_yaxis_transform(), ha="right", va="center", fontsize=8.5,
            color=palette.INK, path_effects=halo(),
        )  # fmt: skip
    axes.set_ylim(0, len(timed))
    axes.set_yticks([])
    axes.tick_params(axis="x", which="both", length=0)
    axes.xaxis.set_major_locator(LogLocator(numticks=7))
    axes.xaxis.set_major_formatter(FuncFormatter(_tick_ms))
    axes.xaxis.set_minor_formatter(NullFormatter())
    return True


def density(counts: Sequence[Sequence[float]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values and heights (largest 1) of [value, count] pairs, smoothed over the logarithm of the value."""
    some = np.array([pair for pair in counts if pair[0] > 1e-9], np.float64).reshape(-1, 2)
    if not len(some):
        return np.array([0.001, 0.002]), np.array([1.0, 0.0])
    buckets = np.rint(np.log(some[:, 0]) / _BUCKET).astype(int)
    low = buckets.min() - 12
    heights = np.zeros(buckets.max() + 13 - low)
    np.add.at(heights, buckets - low, some[:, 1])
    smooth = np.convolve(heights, np.exp(-0.5 * (np.arange(-8, 9) / 3.0) ** 2), mode="same")
    return np.exp((low + np.arange(len(heights))) * _BUCKET), smooth / smooth.max()


_BUCKET = math.log(1.04)

PLOTS = (
    Plot("states", "Vehicles", "What the vehicles were doing.", _states),
    Plot("totals", "Captures and marks",
         "Captures of all targets, and what vehicles found that the map did not know.", _totals),
    Plot("gaps", "Certified gap",
         "How far above the optimum the routes that vehicles began can be at most: each comes with a proven lower "
         "bound.", _gaps),
    Plot("waiting", "Waiting",
         "How many vehicles waited at the same time: for a route, or with one, as where others pass.", _waiting),
    Plot("growing", "Growing a tree", "Time of the last growth of a tree, mean over targets.", _growing),
    Plot("messages", "Messages per second", "Of all processes together.", _messages),
    Plot("shares", "Routes within a gap",
         "Share of the routes that are proven to be at most so far above the optimum.", _shares, over_time=False),
    Plot("timings", "How long it takes",
         "Distributions on a logarithmic scale; the line is the median.", _timings, over_time=False),
)  # fmt: skip
"""All plots, in the order in which they are shown."""


def legend_above(axes: Axes, handles: Iterable[Any]) -> None:
    """A legend beside the title, in letters so small that both have room."""
    entries = list(handles)
    ems = sum(0.52 * len(entry.get_label()) + 2.6 for entry in entries)
    figure = axes.get_figure(root=True)
    assert figure is not None
    wide_pt = axes.get_position().width * figure.get_figwidth() * 72
    room_pt = wide_pt - 0.62 * _TITLE_PT * len(axes.get_title("left")) - _TITLE_PT
    axes.legend(
        handles=entries, loc="lower right", bbox_to_anchor=(1.0, 0.985), ncol=6, handlelength=1.2,
        handletextpad=0.4, columnspacing=1.0, borderaxespad=0.2, fontsize=min(8.5, room_pt / max(ems, 1.0)),
    )  # fmt: skip


def _whole(axes: Axes) -> None:
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda n, _: f"{n / 1000:g}k" if abs(n) >= 1000 else f"{n:g}"))


def _say(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=palette.FAINT, fontsize=9)


def _tick_ms(value: float, _: object = None) -> str:
    return f"{value:g} ms" if value < 1000 else f"{value / 1000:g} s"


def halo() -> list[Any]:
    """Outline which keeps text readable on any background."""
    return [withStroke(linewidth=2.6, foreground="white")]


# --- of a study ---------------------------------------------------------------------------------------------------


def draw_outcome(cases: Sequence[Any], outcome: str) -> bytes:
    """A picture (PNG) of an outcome of a study: every seed a dot, and the mean of each case with its interval.

    cases  each a `CaseSummary`, a row from the top in the order of the study
    """
    several = len({case.scenario for case in cases}) > 1
    labels = [f"{case.scenario}: {case.label}" if several else case.label for case in cases]
    chance = np.random.default_rng(0)
    with mpl.rc_context({**palette.STYLE, "text.parse_math": False}):  # names may hold a $
        figure = Figure(figsize=(8.0, 1.3 + 0.42 * len(cases)), dpi=110, facecolor="white", layout="constrained")
        axes = figure.subplots()
        for row, case in enumerate(cases):
            found = case.outcomes[outcome]
            values = np.array(list(found.values.values()))
            if not len(values):
                continue
            heights = row + chance.uniform(-0.28, 0.28, len(values))
            faint = max(0.08, min(0.5, 20 / len(values)))
            axes.plot(values, heights, ".", color=palette.BLUE, ms=5, alpha=faint, mew=0)
            mean, look = found.mean, dict[str, Any](color=palette.ORANGE)
            if mean is not None:
                axes.plot(mean.value, row, "D", ms=6, mec="white", mew=0.8, zorder=3, **look)
                if mean.low is not None and mean.high is not None:
                    axes.plot([mean.low, mean.high], [row, row], "-", lw=2.5, zorder=2, **look)
        axes.set_yticks(range(len(cases)), labels)
        axes.set_ylim(len(cases) - 0.5, -0.5)
        axes.grid(visible=False, axis="y")
        axes.set_title(outcome)
        axes.set_xlabel(
            "a dot is a seed; the diamond is their mean, the bar its 95 % interval", color=palette.FAINT
        )
        content = io.BytesIO()
        FigureCanvasAgg(figure).print_png(content)  # type: ignore[no-untyped-call]
    return content.getvalue()
