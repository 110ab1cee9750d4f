"""One-page picture of a run: the map with all tracks, and plots over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from launch_scripts.report.pictures.hillshade import hillshade
from launch_scripts.report.pictures.palette import (
    BLACK,
    DARK_GREEN,
    FAINT,
    GREEN,
    INK,
    MARKED_LETHAL,
    MARKED_SLOW,
    RED,
    RULE,
    YELLOW,
)
from launch_scripts.report.pictures.plot_style import STYLE
from launch_scripts.report.pictures.plots import draw_plots, duration, halo
from launch_scripts.report.pictures.scale_bar import round_length, said_length
from launch_scripts.report.recorder import Recorder
from launch_scripts.report.results.certified_gap import percent
from shared_map.terrain.pyramid import Level, any_in_blocks, level_of
from shared_map.terrain.terrain import Terrain
from swarm.wire.statements import MarkKind

WIDTH_IN, HEIGHT_IN, DPI = 12.8, 9.6, 150

_SHOWN_LABELS = 30
_SEEN_CELLS = 1 << 22
"""Cells of the ground that are drawn at most: more than the picture has pixels."""


def save_picture(
    path: Path, recorder: Recorder, report: dict[str, Any], terrain: Terrain, truth: NDArray[np.float32] | None
) -> None:
    """Draws the run and writes it as PNG."""
    with mpl.rc_context(STYLE):
        figure = draw(recorder, report, terrain, truth)
        canvas = FigureCanvasAgg(figure)
        with path.open("wb") as file:
            canvas.print_png(file)  # type: ignore[no-untyped-call]


def draw(recorder: Recorder, report: dict[str, Any], terrain: Terrain, truth: NDArray[np.float32] | None) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DPI, facecolor="white")
    _draw_head(figure, report)
    _draw_map(figure.add_axes((0.033, 0.058, 0.565, 0.776)), recorder, terrain, truth)
    draw_plots(figure, recorder)
    return figure


# --- the head: scenario and main figures ---------------------------------------------------------


def _draw_head(figure: Figure, report: dict[str, Any]) -> None:
    title = f"{report['vehicles']} vehicles chase {report['targets']} targets"
    figure.text(0.033, 0.966, title, fontsize=21, fontweight="bold", va="center")
    figure.text(0.033, 0.936, "   ·   ".join(_facts(report)), fontsize=9.5, color=FAINT, va="center")
    tiles = [
        ("captures", _number(report["captures"]), GREEN),
        ("marks", _number(report["marks"]), INK),
        ("re-route requests", _number(report["reroute_requests"]), INK),
        ("routes served", _number(report["routes_served"]), INK),
        ("certified gap, mean", percent(report["certified_gap"]["mean"]), INK),
        ("growth of a tree, p50", duration(report["growth_ms"]["p50"]), INK),
        ("route query, p99", duration(report["route_query_ms"]["p99"]), INK),
        ("collisions", _number(report["collisions"]), RED if report["collisions"] else GREEN),
        ("lethal entries", _number(report["lethal_entries"]), RED if report["lethal_entries"] else GREEN),
        ("lost", _number(report["lost"]), RED if report["lost"] else GREEN),
    ]
    for y in (0.918, 0.853):
        figure.add_artist(Line2D([0.033, 0.967], [y, y], color=RULE, linewidth=1))
    widths = [max(len(label), 1.9 * len(value)) + 4 for label, value, _ in tiles]
    x, unit = 0.033, 0.95 / sum(widths)
    for (label, value, colour), width in zip(tiles, widths, strict=True):
        figure.text(x, 0.896, value, fontsize=15, fontweight="bold", color=colour, va="center")
        figure.text(x, 0.869, label, fontsize=8.5, color=FAINT, va="center")
        x += unit * width


def _facts(report: dict[str, Any]) -> list[str]:
    seconds, scale = report["seconds"], report["time_scale"]
    return [
        fact
        for fact in (
            f"scenario {report['scenario']}",
            f"run {report['run_id']}" if report["run_id"] else "",
            f"seed {report['seed']}",
            "" if seconds is None else f"{seconds:.0f} s" + (f" at {scale:g} x real motion" if scale != 1 else ""),
            _several(report["processes"], "process", "processes"),
            _several(report["restarts"], "restart", "restarts"),
            "" if report["startup_s"] is None else f"all running after {report['startup_s']:.1f} s",
            f"terrain {report['terrain']['digest']}" if "terrain" in report else "",
        )
        if fact
    ]


def _several(count: int | None, one: str, many: str) -> str:
    return "" if count is None else f"{count} {one if count == 1 else many}"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:,.0f}"


# --- the map ----------------------------------------------------------------------------------------------------


def _draw_map(axes: Axes, recorder: Recorder, terrain: Terrain, truth: NDArray[np.float32] | None) -> None:
    grid = terrain.grid
    width_km, height_km = grid.cols * grid.resolution_m / 1000, grid.rows * grid.resolution_m / 1000
    extent = (0.0, width_km, height_km, 0.0)
    seen = level_of(terrain, _SEEN_CELLS)
    axes.imshow(_ground(seen), extent=extent, interpolation="bilinear")
    if truth is not None:
        _draw_unknown(axes, terrain, truth, seen)
    _draw_marks(axes, recorder, seen)
    _draw_tracks(axes, recorder)
    axes.set(xlim=(0, width_km), ylim=(height_km, 0))
    axes.set_aspect("equal", anchor="NW")
    axes.grid(False)
    axes.set_xticks([])
    axes.set_yticks([])
    _draw_scale_bar(axes, width_km, height_km)
    _draw_legend(axes, truth is not None)


def _ground(seen: Level) -> NDArray[np.float32]:
    """The photo with hillshade, paled so that tracks stand out."""
    shade = hillshade(seen.elevation_m, seen.grid.resolution_m)
    photo = seen.photo.astype(np.float32) / 255
    grey = photo.mean(axis=2, keepdims=True)
    paled = 0.55 * (0.65 * photo + 0.35 * grey) + 0.45
    lit: NDArray[np.float32] = np.clip(paled * (0.62 + 0.55 * shade[..., None]), 0, 1).astype(np.float32)
    return lit


def _draw_unknown(axes: Axes, terrain: Terrain, truth: NDArray[np.float32], seen: Level) -> None:
    """Outlines hidden obstacles of the truth; marks fill in those that were found."""
    hidden = (truth != terrain.ground_s_per_m) & ~(np.isinf(truth) & np.isinf(terrain.pace_s_per_m))
    if not hidden.any():
        return
    hidden = any_in_blocks(hidden, seen.side)
    rows, cols = hidden.shape
    resolution_km = seen.grid.resolution_m / 1000
    x = (np.arange(cols) + 0.5) * resolution_km
    y = (np.arange(rows) + 0.5) * resolution_km
    axes.contour(x, y, hidden.astype(np.float32), levels=[0.5], colors="white", linewidths=1.9, zorder=1)
    axes.contour(
        x, y, hidden.astype(np.float32), levels=[0.5], colors=BLACK, linewidths=0.8, linestyles=":", zorder=1
    )


def _draw_marks(axes: Axes, recorder: Recorder, seen: Level) -> None:
    marked = recorder.marked()
    if not len(marked.cells):
        return
    grid = seen.grid
    overlay = np.zeros((grid.rows, grid.cols, 4), np.float32)
    lethal = marked.kinds == MarkKind.LETHAL
    rows, cols = np.divmod(marked.cells, recorder.grid.cols)
    cells = rows // seen.side * grid.cols + cols // seen.side
    overlay.reshape(-1, 4)[cells[~lethal]] = to_rgba(MARKED_SLOW, 0.85)
    overlay.reshape(-1, 4)[cells[lethal]] = to_rgba(MARKED_LETHAL, 0.95)
    extent = (0, grid.cols * grid.resolution_m / 1000, grid.rows * grid.resolution_m / 1000, 0)
    axes.imshow(overlay, extent=extent, interpolation="nearest", zorder=2)


def _draw_tracks(axes: Axes, recorder: Recorder) -> None:
    vehicles = [line / np.float32(1000) for _, line in sorted(recorder.vehicle_tracks.lines().items())]
    thin = 1 / max(1.0, len(vehicles) / 100) ** 0.5
    _draw_strips(axes, vehicles, DARK_GREEN, 1.1 * thin, 1.9 * thin, zorder=3)
    if vehicles:
        starts, ends = (np.array([line[n] for line in vehicles]) for n in (0, -1))
        axes.scatter(
            starts[:, 0], starts[:, 1], s=13 * thin**2, c="white", edgecolors=DARK_GREEN, linewidths=0.8, zorder=4
        )
        axes.scatter(ends[:, 0], ends[:, 1], s=26 * thin**2, c=GREEN, edgecolors="white", linewidths=0.7, zorder=5)
    pieces = recorder.target_tracks.lines()
    _draw_strips(axes, [line / np.float32(1000) for line in pieces.values()], RED, 2.0, 3.6, zorder=6)
    if recorder.captures:
        places = np.array([(capture.east_m, capture.south_m) for capture in recorder.captures]) / 1000
        axes.scatter(
            places[:, 0], places[:, 1], marker="*", s=115, c=YELLOW, edgecolors=BLACK, linewidths=0.7, zorder=8
        )
    last = {id: line[-1] / 1000 for (id, _), line in sorted(pieces.items())}
    for id, (x, y) in last.items():
        axes.scatter([x], [y], marker="D", s=48, c=RED, edgecolors="white", linewidths=1.1, zorder=9)
        if len(last) <= _SHOWN_LABELS:
            _label(axes, id, float(x), float(y), recorder)


def _draw_strips(
    axes: Axes, strips: list[NDArray[np.float32]], colour: str, width: float, casing: float, zorder: int
) -> None:
    strips = [strip for strip in strips if len(strip) > 1]
    for line_colour, line_width, alpha in (("white", casing, 0.6), (colour, width, 1.0)):
        axes.add_collection(
            LineCollection(
                strips,
                colors=line_colour,
                linewidths=line_width,
                alpha=alpha,
                zorder=zorder,
                capstyle="round",
                joinstyle="round",
            )
        )


def _label(axes: Axes, text: str, x: float, y: float, recorder: Recorder) -> None:
    """Annotates beside the place, on the side where the text fits."""
    grid = recorder.grid
    right = x * 1000 < 0.94 * grid.cols * grid.resolution_m
    below = y * 1000 < 0.04 * grid.rows * grid.resolution_m
    axes.annotate(
        text, (x, y), xytext=(6 if right else -6, -6 if below else 5), textcoords="offset points", fontsize=9,
        fontweight="bold", color=RED, zorder=10, path_effects=halo(), ha="left" if right else "right",
        va="top" if below else "bottom",
    )  # fmt: skip


def _draw_scale_bar(axes: Axes, width_km: float, height_km: float) -> None:
    length_km = round_length(width_km / 5)
    x0, y0 = 0.03 * width_km, height_km * 0.965
    for colour, width in (("white", 6.0), (INK, 3.0)):
        axes.plot([x0, x0 + length_km], [y0, y0], color=colour, linewidth=width, solid_capstyle="butt", zorder=11)
    axes.annotate(
        said_length(length_km * 1000), (x0, y0), xytext=(0, 5), textcoords="offset points", ha="left", fontsize=9.5,
        fontweight="bold", zorder=11, path_effects=halo(),
    )  # fmt: skip


def _draw_legend(axes: Axes, knows_truth: bool) -> None:
    handles: list[Any] = [
        Line2D([], [], color=DARK_GREEN, linewidth=1.6, marker="o", markersize=5, markerfacecolor=GREEN,
               markeredgecolor="white", markeredgewidth=0.6, label="vehicle"),
        Line2D([], [], color=RED, linewidth=2, marker="D", markersize=6, markeredgecolor="white", label="target"),
        Line2D([], [], color="none", marker="*", markersize=12, markerfacecolor=YELLOW, markeredgecolor=BLACK,
               markeredgewidth=0.7, label="capture"),
        Patch(facecolor=MARKED_LETHAL, label="marked lethal"),
        Patch(facecolor=MARKED_SLOW, label="marked slow"),
    ]  # fmt: skip
    if knows_truth:
        handles.append(Patch(facecolor="none", edgecolor=BLACK, linestyle=":", label="hidden from the map"))
    axes.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0, -0.005), ncol=len(handles), handlelength=1.5,
        columnspacing=1.4, borderaxespad=0.3, handletextpad=0.5, borderpad=0,
    )  # fmt: skip
