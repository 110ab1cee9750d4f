"""Plots and cards, made from a report: one table for the picture and for the page of a run.

A plot is one row of `PLOTS`. It names what it shows of the report, and is drawn in one of three ways: courses over
time, states of all vehicles in a stack, or the share of all that is at most so large.

A card is one main figure of a run, in words.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from launch_scripts.observe import palette
from launch_scripts.observe.fact_table import count, duration, fact
from launch_scripts.observe.run_state import RunState
from launch_scripts.observe.summed_counts import percent
from launch_scripts.plain_text import number_of
from swarm.config.explain import meanings
from swarm.errors import StoreError
from swarm.files import replacing

Report = Mapping[str, Any]
Values = NDArray[np.float64]
STYLE = Path(__file__).with_name("pictures.mplstyle")
"""Settings of matplotlib for all pictures."""
_TITLE_PT = 10.5
_LEAST_PERCENT, _MOST_PERCENT = 0.01, 100.0
"""Gaps are shown between these, on a logarithmic scale."""


@dataclass(frozen=True)
class Plot:
    """One row of `PLOTS`.

    draw       draws `lines` of a report on axes; False if the run did not measure any of them
    lines      name in the report's series or distributions -> label in the legend, and colour
    of         the plotted value of the report
    tick       a shown value in words
    least      the vertical axis ends there at least
    """

    name: str
    title: str
    meaning: str
    lines: Mapping[str, tuple[str, str]]
    draw: Callable[[Axes, Plot, Report], bool]
    of: Callable[[Values], Values] = np.asarray
    tick: Callable[[float], str] = lambda value: f"{value / 1000:g}k" if abs(value) >= 1000 else f"{value:g}"
    least: float = 1.0


def draw_plot(axes: Axes, plot: Plot, report: Report, *, titled: bool = True) -> None:
    """Draws one plot and its axes."""
    if titled:
        axes.set_title(plot.title)
    axes.spines[["top", "right"]].set_visible(False)
    if not plot.draw(axes, plot, report):
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center", color=palette.FAINT)
        axes.set(xticks=[], yticks=[])
        return
    over_time = plot.draw is not _shares
    if over_time:
        axes.set_xlim(0, max(report["series"]["t_s"], default=1.0) or 1.0)
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} s" if value else "0"))
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=plot.tick not in (_percent, _ms)))
    axes.tick_params(axis="both", which="both", length=0)
    of_values = axes.yaxis if over_time else axes.xaxis
    of_values.set_major_formatter(FuncFormatter(lambda value, _: plot.tick(value) if value else "0"))
    if len(plot.lines) > 1:
        _legend_above(axes)


def _states(axes: Axes, plot: Plot, report: Report) -> bool:
    series = report["series"]
    shown = [name for name in plot.lines if any(series.get(name) or ())]
    if not shown:  # stopped before any vehicle had published its position
        return False
    labels, colours = zip(*(plot.lines[name] for name in shown), strict=True)
    axes.stackplot(series["t_s"], *(series[name] for name in shown), labels=labels, colors=colours, linewidth=0)
    axes.set_ylim(0, max(np.sum([series[name] for name in shown], axis=0).max(), plot.least))
    return True


def _courses(axes: Axes, plot: Plot, report: Report) -> bool:
    """Series over time, the area below the first filled."""
    most, drawn = plot.least, False
    series = report.get("series", {})
    for number, (name, (label, colour)) in enumerate(plot.lines.items()):
        both = zip(series.get("t_s", []), series.get(name, []), strict=False)
        known = np.array([(time, value) for time, value in both if value is not None], np.float64)
        if not len(known):
            continue
        times, shown, drawn = known[:, 0], plot.of(known[:, 1]), True
        axes.plot(times, shown, "--" if number else "-", color=colour, linewidth=1.7, label=label)
        axes.fill_between(times, shown, color=colour, alpha=0.0 if number else 0.25, linewidth=0)
        most = max(most, 1.1 * float(shown.max()))
    axes.set_ylim(0, most)
    return drawn


def _shares(axes: Axes, plot: Plot, report: Report) -> bool:
    """The share of all that is at most so large, over a logarithmic axis. Routes without a bound are among all."""
    drawn = False
    for name, (label, colour) in plot.lines.items():
        counts = np.array(report.get("distributions", {}).get(name, []), np.float64).reshape(-1, 2)
        unproven = report["certified_gap"].get("unproven") or 0 if name == "followed_gap_excess" else 0
        if len(counts):
            shares = 100 * np.cumsum(counts[:, 1]) / (counts[:, 1].sum() + unproven)
            edges, heights = plot.of(counts[:, 0])[[0, *range(len(counts)), -1]], [0.0, *shares, shares[-1]]
            edges[-1] = max(edges[-1], plot.least)
            axes.step(edges, heights, where="post", color=colour, linewidth=1.7, label=label)
            axes.fill_between(edges, heights, step="post", color=colour, alpha=0.15, linewidth=0)
            drawn = True
    axes.set_xscale("log")
    axes.set_ylim(0, 105)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:g}%"))
    low, high = axes.get_xlim()
    axes.set_xticks([tick for tick in LogLocator(numticks=6).tick_values(low, high) if low <= tick <= high])
    axes.xaxis.set_minor_formatter(NullFormatter())
    return drawn


def _percent(value: float) -> str:
    return f"{value:g}%"


def _ms(value: float) -> str:
    return f"{value:g} ms" if value < 1000 else f"{value / 1000:g} s"


PLOTS = (
    Plot("states", "Vehicles", "States of the vehicles.",
         {state.name.lower(): (state.name.lower(), colour) for state, colour in palette.STATE_COLOURS.items()},
         _states),
    Plot("captures", "Captures", "Captures of all targets.", {"captures": ("captures", palette.GREEN)}, _courses),
    Plot("marks", "Marks", "Hazards found by vehicles.",
         {"marks": ("marks", palette.VIOLET)}, _courses),
    Plot("gaps", "Certified gap",
         "How far above the optimum the routes that vehicles began can be at most: each comes with a proven lower "
         "bound.", {"certified_gap_p95": ("p95", palette.ORANGE), "certified_gap_mean": ("mean", palette.BLUE)},
         _courses, lambda gaps: np.maximum(gaps - 1, 0) * 100, _percent, least=0.1),
    Plot("waiting", "Waiting",
         "How many vehicles waited at the same time: for a route, or with one, as where others pass.",
         {"waiting_at_once": ("for a route", palette.ORANGE), "standing_at_once": ("with a route", palette.BLUE)},
         _courses),
    Plot("growing", "Growing a tree", "Time of the last growth of a tree, mean over targets.",
         {"growth_ms_mean": ("growth", palette.GREEN)}, _courses, tick=_ms, least=1e-3),
    Plot("messages", "Messages per second", "Sum over all processes.",
         {"messages_per_s": ("messages", palette.BLUE)}, _courses),
    Plot("shares", "Routes within a gap",
         "Share of the routes that are proven to be at most so far above the optimum.",
         {"followed_gap_excess": ("routes", palette.BLUE)}, _shares,
         lambda excess: np.maximum(100 * excess, _LEAST_PERCENT), _percent, least=_MOST_PERCENT),
    Plot("timings", "How long it takes", "Share of the times that are at most this long.",
         {"growth_ms": ("tree growth", palette.GREEN), "route_query_ms": ("route query", palette.BLUE),
          "mark_to_tree_ms": ("mark to tree", palette.VIOLET)},
         _shares, lambda ms: np.maximum(ms, 1e-3), _ms, least=1e-3),
)  # fmt: skip
"""All plots, in the order in which they are shown."""


def _legend_above(axes: Axes) -> None:
    """Draws a legend of the labels beside the title, in small letters so that both have room."""
    _, labels = axes.get_legend_handles_labels()
    figure: Any = axes.get_figure(root=True)
    ems = sum(0.52 * len(label) + 2.6 for label in labels)
    wide_pt = axes.get_position().width * figure.get_figwidth() * 72
    room_pt = wide_pt - 0.62 * _TITLE_PT * len(axes.get_title("left")) - _TITLE_PT
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 0.985), ncol=len(labels), handlelength=1.2, handletextpad=0.4,
        columnspacing=1.0, borderaxespad=0.2, fontsize=min(8.5, room_pt / max(ems, 1.0)),
    )  # fmt: skip


def halo() -> list[Any]:
    """Outline which keeps text readable on any background."""
    return [withStroke(linewidth=2.6, foreground="white")]


@contextlib.contextmanager
def saved(path: Path, size_in: tuple[float, float], dpi: int = 120, **look: Any) -> Iterator[Figure]:
    """A figure in the style of all pictures, which is written at the end. Raises StoreError if it cannot be.

    look  as `Figure` takes it
    """
    with mpl.rc_context(fname=STYLE):
        figure = Figure(figsize=size_in, dpi=dpi, facecolor="white", **look)
        FigureCanvasAgg(figure)
        yield figure
        try:
            with replacing(path) as target:
                figure.savefig(target, format="png", pil_kwargs={"compress_level": 4})
        except ValueError as error:  # too many pixels
            raise StoreError(f"cannot write {path}: {error}") from error


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
    said = meanings(RunState)
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
        ("mark_to_tree_ms", "mark to tree, p50", "From a sensor's view to a tree's cost"),
    )

    def of_facts(*names: str, tone: Callable[[Any], str] = lambda value: "") -> list[Card]:
        told = [(fact(name), report[name], said[name]) for name in names]
        return [
            Card(of.label, of.text(value), f"{text[0].upper()}{text[1:]}.", tone(value)) for of, value, text in told
        ]

    return [
        *of_facts("captures", "marks", "reroute_requests", "routes_served"),
        Card("certified gap, mean", percent(gap["mean"]), proven),
        Card("certified gap, p95", percent(gap["p95"]), best),
        *(
            Card(label, duration(report[name]["p50"]), f"{meaning}; p99 {duration(report[name]['p99'])}.")
            for name, label, meaning in times
        ),
        Card("messages/s, mean", count(report["messages_per_s"]), "Sums over all processes and the whole run."),
        *of_facts("collisions", "lethal_entries", tone=lambda value: {None: "", 0: "good"}.get(value, "bad")),
    ]


def headline(report: Mapping[str, Any], run: str | None) -> list[str]:
    """Returns which run it was and how long, in a few words each."""
    seconds, scale, startup_s = (report[name] for name in ("seconds", "time_scale", "startup_s"))
    known = {
        f"scenario {report['scenario']}": True,
        f"run {run}": run,
        f"seed {report['seed']}": True,
        f"{seconds or 0:.0f} s" + (f" at {scale:g} times real motion" if scale != 1 else ""): seconds is not None,
        "simulated in one process": "simulated" in report,
        number_of(report["processes"], "needed process"): report["processes"] and "simulated" not in report,
        number_of(report["restarts"], "restart"): report["restarts"],
        f"all running after {startup_s or 0:.1f} s": startup_s is not None,
    }
    return [text for text, is_known in known.items() if is_known]
