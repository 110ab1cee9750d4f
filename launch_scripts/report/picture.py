"""One-page picture of a run: its main figures, the map, and plots."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from launch_scripts.observe import palette
from launch_scripts.observe.counts import percent
from launch_scripts.observe.facts import count, duration, fact
from launch_scripts.report.map_figure import GroundPicture, draw_border, draw_map
from launch_scripts.report.run_arrays import RunTracks
from launch_scripts.report.run_plots import PLOTS, draw_plot, saved

WIDTH_IN, HEIGHT_IN, DPI = 12.8, 9.6, 150

_MAP = (0.046, 0.058, 0.552, 0.776)
"""Left, bottom, width and height of the map at most, as shares of the page."""
_BESIDE = ("states", "captures", "gaps", "waiting", "messages", "timings")
"""Plots beside the map; the page of the run has all."""
_PLOTTED = ("certified gap, p95", "messages/s, mean")
"""Figures that a plot beside the map shows: the head of the picture has no room for them."""


class Card(NamedTuple):
    """One of the main figures of a run: what it is called, in words, what it means.

    tone  good, bad or nothing
    """

    label: str
    text: str
    meaning: str
    tone: str = ""


def cards(report: Mapping[str, Any]) -> list[Card]:
    """The main figures of a run, for the picture and the page."""
    gap = report["certified_gap"]
    unproven = gap.get("unproven") or 0
    not_counted = f" {count(unproven)} had none and are not counted." if unproven else ""
    proven = (
        "Routes that vehicles began cost at most so much more than the cheapest that exist: proven, by a lower "
        f"bound with each.{not_counted}"
    )
    best = f"Of 100 routes, 95 are proven to be at least as good as this. The worst: {percent(gap['max'])}."
    times = (
        ("growth_ms", "growth of a tree, p50", "All cheapest paths to one target"),
        ("route_query_ms", "route query, p50", "From a vehicle's question to the answer"),
        ("mark_to_tree_ms", "mark to tree, p50", "From what a sensor sees to a tree's cost"),
    )

    def of_facts(*names: str, tone: Callable[[Any], str] = lambda value: "") -> list[Card]:
        told = [(fact(name), report[name]) for name in names]
        return [Card(each.label, each.text(value), each.meaning, tone(value)) for each, value in told]

    return [
        *of_facts("captures", "marks", "reroute_requests", "routes_served"),
        Card("certified gap, mean", percent(gap["mean"]), proven),
        Card("certified gap, p95", percent(gap["p95"]), best),
        *(
            Card(label, duration(report[name]["p50"]), f"{meaning}; p99 {duration(report[name]['p99'])}.")
            for name, label, meaning in times
        ),
        Card("messages/s, mean", count(report["messages_per_s"]), "Of all processes, over the whole run."),
        *of_facts("collisions", "lethal_entries", tone=lambda value: {None: "", 0: "good"}.get(value, "bad")),
    ]


def headline(report: Mapping[str, Any], run: str | None) -> list[str]:
    """Which run it was and how long, in a few words each."""
    seconds, scale, startup_s = (report[name] for name in ("seconds", "time_scale", "startup_s"))
    known = {
        f"scenario {report['scenario']}": True,
        f"run {run}": run,
        f"seed {report['seed']}": True,
        f"{seconds or 0:.0f} s" + (f" at {scale:g} times real motion" if scale != 1 else ""): seconds is not None,
        "simulated in one process": "simulated" in report,
        f"{report['processes']} processes": report["processes"] is not None and "simulated" not in report,
        f"{report['restarts']} restarts": report["restarts"],
        f"all running after {startup_s or 0:.1f} s": startup_s is not None,
    }
    return [text for text, is_known in known.items() if is_known]


def save_picture(path: Path, ground: GroundPicture, tracks: RunTracks, report: dict[str, Any]) -> None:
    """Draws the run and writes it as PNG."""
    with saved(path, (WIDTH_IN, HEIGHT_IN), DPI) as figure:
        draw(figure, ground, tracks, report)


def draw(figure: Figure, ground: GroundPicture, tracks: RunTracks, report: dict[str, Any]) -> None:
    """Draws the run on a figure of the size of the picture."""
    _draw_head(figure, report)
    axes = figure.add_axes(_MAP)
    draw_map(axes, tracks, report)
    draw_border(axes, ground, tracks)
    left, width, top, bottom, gap = 0.655, 0.297, 0.818, 0.058, 0.052
    height = (top - bottom - gap * (len(_BESIDE) - 1)) / len(_BESIDE)
    for n, name in enumerate(_BESIDE):
        beside = figure.add_axes((left, top - height - n * (height + gap), width, height))
        draw_plot(beside, next(plot for plot in PLOTS if plot.name == name), report)


def _draw_head(figure: Figure, report: dict[str, Any]) -> None:
    title = f"{report['vehicles']} vehicles chase {report['targets']} targets"
    figure.text(0.033, 0.966, title, fontsize=21, fontweight="bold", va="center")
    facts = "   ·   ".join(headline(report, report["run_id"]))
    figure.text(0.033, 0.936, facts, fontsize=9, color=palette.FAINT, va="center")
    for y in (0.918, 0.853):
        figure.add_artist(Line2D([0.033, 0.967], [y, y], color=palette.RULE, linewidth=1))
    tiles = [tile for tile in cards(report) if tile.label not in _PLOTTED]
    widths = [max(len(tile.label), 1.9 * len(tile.text)) + 5 for tile in tiles]
    x, unit = 0.033, 0.95 / sum(widths)
    tones = {"": palette.INK, "good": palette.GREEN, "bad": palette.RED}
    for tile, width in zip(tiles, widths, strict=True):
        figure.text(x, 0.896, tile.text, fontsize=14, fontweight="bold", color=tones[tile.tone], va="center")
        figure.text(x, 0.869, tile.label, fontsize=8, color=palette.FAINT, va="center")
        x += unit * width
