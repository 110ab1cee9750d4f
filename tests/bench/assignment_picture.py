"""The picture of `./launch_scripts/bench assignment`: one clustered start, by two rules beside each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from bench.assignment import Result, Row, World, chase
from launch_scripts.observe.palette import BLUE, FAINT, INK, RED
from launch_scripts.observe.plot_style import STYLE

SHOWN = ("cheapest", "balanced")
_GROUND = LinearSegmentedColormap.from_list("ground", ["#f6f3ea", "#d9cfae", "#a68a5b"])
_DPI = 110


def save_chases(world: World, row: Row, seed: int, path: Path) -> None:
    """The ways of all vehicles and where each target was captured, in minutes: a panel for each rule."""
    results = {rule: chase(world, row, rule, seed, keep_trails=True) for rule in SHOWN}
    high = world.grid.rows / world.grid.cols
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        figure = Figure(figsize=(11.0, 5.1 * high + 1.2), dpi=_DPI, facecolor="white", layout="constrained")
        figure.suptitle(
            f"{row.vehicles} vehicles start together, {row.targets} targets", x=0.01, ha="left", fontweight="bold"
        )
        for axes, (rule, result) in zip(figure.subplots(1, len(results)), results.items(), strict=True):
            _draw(axes, world, result)
            last = max(result.captured_s) / 60
            axes.set_title(f"{rule}: the last after {last:.0f} minutes")
        with path.open("wb") as file:
            FigureCanvasAgg(figure).print_png(file)  # type: ignore[no-untyped-call]


def _draw(axes: Any, world: World, result: Result) -> None:
    cols = world.grid.cols
    pace = np.where(np.isfinite(world.pace), world.pace, np.nan)
    axes.imshow(np.log(pace), cmap=_GROUND, interpolation="nearest", alpha=0.8)
    rows, columns = np.divmod(np.stack(result.trails), cols)
    axes.plot(columns, rows, color=BLUE, lw=0.7, alpha=0.45)
    axes.plot(columns[0], rows[0], ".", color=INK, ms=4)
    for at_s, cell in result.captures:
        row, col = divmod(cell, cols)
        axes.plot(col, row, "o", color=RED, ms=6, mec="white", mew=0.8)
        axes.annotate(
            f"{at_s / 60:.0f} min",
            (col, row),
            (5, 4),
            textcoords="offset points",
            fontsize=8.5,
            bbox={"fc": "white", "ec": "none", "pad": 0.8, "alpha": 0.8},
        )
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlabel("ways of the vehicles, and where and when each target was captured", color=FAINT, fontsize=8.5)
