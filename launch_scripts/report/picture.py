"""One-page picture of a run: its main figures, the map, and plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from launch_scripts.observe import palette
from launch_scripts.observe.counts import percent
from launch_scripts.observe.facts import count, duration, fact
from launch_scripts.report.map_figure import GroundPicture, draw_map
from launch_scripts.report.run_arrays import RunTracks
from launch_scripts.report.run_plots import PLOTS, draw_plot

WIDTH_IN, HEIGHT_IN, DPI = 12.8, 9.6, 150

_MAP = (0.046, 0.058, 0.552, 0.776)
"""Left, bottom, width and height of the map at most, as shares of the page."""
_BESIDE = ("states", "totals", "gaps", "waiting", "messages", "timings")
"""Plots beside the map; the page of the run has all."""
_COUNTS = ("captures", "marks", "reroute_requests", "routes_served")


def save_picture(path: Path, ground: GroundPicture, tracks: RunTracks, report: dict[str, Any]) -> None:
    """Draw the run and write it as PNG."""
    with mpl.rc_context(palette.STYLE):
        figure = draw(ground, tracks, report)
        canvas = FigureCanvasAgg(figure)
        with path.open("wb") as file:
            canvas.print_png(file, pil_kwargs={"compress_level": 4})  # type: ignore[no-untyped-call]


def draw(ground: GroundPicture, tracks: RunTracks, report: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DPI, facecolor="white")
    _draw_head(figure, report)
    draw_map(figure.add_axes(_MAP), ground, tracks, report)
    left, width, top, bottom, gap = 0.655, 0.297, 0.818, 0.058, 0.052
    height = (top - bottom - gap * (len(_BESIDE) - 1)) / len(_BESIDE)
    plots = [next(plot for plot in PLOTS if plot.name == name) for name in _BESIDE]
    last = max(n for n, plot in enumerate(plots) if plot.over_time)
    for n, plot in enumerate(plots):
        axes = figure.add_axes((left, top - height - n * (height + gap), width, height))
        draw_plot(axes, plot, report)
        if plot.over_time:
            axes.tick_params(axis="x", labelbottom=n == last)
    return figure


def _draw_head(figure: Figure, report: dict[str, Any]) -> None:
    title = f"{report['vehicles']} vehicles chase {report['targets']} targets"
    figure.text(0.033, 0.966, title, fontsize=21, fontweight="bold", va="center")
    figure.text(0.033, 0.936, "   ·   ".join(_facts(report)), fontsize=9, color=palette.FAINT, va="center")
    gap = report["certified_gap"]
    tiles = [
        *((fact(name).label, count(report[name]), palette.INK) for name in _COUNTS),
        ("certified gap, mean", percent(gap["mean"]), palette.INK),
        ("certified gap, p95", percent(gap["p95"]), palette.INK),
        ("growth of a tree, p50", duration(report["growth_ms"]["p50"]), palette.INK),
        ("route query, p99", duration(report["route_query_ms"]["p99"]), palette.INK),
        *(
            (name.replace("_", " "), count(report[name]), palette.RED if report[name] else palette.GREEN)
            for name in ("collisions", "lethal_entries", "lost")
        ),
    ]
    for y in (0.918, 0.853):
        figure.add_artist(Line2D([0.033, 0.967], [y, y], color=palette.RULE, linewidth=1))
    widths = [max(len(label), 1.9 * len(value)) + 3 for label, value, _ in tiles]
    x, unit = 0.033, 0.95 / sum(widths)
    for (label, value, colour), width in zip(tiles, widths, strict=True):
        figure.text(x, 0.896, value, fontsize=14, fontweight="bold", color=colour, va="center")
        figure.text(x, 0.869, label, fontsize=8, color=palette.FAINT, va="center")
        x += unit * width


def _facts(report: dict[str, Any]) -> list[str]:
    seconds, scale = report["seconds"], report["time_scale"]
    facts = [f"scenario {report['scenario']}"]
    if report["run_id"]:
        facts.append(f"run {report['run_id']}")
    facts.append(f"seed {report['seed']}")
    if seconds is not None:
        facts.append(f"{seconds:.0f} s" + (f" at {scale:g} x real motion" if scale != 1 else ""))
    for name, one in (("processes", "process"), ("restarts", "restart")):
        if report[name] is not None:
            facts.append(f"{report[name]} {one if report[name] == 1 else name}")
    if report["startup_s"] is not None:
        facts.append(f"all running after {report['startup_s']:.1f} s")
    return facts
