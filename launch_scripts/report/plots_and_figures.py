"""Plots and cards, made from a report, and figures of a terrain.

A plot is one row of `PLOTS`, for the picture and for the page of a run. It names what it shows of the report, and
is drawn in one of three ways: courses over time, states of all vehicles in a stack, or the share of all that is at
most so large. A card is one main figure of a run, in words.

A figure of a terrain shows heights, photo, classes and cost, or a route: values of each cell of a level in colours,
drawn by matplotlib, with the relief as a shadow over them.
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
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from launch_scripts.observe import palette
from launch_scripts.observe.palette import BLUE, RED, hillshade
from launch_scripts.observe.run_state import RunState, count, duration, fact
from launch_scripts.observe.summed_counts import percent
from launch_scripts.plain_text import number_of
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.synthetic import TINT
from shared_map.terrain.terrain import Level, Terrain, level_of
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
    measured = [name for name in plot.lines if any(series.get(name) or ())]
    if not measured:  # stopped before any vehicle had published its position
        return False
    labels, colours = zip(*(plot.lines[name] for name in measured), strict=True)
    axes.stackplot(series["t_s"], *(series[name] for name in measured), labels=labels, colors=colours, linewidth=0)
    axes.set_ylim(0, max(np.sum([series[name] for name in measured], axis=0).max(), plot.least))
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
        times, plotted, drawn = known[:, 0], plot.of(known[:, 1]), True
        axes.plot(times, plotted, "--" if number else "-", color=colour, linewidth=1.7, label=label)
        axes.fill_between(times, plotted, color=colour, alpha=0.0 if number else 0.25, linewidth=0)
        most = max(most, 1.1 * float(plotted.max()))
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
def saved(path: Path, size_in: tuple[float, float], dpi: int = 120, **options: Any) -> Iterator[Figure]:
    """A figure in the style of all pictures, which is written at the end. Raises StoreError if it cannot be.

    options  as `Figure` takes them
    """
    with mpl.rc_context(fname=STYLE):
        figure = Figure(figsize=size_in, dpi=dpi, facecolor="white", **options)
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
    texts = meanings(RunState)
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
        rows = [(fact(name), report[name], texts[name]) for name in names]
        return [
            Card(of.label, of.text(value), f"{text[0].upper()}{text[1:]}.", tone(value)) for of, value, text in rows
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


MOST_CELLS = 1 << 21
"""Most cells of a panel; larger terrains are shown by a coarser level of their pyramid."""
_PANEL_IN = 6.6
"""Longer side of a panel, in inches."""
_LETHAL, _VOID = "#3b1a5a", "#9a9a9a"
# Muted greens to rock to snow. No blue: valleys must not look like lakes.
_HEIGHTS = LinearSegmentedColormap.from_list(
    "heights", ["#6d9a6b", "#a9bd85", "#e3d9a8", "#c9a77c", "#9a7a62", "#b5aaa3", "#ffffff"]
).with_extremes(bad=_VOID)
_PACES = LinearSegmentedColormap.from_list(
    "paces", ["#fbf7dc", "#f6d27a", "#ee9140", "#cf4a2c", "#7d1626"]
).with_extremes(bad=_LETHAL)
_GROUND = LinearSegmentedColormap.from_list("ground", ["#ede6d1", "#5c4576"])
"""From passable to lethal cells."""
_TINTS = [*(TINT / 255)]
for _kind, _tint in (  # photos' own colours do not tell these classes apart
    (TerrainClass.ROAD, (1.0, 0.91, 0.69)), (TerrainClass.BUILT, (0.75, 0.38, 0.35)),
    (TerrainClass.SHRUB, (0.70, 0.64, 0.31)), (TerrainClass.WETLAND, (0.37, 0.62, 0.58)),
):  # fmt: skip
    _TINTS[_kind] = np.array(_tint)
_CLASSES = ListedColormap(_TINTS)


def _draw_map(
    axes: Axes, level: Level, title: str, values: Any, shadow: float, **colours: Any
) -> tuple[Any, float]:
    """Draws values of each cell on axes in metres, or kilometres of a large terrain, from its north-west corner.

    values   float (rows, cols), NaN where there is none; or colours, (rows, cols, 3)
    shadow   how dark the relief makes a slope at most, 0 to 1
    colours  as `Axes.imshow` takes them

    Returns the image, for a bar of colours, and the metres of the axes' unit.
    """
    grid = level.grid
    unit_m, unit = (1000.0, "km") if max(grid.rows, grid.cols) * grid.resolution_m >= 4000 else (1.0, "m")
    side = grid.resolution_m / unit_m
    place: Any = {"extent": (0.0, grid.cols * side, grid.rows * side, 0.0), "interpolation": "nearest"}
    image = axes.imshow(values, **colours, **place)
    dark = np.zeros((grid.rows, grid.cols, 4), np.float32)
    dark[..., 3] = np.clip(shadow * (1 - hillshade(level.elevation_m, grid.resolution_m) / 0.7), 0, 1)
    axes.imshow(dark, **place)
    axes.set(title=title, xlabel=f"east, {unit}", ylabel=f"south, {unit}")
    axes.grid(visible=False)
    return image, unit_m


# --- a terrain ----------------------------------------------------------------------------------------------------


def draw_terrain(terrain: Terrain, path: Path, title: str) -> None:
    """Elevation, photo, classes and cost, two by two."""
    level = level_of(terrain, MOST_CELLS)
    grid, climb = terrain.grid, terrain.climb
    ratio = min(max(grid.rows / grid.cols, 0.3), 3.0)
    wide_in, high_in = (_PANEL_IN, _PANEL_IN * ratio) if ratio <= 1 else (_PANEL_IN / ratio, _PANEL_IN)
    voids = np.isnan(level.elevation_m)
    driven = np.isfinite(level.pace_s_per_m) & (level.lethal_share < 0.5)
    low, high = np.percentile(level.pace_s_per_m[driven], (0, 99)) if driven.any() else (0.0, 1.0)
    shares = np.bincount(level.classes.reshape(-1), minlength=len(TerrainClass)) / level.classes.size
    of_classes = [
        Patch(facecolor=_TINTS[kind], edgecolor="#888", label=f"{kind.name.lower()} {_share(shares[kind])}")
        for kind in sorted(TerrainClass, key=lambda kind: -shares[kind])
        if shares[kind]
    ]
    cost = "cost"
    if climb is not None:
        ground = "ground" if climb.wind is None else "flight"
        cost = f"cost of level {ground} (steps cost by their climb{' and the wind' if climb.windy else ''} too)"
    void = [Patch(color=_VOID, label=f"void {voids.mean():.1%}")] if voids.any() else []
    lethal = [Patch(color=_LETHAL, label=f"lethal {level.lethal_share.mean():.1%}")]
    paces = np.where(driven, level.pace_s_per_m, np.nan)
    spread = Normalize(float(low), max(float(high), 1.01 * float(low)))
    kinds = Normalize(-0.5, len(_TINTS) - 0.5)
    panels: tuple[tuple[str, Any, float, dict[str, Any], str, list[Patch]], ...] = (
        ("elevation", level.elevation_m, 0.6, {"cmap": _HEIGHTS}, "metres", void),
        ("photo", level.photo, 0.0, {}, "", []),
        ("classes", level.classes, 0.35, {"cmap": _CLASSES, "norm": kinds}, "", of_classes),
        (cost, paces, 0.3, {"cmap": _PACES, "norm": spread}, "seconds per metre", lethal),
    )
    with saved(path, (2 * wide_in + 4.2, 2 * high_in + 1.9), layout="constrained") as figure:
        for axes, (name, values, shadow, colours, of_bar, patches) in zip(
            figure.subplots(2, 2).reshape(-1), panels, strict=True
        ):
            image, unit_m = _draw_map(axes, level, name, values, shadow, **colours)
            if of_bar:
                beside = axes.inset_axes((1.02, 0.0, 0.04, 0.85 if patches else 1.0))
                figure.colorbar(image, cax=beside, label=of_bar)
            if patches:
                axes.legend(handles=patches, loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=10)
        wide, high = grid.cols * grid.resolution_m / unit_m, grid.rows * grid.resolution_m / unit_m
        size = f"{wide:.4g} x {high:.4g} {'km' if unit_m > 1 else 'm'}"
        facts = f"{grid.rows} x {grid.cols} cells of {grid.resolution_m:g} m, {size}"
        coarse = "" if level.side == 1 else f"; a pixel shows {level.side} x {level.side} cells"
        figure.suptitle(f"{title}\n{facts}{coarse}", x=0.01, ha="left", fontsize=13)


def _share(share: float) -> str:
    return f"{share:.0%}" if share >= 0.095 else f"{share:.1%}" if share >= 0.0005 else "< 0.1%"


# --- a route ------------------------------------------------------------------------------------------------------


def draw_route(
    terrain: Terrain,
    path: Path,
    title: str,
    xy_m: NDArray[np.float64],
    at_m: NDArray[np.float64],
    height_m: NDArray[np.float64],
) -> None:
    """A route on the relief, lethal ground dark, and its heights below.

    xy_m      float64 (2, n), metres of the map
    at_m      float64 (n,), metres driven until there
    height_m  float64 (n,), NaN over a void
    """
    level = level_of(terrain, MOST_CELLS)
    high_in = 8.0 * min(max(level.grid.rows / level.grid.cols, 0.3), 1.4)
    with saved(path, (8.6, high_in + 3.0), layout="constrained") as figure:
        above, below = figure.subplots(2, 1, height_ratios=[high_in, 2.2])
        _, unit_m = _draw_map(above, level, title, level.lethal_share, 0.65, cmap=_GROUND, norm=Normalize(0, 1))
        along, down = (xy_m[0] - terrain.grid.west_m) / unit_m, (terrain.grid.north_m - xy_m[1]) / unit_m
        above.plot(along, down, color="white", linewidth=3.6)
        above.plot(along, down, color=RED, linewidth=1.8)
        for n, label in ((0, "from"), (-1, "to")):
            above.plot(along[n], down[n], "o", color=RED, markeredgecolor="white", markersize=7)
            above.annotate(
                label, (along[n], down[n]), xytext=(7, 7), textcoords="offset points", weight="bold",
                bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
            )  # fmt: skip
        at = at_m / unit_m
        below.plot(at, height_m, color=BLUE, linewidth=1.4)
        if np.isfinite(height_m).any():
            below.fill_between(at, np.nanmin(height_m), height_m, color=BLUE, alpha=0.15)
        unit = "km" if unit_m > 1 else "m"
        below.set(xlabel=f"along the route, {unit}", ylabel="height, m", xlim=(0, max(at[-1], 1e-9)))
