"""The picture of docs/air.md: how far drones come in still air, and in wind.

python -m docs.generate.wind_picture [FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from launch_scripts.observe.palette import BLUE, INK, ORANGE, RED, STYLE
from planner_service.route_finder import RouteFinder
from shared_map.class_grounds import class_terrains
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.classes import WindConfig
from swarm.config.load import load_scenario

FILE = Path(__file__).parents[2] / "docs" / "images" / "wind.png"
_SCENARIO = Path(__file__).parents[2] / "launch_scripts" / "scenarios" / "aloft.toml"
_WINDS = WindConfig(), WindConfig(speed_m_per_s=9.0, from_deg=250.0)
_TARGET_M = 15_000.0, 16_500.0
_STARTS_M = (4_000.0, 6_000.0), (5_000.0, 26_000.0), (26_000.0, 7_000.0), (27_000.0, 25_000.0)
_MINUTES = 4


def draw(file: Path) -> None:
    """Write the picture: times to one target over the terrain of `aloft`, and routes there."""
    scenario = load_scenario(_SCENARIO)
    common = build_terrain(scenario)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 6.4), layout=ConstrainedLayoutEngine(h_pad=0.12))
        for axes, wind in zip(figure.subplots(1, 2), _WINDS, strict=True):
            blown = msgspec.structs.replace(scenario, wind=wind)
            _draw_times(axes, common, class_terrains(blown, common, ["drone"])["drone"])
            if wind.speed_m_per_s:
                axes.set_title(f"Wind of {wind.speed_m_per_s:g} m/s from {wind.from_deg:g} degrees")
                _draw_arrow(axes, wind)
            else:
                axes.set_title("Still air")
        figure.savefig(file, dpi=110)


def _draw_times(axes: Axes, common: Terrain, flown: Terrain) -> None:
    grid = common.grid
    target, *starts = (
        (int(down_m / grid.resolution_m), int(right_m / grid.resolution_m))
        for down_m, right_m in (_TARGET_M, *_STARTS_M)
    )
    finder = RouteFinder(flown.pace_s_per_m, target, resolution_m=grid.resolution_m, climb=flown.climb)
    shade = LightSource(315, 45).hillshade(
        common.elevation_m, vert_exag=3, dx=grid.resolution_m, dy=grid.resolution_m
    )
    axes.imshow(shade, cmap="Greys_r", vmin=-0.4, vmax=1.2, alpha=0.55)
    axes.imshow(np.where(np.isfinite(flown.pace_s_per_m), np.nan, 1.0), cmap="copper", vmin=0, vmax=2)
    minutes = finder.cost_to_go_s() / 60
    lines = axes.contour(
        np.where(np.isfinite(minutes), minutes, np.nan), levels=range(_MINUTES, 60, _MINUTES), colors=BLUE,
        linewidths=1.1,
    )  # fmt: skip
    axes.clabel(lines, fmt="%d min", fontsize=8)
    for start in starts:
        pulled = finder.pull(finder.route(*start))
        axes.plot(*pulled.turns.T[::-1], color=ORANGE, linewidth=1.6)
        axes.annotate(
            f"{pulled.cost_s / 60:.1f} min", start[::-1], color=INK, ha="center", va="bottom",
            bbox={"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 1.5},
        )  # fmt: skip
    axes.plot(*target[::-1], color=RED, markeredgecolor=INK, markersize=9, marker="o")
    axes.set_xticks([])
    axes.set_yticks([])


def _draw_arrow(axes: Axes, wind: WindConfig) -> None:
    towards = np.radians(wind.from_deg + 180)
    axes.annotate(
        "", (0.88 + 0.06 * np.sin(towards), 0.07 + 0.06 * np.cos(towards)),
        (0.88 - 0.06 * np.sin(towards), 0.07 - 0.06 * np.cos(towards)),
        xycoords="axes fraction", arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 2.5},
    )  # fmt: skip


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
