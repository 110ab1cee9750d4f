"""A route on a terrain without a swarm: found, described, and written for other programs."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from launch_scripts.launcher.options import find_scenario
from planner_service.route_finder import FoundRoute, RouteFinder
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.places import latitudes_of, middles_of, parse_place
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.errors import ConfigError, TerrainError
from swarm.grid import GridSpec
from swarm.wire.routes import RouteStatus

_BARS = "▁▂▃▄▅▆▇█"
_PROFILE_BARS = 60


@dataclass(frozen=True, eq=False)
class TerrainRoute:
    """A route and the ground along it; arrays have an entry per cell, the start's first.

    at_m         float64 (n,)     metres driven until there
    at_s         float64 (n,)     seconds driven until there
    height_m     float64 (n,)     m; NaN over a void
    x_m, y_m     float64 (n,)     middles of the cells, in metres of the map
    lat, lon     float64 (n,)     degrees; None where the terrain has no place
    """

    name: str
    grid: GridSpec
    found: FoundRoute
    at_m: NDArray[np.float64]
    at_s: NDArray[np.float64]
    height_m: NDArray[np.float64]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    lat: NDArray[np.float64] | None
    lon: NDArray[np.float64] | None

    @property
    def climb_m(self) -> tuple[float, float]:
        """(metres up, metres down) in all."""
        rise = np.diff(self.height_m[np.isfinite(self.height_m)])
        return float(rise[rise > 0].sum()), float(-rise[rise < 0].sum())

    def facts(self) -> dict[str, Any]:
        """Numbers of the route, by name."""
        up_m, down_m = self.climb_m
        return {
            "cost_s": round(self.found.cost_s, 3),
            "lower_bound_s": round(self.found.lower_bound_s, 3),
            "length_m": round(self.found.length_m, 2),
            "steps": len(self.at_m) - 1,
            "up_m": round(up_m, 1),
            "down_m": round(down_m, 1),
            "crs": self.grid.crs,
        }


def find_route(source: str, start: str, end: str) -> TerrainRoute:
    """The cheapest route between two places of a terrain file, a scenario or a built-in one.

    Raises
    ------
    TerrainError, ConfigError
        With one sentence, also if there is no way.
    """
    scenario = find_scenario(source)
    terrain = build_terrain(scenario)
    grid = terrain.grid
    first, last = parse_place(start, grid, "--from"), parse_place(end, grid, "--to")
    finder = finder_for(scenario, terrain, last)
    found = finder.route(*grid.row_col(first))
    if found.status is not RouteStatus.OK:
        raise TerrainError(_why_not(found.status, terrain, first, last))
    return _described(scenario.name, terrain, finder, found, scenario.planner)


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
            row, col = terrain.grid.row_col(cell)
            return f"no route: {option} is on lethal ground (cell:{row},{col}, class {kind})"
    return f"no route ({status}): lethal ground lies between the two places all around"


def _described(
    name: str, terrain: Terrain, finder: RouteFinder, found: FoundRoute, planner: PlannerConfig
) -> TerrainRoute:
    grid = terrain.grid
    cells = found.cells[:, 0] * grid.cols + found.cells[:, 1]
    steps = np.abs(np.diff(found.cells, axis=0)).sum(axis=1)
    diagonal_m = grid.resolution_m * (np.sqrt(2.0) if planner.edge == "octile" else 1.0)
    metres = np.where(steps == 2, diagonal_m, grid.resolution_m)
    # What is left to drive tells what has been driven, by whichever rule the planner counts.
    left_s = finder.cost_to_go_s().reshape(-1)[cells].astype(np.float64)
    x_m, y_m = middles_of(grid, cells)
    lat, lon = (None, None) if grid.crs == "local" else latitudes_of(grid, cells)
    return TerrainRoute(
        name,
        grid,
        found,
        np.concatenate(([0.0], np.cumsum(metres))),
        left_s[0] - left_s,
        terrain.elevation_m.reshape(-1)[cells].astype(np.float64),
        x_m,
        y_m,
        lat,
        lon,
    )


def profile_of(route: TerrainRoute) -> str:
    """Heights along the route as one line of bars."""
    known = np.isfinite(route.height_m)
    if not known.any():
        return ""
    heights = np.interp(np.linspace(0, route.at_m[-1], _PROFILE_BARS), route.at_m[known], route.height_m[known])
    low, high = heights.min(), heights.max()
    levels = np.round((heights - low) / max(high - low, 1e-9) * (len(_BARS) - 1)).astype(int)
    return f"{''.join(_BARS[n] for n in levels)}  {low:.0f} to {high:.0f} m"


# --- for other programs -------------------------------------------------------------------------------------


def write_route(route: TerrainRoute, path: Path) -> None:
    """Write a route in the format of the file's ending. Raises ConfigError on another ending, or without a place
    where the format needs one; TerrainError if the file cannot be written."""
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ConfigError(f"--out {path}: write {', '.join(WRITERS)}")
    try:
        writer(route, path)
    except OSError as error:
        raise TerrainError(f"cannot write {path}: {error.strerror or error}") from error


def _placed(route: TerrainRoute, path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if route.lat is None or route.lon is None:
        raise ConfigError(f"--out {path}: the terrain has no place on earth; write .csv or .geojson")
    return route.lat, route.lon


def _geojson(route: TerrainRoute, path: Path) -> None:
    """GeoJSON is in WGS 84; a terrain without a place is written in its own metres, and says so."""
    across, along = (route.x_m, route.y_m) if route.lon is None or route.lat is None else (route.lon, route.lat)
    heights = np.where(np.isfinite(route.height_m), route.height_m, 0.0)
    points = [[round(x, 8), round(y, 8), round(z, 2)] for x, y, z in zip(across, along, heights, strict=True)]
    properties = {"name": route.name, **route.facts(), "at_s": [round(float(at), 2) for at in route.at_s]}
    feature = {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "LineString", "coordinates": points},
    }
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8")


def _gpx(route: TerrainRoute, path: Path) -> None:
    lat, lon = _placed(route, path)
    root = ElementTree.Element(
        "gpx", version="1.1", creator="terrain-swarm", xmlns="http://www.topografix.com/GPX/1/1"
    )
    track = ElementTree.SubElement(root, "trk")
    ElementTree.SubElement(track, "name").text = route.name
    segment = ElementTree.SubElement(track, "trkseg")
    for n in range(len(lat)):
        point = ElementTree.SubElement(segment, "trkpt", lat=f"{lat[n]:.8f}", lon=f"{lon[n]:.8f}")
        if np.isfinite(route.height_m[n]):
            ElementTree.SubElement(point, "ele").text = f"{route.height_m[n]:.2f}"
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _kml(route: TerrainRoute, path: Path) -> None:
    lat, lon = _placed(route, path)
    root = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    mark = ElementTree.SubElement(ElementTree.SubElement(root, "Document"), "Placemark")
    ElementTree.SubElement(mark, "name").text = route.name
    line = ElementTree.SubElement(mark, "LineString")
    ElementTree.SubElement(line, "tessellate").text = "1"
    heights = np.where(np.isfinite(route.height_m), route.height_m, 0.0)
    points = zip(lon, lat, heights, strict=True)
    ElementTree.SubElement(line, "coordinates").text = " ".join(f"{x:.8f},{y:.8f},{z:.2f}" for x, y, z in points)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _csv(route: TerrainRoute, path: Path) -> None:
    columns: dict[str, Any] = {
        "row": route.found.cells[:, 0],
        "col": route.found.cells[:, 1],
        "x_m": route.x_m.round(3),
        "y_m": route.y_m.round(3),
        **(
            {} if route.lat is None or route.lon is None else {"lat": route.lat.round(8), "lon": route.lon.round(8)}
        ),
        "height_m": route.height_m.round(2),
        "at_m": route.at_m.round(2),
        "at_s": route.at_s.round(2),
    }
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(columns)
        rows.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


WRITERS: Mapping[str, Callable[[TerrainRoute, Path], None]] = {
    ".geojson": _geojson,
    ".gpx": _gpx,
    ".kml": _kml,
    ".csv": _csv,
}
"""Ending -> what writes it."""
