"""Picture of slope rules: a panel for each group of curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from launch_scripts.commands.terrain_commands import Curve, Shown
from swarm.errors import TerrainError

_STEEPEST_PERCENT = 60
_MOST_FACTOR = 8.0
_ALIKE = 4.0
"""Vehicles of which one is quicker than another by more are shown on a logarithmic scale."""
_COLOURS = ("#1b6ca8", "#c8553d", "#4f9d69", "#8e6bb0", "#b8860b", "#3a3a3a", "#d48fb0", "#1fa3a3")
_STYLES = ("-", "--")


def draw_rules(shown: Shown, path: Path) -> None:
    """Pace or speed over slope. Raises TerrainError where the file cannot be written."""
    figure = Figure(figsize=(7.5 * len(shown), 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for panel, (title, curves) in zip(panels, shown.items(), strict=True):
        _panel(panel, title, curves)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise TerrainError(f"cannot write the picture {path}: {error}") from error


def _panel(panel: Axes, title: str, curves: list[Curve]) -> None:
    slopes = np.linspace(-_STEEPEST_PERCENT, _STEEPEST_PERCENT, 1201)
    speeds = [curve.cost.flat_speed_m_per_s for curve in curves]
    for number, curve in enumerate(curves):
        values = curve.at(slopes)
        values[~np.isfinite(values) | (values == 0)] = np.nan
        colour, style = _COLOURS[number % len(_COLOURS)], _STYLES[number // 4 % 2]
        panel.plot(slopes, values, style, color=colour, linewidth=2, label=curve.name)
    panel.set_title(title, loc="left", weight="bold")
    panel.set_xlabel("slope in %, negative is downhill")
    panel.set_xlim(-_STEEPEST_PERCENT, _STEEPEST_PERCENT)
    panel.axvline(0, color="#999", linewidth=0.8)
    if curves[0].unit == "factor":
        panel.set_ylabel("pace over that of level ground")
        panel.axhline(1, color="#999", linewidth=0.8)
        panel.set_ylim(0, _MOST_FACTOR)
    elif max(speeds) < _ALIKE * min(speeds):
        panel.set_ylabel("speed on open ground, m/s")
        panel.set_ylim(bottom=0)
    else:
        panel.set_ylabel("speed on open ground, m/s")
        panel.set_yscale("log")
        panel.set_yticks([0.1, 0.2, 0.5, 1, 2, 5, 10, 20], ["0.1", "0.2", "0.5", "1", "2", "5", "10", "20"])
        panel.minorticks_off()
    panel.grid(color="#e5e5e5")
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.legend(frameon=False, fontsize=9)
