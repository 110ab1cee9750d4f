"""A route on a terrain without a swarm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from launch_scripts.commands.routes.route_files import DescribedRoute, metres_along
from launch_scripts.launcher.options import find_scenario
from planner_service.route_finder import FoundRoute, RouteFinder
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.places import MapFrame
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.errors import TerrainError
from swarm.places import cell_of, read_place, written
from swarm.wire.routes import RouteStatus


def find_route(source: str, start: str, end: str, preset: str | None = None) -> DescribedRoute:
    """The cheapest route between two places of a terrain file, a scenario or a built-in one.

    Raises
    ------
    TerrainError, ConfigError
        With one sentence, also if there is no way.
    """
    scenario, terrain, first, last = between(source, start, end, preset)
    finder = finder_for(scenario, terrain, last)
    found = finder.route(*terrain.grid.row_col(first))
    if found.status is not RouteStatus.OK:
        raise TerrainError(_why_not(found.status, terrain, first, last))
    return _described(scenario.name, terrain, finder, found, scenario.planner)


class Ends(NamedTuple):
    """Two cells of a terrain, and the scenario that says what driving on it costs."""

    scenario: Scenario
    terrain: Terrain
    first: int
    last: int


def between(source: str, start: str, end: str, preset: str | None = None) -> Ends:
    """The terrain of a file, a scenario or a built-in one, and the cells of two places on it.

    Places are read before the terrain is built: a mistake in one takes no time. Raises ConfigError or TerrainError.
    """
    places = read_place(start, "--from"), read_place(end, "--to")
    scenario = find_scenario(source, preset)
    terrain = build_terrain(scenario)
    frame = MapFrame(terrain.grid)
    return Ends(scenario, terrain, cell_of(places[0], frame, "--from"), cell_of(places[1], frame, "--to"))


def finder_for(scenario: Scenario, terrain: Terrain, target: int) -> RouteFinder:
    """Routes to a cell by the scenario's rules."""
    names = ("neighbours", "edge", "corner_cutting", "length_weight")
    rules = {name: getattr(scenario.planner, name) for name in names}
    resolution_m, climb = terrain.grid.resolution_m, terrain.climb
    target_cell = terrain.grid.row_col(target)
    return RouteFinder(terrain.pace_s_per_m, target_cell, resolution_m=resolution_m, climb=climb, **rules)


def _why_not(status: RouteStatus, terrain: Terrain, first: int, last: int) -> str:
    lethal = terrain.lethal.reshape(-1)
    for option, cell in (("--from", first), ("--to", last)):
        if lethal[cell]:
            kind = TerrainClass(terrain.classes.reshape(-1)[cell]).name.lower()
            return f"no route: {option} is on lethal ground, {written(MapFrame(terrain.grid), cell)}, class {kind}"
    return f"no route ({status}): lethal ground lies between the two places all around"


def _described(
    name: str, terrain: Terrain, finder: RouteFinder, found: FoundRoute, planner: PlannerConfig
) -> DescribedRoute:
    grid = terrain.grid
    cells = found.cells[:, 0] * grid.cols + found.cells[:, 1]
    # What is left to drive tells what has been driven, by whichever rule the planner counts.
    left_s = finder.cost_to_go_s().reshape(-1)[cells].astype(np.float64)
    return DescribedRoute(
        name=name,
        grid=grid,
        cells=cells,
        cost_s=found.cost_s,
        lower_bound_s=found.lower_bound_s,
        at_m=metres_along(grid, cells, np.sqrt(2.0) if planner.edge == "octile" else 1.0),
        at_s=left_s[0] - left_s,
        height_m=terrain.elevation_m.reshape(-1)[cells].astype(np.float64),
        terrain=terrain,
    )
