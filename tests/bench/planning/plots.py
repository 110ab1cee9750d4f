"""Plots of benchmarks, in the style of the report's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from bench.planning.chase import Tally
from bench.tables import label_of, on_machine
from launch_scripts.observe.palette import BLUE, FAINT, INK, ORANGE, PINK, SKY, STYLE, VIOLET
from launch_scripts.report.plots import halo
from swarm.config.values import Strategy

_COLOURS: dict[Strategy, str] = {
    "full": INK,
    "exact": VIOLET,
    "auto": BLUE,
    "variable_range": ORANGE,
    "multi_resolution": SKY,
    "variable_range+multi_resolution": PINK,
}
DPI = 150
EXACT_PERCENT = 0.01
"""Smaller gaps are drawn here: a logarithmic axis has no zero."""


def save_scale(report: dict[str, Any], path: Path) -> None:
    """Milliseconds above, gap below; over cells, targets and vehicles, each with the other two at the base."""
    base = report["base"]
    axes_of = {
        "size": ("cells a side", f"{base['targets']} targets, {base['vehicles']:,} vehicles"),
        "targets": ("targets", f"{base['size']} x {base['size']} cells, {base['vehicles']:,} vehicles"),
        "vehicles": ("vehicles", f"{base['size']} x {base['size']} cells, {base['targets']} targets"),
    }
    rows: list[dict[str, Any]] = report["rows"]
    shown = {
        name: [row for row in rows if all(row[other] == base[other] for other in base if other != name)]
        for name in axes_of
    }
    shown = {name: found for name, found in shown.items() if len({row[name] for row in found}) > 1} or {
        "size": shown["size"]
    }
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.4 * len(shown) + 1.0, 8.4), dpi=DPI, facecolor="white")
        grid = figure.subplots(2, len(shown), squeeze=False, sharey="row")
        for column, (name, found) in enumerate(shown.items()):
            words, fixed = axes_of[name]
            above, below = grid[0][column], grid[1][column]
            last = column == len(shown) - 1
            _lines(above, found, name, "frame_ms_mean", last)
            _lines(below, found, name, "gap_p95", last)
            above.set_title(fixed)
            below.set_xlabel(words)
        grid[0][0].set_ylabel("CPU ms a frame, all targets")
        grid[1][0].set_ylabel("% above the optimum that 95 % of routes keep")
        for each in grid[0]:
            low, high = each.get_ylim()
            steps = (1.0, 2.0, 5.0) if high / low < 100 else (1.0,)
            each.yaxis.set_major_locator(LogLocator(subs=steps, numticks=12))
            each.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
        for each in grid[1]:
            _gap_axis(each.yaxis)
            each.set_ylim(bottom=EXACT_PERCENT * 0.8)
        _head(
            figure,
            "What keeping up costs, and how far from optimal it drives",
            f"{report['field']}, every target moves a cell a frame. {on_machine(report)}",
        )
        figure.subplots_adjust(left=0.075, right=0.885, top=0.865, bottom=0.07, hspace=0.16, wspace=0.08)
        _save(figure, path)


def save_gap(report: dict[str, Any], tallies: Mapping[Any, Mapping[Strategy, Tally]], path: Path) -> None:
    """A row per walk. Left: how many routes are worse than so much; right: the gap over the frames of the runs."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.8, 1.0 + 3.7 * len(tallies)), dpi=DPI, facecolor="white")
        grid = figure.subplots(len(tallies), 2, squeeze=False)
        for (left, right), (walk, found) in zip(grid, tallies.items(), strict=True):
            _shares(left, found)
            _over_time(right, found, report["frames"])
            left.set_title(f"Target: {walk}")
            left.set_xlabel("above the optimum")
            left.set_ylabel("of routes are worse")
            right.set_title("Above the optimum: what 95 % of a frame's routes keep")
        _head(
            figure,
            f"How far from optimal: {report['dem']}",
            f"{report['shape'][0]} x {report['shape'][1]} cells, {report['runs']} runs of {report['frames']}"
            f" frames, {report['vehicles']} routes in each. {on_machine(report)}",
        )
        foot = 0.55 / figure.get_figheight()
        figure.subplots_adjust(
            left=0.06, right=0.88, top=1 - 1.15 / figure.get_figheight(), bottom=foot, hspace=0.32, wspace=0.14
        )
        _save(figure, path)


def _colour_of(strategy: Strategy) -> str:
    return _COLOURS.get(strategy, VIOLET)


def _lines(axes: Axes, rows: Sequence[dict[str, Any]], name: str, key: str, label: bool) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    gaps = key.startswith("gap")
    ends: list[tuple[float, Strategy]] = []
    for strategy in dict.fromkeys(row["strategy"] for row in rows):
        points = sorted((row[name], row[key]) for row in rows if row["strategy"] == strategy and row[key])
        if not points:
            continue
        along, values = np.array(points, np.float64).T
        if gaps:
            values = np.maximum(100 * (values - 1), EXACT_PERCENT)
        axes.plot(
            along, values, "o-", color=_colour_of(strategy), linewidth=2, markersize=5, markeredgecolor="white"
        )
        ends.append((float(values[-1]), strategy))
    numbers = sorted({row[name] for row in rows})
    axes.set_xticks(numbers, [f"{value:,}" for value in numbers])
    axes.xaxis.set_minor_locator(NullLocator())
    _plain(axes)
    if label:
        _label_ends(axes, max(numbers), ends)


def _shares(axes: Axes, tallies: Mapping[Strategy, Tally]) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    handles = []
    for strategy, tally in tallies.items():
        above = np.sort(100 * (np.concatenate(tally.gaps) - 1))
        share = 100 * (1 - np.arange(above.size) / above.size)
        drawn = above >= EXACT_PERCENT
        axes.plot(above[drawn], share[drawn], color=_colour_of(strategy), linewidth=2)
        label = label_of(strategy) if drawn.any() else f"{label_of(strategy)}: exact"
        handles.append(Line2D([], [], color=_colour_of(strategy), linewidth=2, label=label))
    axes.set_ylim(0.01, 100)
    axes.set_xlim(left=EXACT_PERCENT)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} %"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} %"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    _plain(axes)
    axes.legend(
        handles=handles,
        loc="lower left",
        handlelength=1.2,
    )


def _over_time(axes: Axes, tallies: Mapping[Strategy, Tally], frames: int) -> None:
    axes.set_yscale("log")
    ends: list[tuple[float, Strategy]] = []
    for strategy, tally in tallies.items():
        each = [100 * (np.quantile(gaps, 0.95) - 1) if gaps.size else 0.0 for gaps in tally.gaps]
        runs = np.array(each).reshape(-1, frames)
        middle = np.maximum(np.median(runs, axis=0), EXACT_PERCENT)
        axes.plot(np.arange(1, frames + 1), middle, color=_colour_of(strategy), linewidth=1.6)
        ends.append((float(middle[-1]), strategy))
    axes.set_xlim(1, max(2, frames))
    axes.set_ylim(bottom=EXACT_PERCENT * 0.8)
    _gap_axis(axes.yaxis)
    axes.set_xlabel("frames, a move each")
    _plain(axes)
    _label_ends(axes, max(2, frames), ends)


def _gap_axis(axis: Any) -> None:
    axis.set_major_locator(LogLocator(numticks=9))
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: "exact" if value <= EXACT_PERCENT * 1.01 else f"{value:g} %")
    )
    axis.set_minor_formatter(NullFormatter())


def _label_ends(axes: Axes, at: float, ends: Sequence[tuple[float, Strategy]]) -> None:
    """Labels beside the ends of the lines, in their colours, pushed apart where they would overlap."""
    axes.figure.canvas.draw()
    low, high = axes.get_ylim()
    span = np.log(high / low)
    heights: list[float] = []
    for value, strategy in sorted(ends, key=lambda end: end[0]):
        height = float(np.log(value / low) / span)
        heights.append(max(height, heights[-1] + 0.055) if heights else max(height, 0.02))
        axes.annotate(
            label_of(strategy),
            (at, value),
            xytext=(1.03, heights[-1]),
            textcoords="axes fraction",
            color=_colour_of(strategy),
            fontsize=9,
            fontweight="bold",
            va="center",
            path_effects=halo(),
            annotation_clip=False,
        )


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(which="both", length=0)
    axes.yaxis.set_minor_formatter(NullFormatter())


def _head(figure: Figure, title: str, below: str) -> None:
    high = figure.get_figheight()
    figure.text(0.022, 1 - 0.36 / high, title, fontsize=15, fontweight="bold", va="center")
    figure.text(0.022, 1 - 0.66 / high, below, fontsize=9, color=FAINT, va="center")


def _save(figure: Figure, path: Path) -> None:
    canvas = FigureCanvasAgg(figure)
    with path.open("wb") as file:
        canvas.print_png(file)  # type: ignore[no-untyped-call]
