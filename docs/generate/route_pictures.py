"""The pictures of docs/behaviour/any-angle.md and fly.md: routes on terrain, as users of `swarm.client` find them.

python -m docs.generate.route_pictures [NAME ...]
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from docs.generate.method_pictures import LABEL, draw_ground, draw_named, draw_route, draw_target, maps
from docs.generate.printed import Pace, Place
from launch_scripts.observe.palette import BLUE, INK, ORANGE, hillshade
from planner_service.route_finder import RouteFinder
from shared_map.terrain.terrain import build_terrain
from shared_map.vehicle_class_grounds import class_terrains
from swarm.config.scenario_files import load_scenario
from swarm.config.vehicle_classes import WindConfig

_SCENARIOS = Path(__file__).parents[2] / "launch_scripts" / "scenarios"


def pulled() -> Figure:
    """Routes over neighbours and the same pulled straight: on open ground, and on a part of jacksboro's terrain."""
    open_ground = np.full((100, 100), 0.1, np.float32)
    open_ground[30:60, 25:32] = open_ground[66:72, 40:80] = np.inf
    real = build_terrain(load_scenario(_SCENARIOS / "jacksboro.toml")).pace_s_per_m[150:250, 120:220]
    figure, panels = maps(2, (12.0, 6.2))
    grounds = (("Open ground with two walls", open_ground), ("The Jacksboro fault", np.ascontiguousarray(real)))
    for axes, (title, pace) in zip(panels, grounds, strict=True):
        axes.set_title(f"{title}: {100 * _draw_pulled(axes, pace):.1f} % less time")
    panels[0].legend(loc="upper right", frameon=True)
    return figure


def _draw_pulled(axes: Axes, pace: Pace) -> float:
    """Draws routes of one map; returns the mean share of their time which pulling saves."""
    target: Place = (48, 52)
    draw_ground(axes, pace)
    saved: list[float] = []
    finder = RouteFinder(pace, target)
    for start in ((4, 6), (8, 70), (40, 97), (92, 88), (95, 40), (70, 3)):
        route = finder.route(*start)
        if route.status.value == "ok":
            straight = finder.pull(route)
            draw_route(axes, route.cells, ORANGE, None if saved else "over neighbours")
            axes.plot(*straight.turns.T[::-1], color=BLUE, lw=1.1, label=None if saved else "pulled")
            saved.append(1 - straight.cost_s / straight.grid_cost_s)
    draw_target(axes, target)
    return float(np.mean(saved))


def wind() -> Figure:
    """Minutes which drones of `aloft` fly to one target, and routes there, in still air and in wind."""
    scenario = load_scenario(_SCENARIOS / "aloft.toml")
    common = build_terrain(scenario)
    side_m = common.grid.resolution_m
    figure, panels = maps(2, (12.0, 6.4))
    for axes, blown in zip(panels, (WindConfig(), WindConfig(speed_m_per_s=9.0, from_deg=250.0)), strict=True):
        flown = class_terrains(msgspec.structs.replace(scenario, wind=blown), common, ["drone"])["drone"]
        places_km = ((15.0, 16.5), (4.0, 6.0), (5.0, 26.0), (26.0, 7.0), (27.0, 25.0))
        target, *starts = ((int(row * 1000 / side_m), int(col * 1000 / side_m)) for row, col in places_km)
        finder = RouteFinder(flown.pace_s_per_m, target, resolution_m=side_m, climb=flown.climb)
        axes.imshow(hillshade(common.elevation_m, side_m), cmap="Greys_r", vmin=-0.4, vmax=1.2, alpha=0.55)
        minutes = np.ma.masked_invalid(finder.cost_to_go_s() / 60)
        axes.clabel(axes.contour(minutes, levels=range(4, 60, 4), colors=BLUE, linewidths=1.1), fmt="%d min")
        for start in starts:
            straight = finder.pull(finder.route(*start))
            draw_route(axes, straight.turns, ORANGE)
            text = f"{straight.cost_s / 60:.1f} min"
            axes.annotate(text, start[::-1], color=INK, ha="center", va="bottom", bbox=LABEL)
        draw_target(axes, target)
        axes.set_title("Still air")
        if blown.speed_m_per_s:
            axes.set_title(f"Wind of {blown.speed_m_per_s:g} m/s from {blown.from_deg:g} degrees")
            way = np.radians(blown.from_deg + 180)
            axes.quiver(0.9, 0.07, np.sin(way), np.cos(way), pivot="middle", scale=12, transform=axes.transAxes)
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {"pulled": pulled, "wind": wind}
"""Picture, by its place below docs/images without .png -> what draws it."""

if __name__ == "__main__":
    draw_named(PICTURES)
