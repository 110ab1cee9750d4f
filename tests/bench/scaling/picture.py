"""What was measured beside what the model says, and how cores grow with a swarm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from bench.scaling.check import Compared
from bench.scaling.model import ROLES, Model, Row
from bench.scaling.needs import needs
from bench.whole_swarm.size import size_of
from launch_scripts.observe.palette import BLUE, FAINT, INK, ORANGE, PINK, SKY, STYLE, VIOLET
from swarm.errors import StoreError

_COLOURS = dict(zip(ROLES, (BLUE, ORANGE, VIOLET, SKY, PINK, FAINT, "#8a6d3b"), strict=True))
_FIGURES = (
    ("bytes", "bytes a second, simulated"),
    ("CPU", "ms of CPU a second, live"),
)
_DPI = 150


def save_picture(model: Model, compared: Sequence[Compared], rows: Sequence[Row], path: Path) -> None:
    """Two plots of measured and said, one of cores by vehicles. Raises StoreError."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11, 3.8), layout="constrained")
        FigureCanvasAgg(figure)
        left, middle, right = figure.subplots(1, 3)
        for axes, (name, label) in zip((left, middle), _FIGURES, strict=True):
            _compare(axes, [each for each in compared if each.figure == name], label)
        _grow(right, model, rows)
        try:
            figure.savefig(path, dpi=_DPI)
        except OSError as error:
            raise StoreError(f"cannot write {path}: {error.strerror or error}") from error


def _compare(axes: Axes, compared: Sequence[Compared], label: str) -> None:
    ends = np.array([min(each.measured for each in compared) * 0.7, max(each.measured for each in compared) * 1.4])
    axes.plot(ends, ends, color=INK, lw=0.8)
    axes.fill_between(ends, ends * 0.8, ends * 1.2, color=FAINT, alpha=0.4, lw=0, label="within 20 %")
    for held_out, colour, name in ((False, BLUE, "left out"), (True, ORANGE, "held out")):
        some = [each for each in compared if each.held_out is held_out]
        axes.plot(
            [each.measured for each in some], [each.said for each in some], "o", ms=4, color=colour, label=name
        )
    axes.set(xscale="log", yscale="log", xlabel=f"measured: {label}", ylabel="said by the model")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    axes.legend(loc="upper left")


def _grow(axes: Axes, model: Model, rows: Sequence[Row]) -> None:
    vehicles = np.unique(np.geomspace(100, 100_000, 16).astype(int))
    found = [needs(model, size_of(int(n), max(int(n) // 100, 1), per_agent=min(int(n), 200)), 1) for n in vehicles]
    largest = max(row.run.size.vehicles for row in rows if row.run.kind == "live")
    for role in ROLES:
        axes.plot(vehicles, [each.cpu_cores[role] for each in found], color=_COLOURS[role], label=role)
    axes.plot(vehicles, [each.cores for each in found], color=INK, lw=2, label="all")
    axes.axvline(largest, color=INK, lw=0.8, ls=":")
    axes.text(largest * 1.1, 0.02, "extrapolated", transform=axes.get_xaxis_transform(), va="bottom", fontsize=7)
    axes.set(
        xscale="log", yscale="log", xlabel="vehicles, with a target for each 100", ylabel="cores, on one machine"
    )
    axes.legend(loc="upper left", fontsize=6)
