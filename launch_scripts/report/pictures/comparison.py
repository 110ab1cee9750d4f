"""Plots of several runs: their course laid over each other, their figures as bars."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from launch_scripts.observe.certified_gap import percent
from launch_scripts.observe.facts import count, duration
from launch_scripts.observe.files import replacing
from launch_scripts.observe.palette import BLACK, BLUE, FAINT, GREEN, ORANGE, PINK, SKY
from launch_scripts.observe.plot_style import STYLE
from launch_scripts.report.pictures.plots import compact, show_percent, told
from launch_scripts.report.results.compare import LeftRun, remarks

_COLOURS = (BLUE, ORANGE, GREEN, PINK, SKY, BLACK)
_DASHES: tuple[Any, ...] = ("solid", (0, (5, 1.5)), (0, (1.5, 1.2)))
_COLUMNS, _DPI = 3, 130
Values = NDArray[np.float64]


@dataclass(frozen=True)
class ComparedPlot:
    title: str
    meaning: str
    draw: Callable[[Axes], None]


def line_of(n: int) -> dict[str, Any]:
    """How the n-th run is drawn: colours first, then dashes, so that all differ without colours, too."""
    return {"color": _COLOURS[n % len(_COLOURS)], "linestyle": _DASHES[n % len(_DASHES)], "linewidth": 1.8}


def compared_plots(runs: Sequence[LeftRun]) -> list[ComparedPlot]:
    """Courses first, then figures; what no run has measured is left out."""
    courses = [
        ComparedPlot(title, meaning, partial(_draw_course, runs=runs, name=name, of=of, as_gap=of is _in_percent))
        for name, title, meaning, of in _COURSES
        if any(len(told(run.report, name)[1]) for run in runs)
    ]
    measured = [
        ([_number(of, run.report) for run in runs], title, meaning, text) for title, meaning, of, text in _FIGURES
    ]
    bars = [
        ComparedPlot(title, meaning, partial(_draw_bars, values=values, text=text))
        for values, title, meaning, text in measured
        if any(value is not None for value in values)
    ]
    return [*courses, *bars]


def save_comparison(path: Path, runs: Sequence[LeftRun]) -> None:
    """All plots in one picture. Raises OSError."""
    plots = compared_plots(runs)
    rows = max(1, -(-len(plots) // _COLUMNS))
    head_in = 0.6 + 0.2 * max(len(runs), len(remarks(runs)) - 1)
    height_in = head_in + 1.95 * rows
    with mpl.rc_context(STYLE), replacing(path) as half:
        figure = Figure(figsize=(12.8, height_in), dpi=_DPI, facecolor="white")
        figure.text(0.03, 1 - 0.3 / height_in, "Runs compared", fontsize=17, fontweight="bold", va="center")
        handles = [Line2D([], [], **line_of(n), label=name_of(run)) for n, run in enumerate(runs)]
        figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.022, 1 - 0.48 / height_in), fontsize=9)
        for n, sentence in enumerate(remarks(runs)):
            figure.text(0.38, 1 - (0.3 + 0.2 * n) / height_in, sentence, fontsize=9, color=FAINT, va="center")
        for n, plot in enumerate(plots):
            row, col = divmod(n, _COLUMNS)
            bottom = 1 - (head_in + 1.95 * row + 1.65) / height_in
            axes = figure.add_axes((0.052 + 0.327 * col, bottom, 0.265, 1.22 / height_in))
            axes.set_title(plot.title)
            plot.draw(axes)
        canvas = FigureCanvasAgg(figure)
        with half.open("wb") as file:
            canvas.print_png(file)  # type: ignore[no-untyped-call]


def name_of(run: LeftRun) -> str:
    """A run for people: its name, scenario and seed."""
    return f"{run.name}: {run.report.get('scenario')}, seed {run.report.get('seed')}"


def _in_percent(values: Values) -> Values:
    return np.maximum(values - 1, 0) * 100


def _as_is(values: Values) -> Values:
    return values


_COURSES: tuple[tuple[str, str, str, Callable[[Values], Values]], ...] = (
    ("captures", "Captures", "Of all targets, so far.", _as_is),
    ("certified_gap_mean", "Certified gap, mean", "Of the routes that vehicles began, over time.", _in_percent),
    ("waiting_at_once", "Waiting for a route", "Vehicles at the same time.", _as_is),
    ("marks", "Marks", "Cells found other than the map said, so far.", _as_is),
    ("growth_ms_mean", "Growing a tree, ms", "The last growth, mean over targets.", _as_is),
    ("messages_per_s", "Messages per second", "Of all processes.", _as_is),
)


def _draw_course(
    axes: Axes, runs: Sequence[LeftRun], name: str, of: Callable[[Values], Values], as_gap: bool
) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="both", length=0)
    most = end_s = 0.0
    for n, run in enumerate(runs):
        time_s, values = told(run.report, name)
        if len(values):
            values = of(values)
            axes.plot(time_s, values, **line_of(n), clip_on=False)
            most = max(most, float(values.max()))
        end_s = max([end_s, *run.report.get("series", {}).get("t_s", [])])
    axes.set_xlim(0, end_s or 1)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} s" if value else "0"))
    if as_gap:
        show_percent(axes, most)
    else:
        axes.set_ylim(0, most * 1.1 or 1)
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.yaxis.set_major_formatter(FuncFormatter(compact))


Getter = Callable[[Mapping[str, Any]], Any]


def _groups(name: str) -> Getter:
    return lambda report: sum(row[name] for row in report["by_group"].values())


_FIGURES: tuple[tuple[str, str, Getter, Callable[[float], str]], ...] = (
    ("Captures", "In all.", lambda r: r["captures"], count),
    ("Certified gap, mean", "Of all routes that vehicles began.", lambda r: r["certified_gap"]["mean"] - 1,
     lambda v: percent(1 + v)),
    ("Certified gap, p95", "95 of 100 routes are proven to be better.", lambda r: r["certified_gap"]["p95"] - 1,
     lambda v: percent(1 + v)),
    ("Collisions and lethal entries", "Must be 0.", lambda r: r["collisions"] + r["lethal_entries"], count),
    ("Driven by all, km", "On the map.", lambda r: _groups("distance_m")(r) / 1000, lambda v: f"{v:,.1f}"),
    ("Waited for routes, s", "All vehicles together.", _groups("waiting_s"), count),
    ("Stood with a route, s", "All vehicles together.", _groups("standing_s"), count),
    ("Routes served", "By all planners.", lambda r: r["routes_served"], count),
    ("Re-route requests", "By all vehicles.", lambda r: r["reroute_requests"], count),
    ("Growing a tree, p50", "All cheapest paths to one target.", lambda r: r["growth_ms"]["p50"], duration),
    ("Asking for a route, p99", "From question to answer.", lambda r: r["route_query_ms"]["p99"], duration),
    ("From mark to tree, p50", "From a sensor to a tree.", lambda r: r["mark_to_tree_ms"]["p50"], duration),
)  # fmt: skip


def _number(of: Getter, report: Mapping[str, Any]) -> float | None:
    """None of what is not there, or is no number: reports are files, and may be of another version."""
    try:
        value = of(report)
    except (KeyError, TypeError, AttributeError):
        return None
    usable = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if usable else None


def _draw_bars(axes: Axes, values: Sequence[float | None], text: Callable[[float], str]) -> None:
    axes.spines[["top", "right", "bottom"]].set_visible(False)
    axes.grid(False)
    axes.set_xticks([])
    axes.set_yticks([])
    most = max((value for value in values if value is not None), default=0.0) or 1.0
    for n, value in enumerate(values):
        style = line_of(n)
        if value is None:
            axes.text(0.01 * most, n, "not measured", va="center", fontsize=8.5, color=FAINT)
            continue
        axes.barh(n, max(value, 0), 0.62, color=style["color"], alpha=0.85, linewidth=0)
        axes.text(max(value, 0) + 0.02 * most, n, text(value), va="center", fontsize=8.5)
    axes.set_xlim(0, most * 1.3)
    axes.set_ylim(max(len(values), 2) - 0.4, -0.6)
