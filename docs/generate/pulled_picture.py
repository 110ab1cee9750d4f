"""The picture of docs/pulled.md: routes over neighbours, and the same pulled straight.

python -m docs.generate.pulled_picture [FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from launch_scripts.observe.palette import BLUE, INK, ORANGE, RED, STYLE
from planner_service.route_finder import RouteFinder
from shared_map.arrays import Floats
from shared_map.terrain.terrain import build_terrain
from swarm.config.load import load_scenario

FILE = Path(__file__).parents[2] / "docs" / "images" / "pulled.png"
_SCENARIO = Path(__file__).parents[2] / "launch_scripts" / "scenarios" / "jacksboro.toml"
_CROP = slice(150, 250), slice(120, 220)
_TARGET = (48, 52)
_STARTS = ((4, 6), (8, 70), (40, 97), (92, 88), (95, 40), (70, 3))


def draw(file: Path) -> None:
    """Write the picture: open ground, and a part of jacksboro's terrain."""
    open_ground = np.full((100, 100), 0.1, np.float32)
    open_ground[30:60, 25:32] = open_ground[66:72, 40:80] = np.inf
    real = build_terrain(load_scenario(_SCENARIO)).pace_s_per_m[_CROP]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 6.2), layout=ConstrainedLayoutEngine(h_pad=0.12))
        for axes, (title, pace) in zip(
            figure.subplots(1, 2),
            (("Open ground with two walls", open_ground), ("The Jacksboro fault", real)),
            strict=True,
        ):
            saved = _draw_routes(axes, np.ascontiguousarray(pace))
            axes.set_title(f"{title}: {100 * saved:.1f} % less time")
            axes.set_xticks([])
            axes.set_yticks([])
        figure.savefig(file, dpi=110)


def _draw_routes(axes: Axes, pace: Floats) -> float:
    """Draw routes of one map; returns the mean share of their time that pulling saves."""
    shade = np.where(np.isfinite(pace), pace, np.nan)
    axes.imshow(np.log(shade), cmap="Greys", alpha=0.55)
    axes.imshow(np.where(np.isfinite(pace), np.nan, 1.0), cmap="copper", vmin=0, vmax=2)
    finder, saved = RouteFinder(pace, _TARGET), []
    for start in _STARTS:
        route = finder.route(*start)
        if route.status.value != "ok":
            continue
        pulled = finder.pull(route)
        saved.append(1 - pulled.cost_s / pulled.grid_cost_s)
        first = len(saved) == 1
        axes.plot(*route.cells.T[::-1], color=ORANGE, linewidth=1.6, label="over neighbours" if first else None)
        axes.plot(
            *pulled.turns.T[::-1], color=BLUE, linewidth=1.6, marker="o", markersize=3,
            label="pulled" if first else None,
        )  # fmt: skip
    axes.plot(
        *_TARGET[::-1], color=RED, markeredgecolor=INK, markersize=9, marker="o", linestyle="", label="target"
    )  # fmt: skip
    axes.legend(loc="upper right", framealpha=0.9, frameon=True)
    return float(np.mean(saved))


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
