"""Driving on a terrain without a swarm: a route, how long it takes from everywhere, where good ways lead.

A route, also one of a running swarm, is written for other programs by the one exporter, or as a picture.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray

from launch_scripts.observe.palette import format_length
from launch_scripts.report import MISSIONS, gis_formats
from planner_service.route_finder import RouteFinder
from shared_map.array_files import Floats
from shared_map.terrain.map_frame import MapFrame, middles_of
from shared_map.terrain.pace_layers import TerrainClass, nearest_open
from shared_map.terrain.slope_and_climb import cost_sentence
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.terrain.zones import closing_zones
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.errors import ConfigError, TerrainError
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.places import cell_of, fields_of, read_place, written
from swarm.wire.route_columns import RouteStatus


@dataclass(frozen=True, eq=False)
class DescribedRoute:
    """A route and the ground along it; arrays have an entry per cell, the start's first.

    cells        int64 (n,)       flat indices
    at_m         float64 (n,)     metres driven until there
    at_s         float64 (n,)     seconds driven until there; None if not known
    height_m     float64 (n,)     m, NaN over a void; None if not known
    terrain      what it lies on, for a picture; None if not at hand
    rule         sentence of the speed and slope rule by which it costs; "" if not at hand
    """

    name: str
    grid: GridSpec
    cells: NDArray[np.int64]
    cost_s: float
    lower_bound_s: float
    at_m: NDArray[np.float64]
    at_s: NDArray[np.float64] | None = None
    height_m: NDArray[np.float64] | None = None
    terrain: Terrain | None = None
    rule: str = ""

    @property
    def length_m(self) -> float:
        return float(self.at_m[-1])

    @property
    def gap(self) -> float:
        """Cost over proven lower bound."""
        return max(self.cost_s / self.lower_bound_s, 1.0) if self.lower_bound_s > 0 else np.inf

    @property
    def climb_m(self) -> tuple[float, float] | None:
        """(metres up, metres down) in all."""
        if self.height_m is None:
            return None
        rise = np.diff(self.height_m[np.isfinite(self.height_m)])
        return float(rise[rise > 0].sum()), float(np.abs(rise[rise < 0]).sum())

    def metres(self) -> NDArray[np.float64]:
        """float64 (2, n): x and y in metres of the map."""
        return middles_of(self.grid, self.cells)

    def facts(self) -> dict[str, Any]:
        """Numbers of the route, by name."""
        climb, frame = self.climb_m, MapFrame(self.grid)
        ups = {} if climb is None else {"up_m": round(climb[0], 1), "down_m": round(climb[1], 1)}
        return {
            "cost_s": round(self.cost_s, 3),
            "lower_bound_s": round(self.lower_bound_s, 3),
            "length_m": round(self.length_m, 2),
            "steps": len(self.cells) - 1,
            **ups,
            "rule": f"{gis_formats.COSTS} {self.rule}".strip(),
            "crs": self.grid.crs,
            "from": fields_of(frame, int(self.cells[0])),
            "to": fields_of(frame, int(self.cells[-1])),
        }


def metres_along(grid: GridSpec, cells: NDArray[np.int64], diagonal: float = np.sqrt(2.0)) -> NDArray[np.float64]:
    """float64 (n,): metres from the first cell to each; `diagonal` is the length of a diagonal step, in cells."""
    rows, cols = np.divmod(cells, grid.cols)
    down, right = np.abs(np.diff(rows)), np.abs(np.diff(cols))
    steps = np.where((down == 1) & (right == 1), diagonal, np.hypot(down, right)) * grid.resolution_m
    return np.concatenate(([0.0], np.cumsum(steps)))


def layers_of(route: DescribedRoute, ending: str) -> list[gis_formats.Layer]:
    """The route as a line; in a table its cells instead, and in a GeoPackage these, too."""
    x_m, y_m = route.metres()
    steps: dict[str, NDArray[Any]] = {"at_m": route.at_m.round(2)}
    if route.at_s is not None:
        steps["at_s"] = route.at_s.round(2)
    xy_m = np.stack([x_m, y_m], axis=1)
    if route.height_m is not None and np.isfinite(route.height_m).all():
        xy_m = np.column_stack([xy_m, route.height_m.round(2)])
    kinds: dict[type, gis_formats.FieldKind] = {str: "text", int: "int", float: "real", dict: "json", list: "json"}
    values = {"name": route.name, **route.facts(), "resolution_m": route.grid.resolution_m}
    if ending == ".geojson":
        values |= {name: each.tolist() for name, each in steps.items()}
    # A line has two points at least, even for a vehicle that is already there.
    time_ns = None if route.at_s is None or len(xy_m) < 2 else (route.at_s * 1e9).round().astype(np.int64)
    timed = time_ns if ending == ".gpx" else None  # from 1970 on: when it will be driven is not known
    whole = gis_formats.Feature([xy_m if len(xy_m) > 1 else xy_m[[0, 0]]], values, timed)
    line = gis_formats.Layer(
        "route", "LineString", {name: kinds[type(v)] for name, v in values.items()}, [whole], gis_formats.COSTS
    )
    if ending not in (".csv", ".gpkg"):
        return [line]
    rows, cols = np.divmod(route.cells, route.grid.cols)
    columns: dict[str, NDArray[Any]] = {"row": rows, "col": cols}
    if route.height_m is not None:
        columns["height_m"] = route.height_m.round(2)
    columns |= steps
    records = zip(*(column.tolist() for column in columns.values()), strict=True)
    points = [
        gis_formats.Feature([place], dict(zip(columns, each, strict=True)))
        for place, each in zip(xy_m[:, None, :2], records, strict=True)
    ]
    types: dict[str, gis_formats.FieldKind] = {
        name: "int" if name in ("row", "col") else "real" for name in columns
    }
    cells = gis_formats.Layer("route_cells", "Point", types, points, gis_formats.COSTS)
    return [cells] if ending == ".csv" else [line, cells]


def write_route(route: DescribedRoute, path: Path) -> None:
    """Writes a route in the format of the file's ending. Raises ConfigError or StoreError in one sentence, also
    without a place on Earth or a terrain where the format needs one."""
    ending = path.suffix.lower()
    if ending in MISSIONS:
        gis_formats.check_on_earth(path, MapFrame(route.grid))
        x_m, y_m = middles_of(route.grid, gis_formats.turns_of(route.cells, route.grid))
        gis_formats.write_mission(
            path, [(lat, lon) for lat, lon in MapFrame(route.grid).to_degrees(x_m, y_m).T.tolist()]
        )
        return
    if ending != ".png":
        gis_formats.write_layers(path, layers_of(route, ending), MapFrame(route.grid))
        return
    if route.terrain is None or route.height_m is None:
        raise ConfigError(
            f"--out {path}: a picture needs the terrain; find the route with --terrain, or write .geojson"
        )
    from launch_scripts.report.plots_and_figures import draw_route

    up_m, down_m = route.climb_m or (0.0, 0.0)
    title = f"{route.name}: {format_length(float(f'{route.length_m:.4g}'))} in {route.cost_s:.0f} s"
    title += f", {up_m:.0f} m up, {down_m:.0f} m down"
    draw_route(route.terrain, path, title, route.metres(), route.at_m, route.height_m)


def find_route(scenario: Scenario, start: str, end: str) -> DescribedRoute:
    """The cheapest route between two places of a scenario's terrain.

    Raises
    ------
    TerrainError, ConfigError
        With one sentence, also if there is no way.
    """
    terrain, first, last = between(scenario, start, end)
    grid, finder = terrain.grid, finder_for(scenario, terrain)
    found = finder.between(grid.row_col(first), grid.row_col(last))
    _check_open(scenario, terrain, first, "--from", last)
    _check_open(scenario, terrain, last, "--to", first)
    if found.status is not RouteStatus.OK:
        raise TerrainError(f"no route ({found.status}): lethal ground lies between the two places all around")
    cells = found.cells[:, 0] * grid.cols + found.cells[:, 1]
    at_m = metres_along(grid, cells, np.sqrt(2.0) if scenario.planner.edge == "octile" else 1.0)
    steps_s = np.diff(at_m) * terrain.pace_s_per_m.reshape(-1)[cells[1:]]
    if terrain.climb is not None:
        steps_s *= terrain.climb.along(cells[:-1], cells[1:])
    return DescribedRoute(
        name=scenario.name,
        grid=grid,
        cells=cells,
        cost_s=found.cost_s,
        lower_bound_s=found.lower_bound_s,
        at_m=at_m,
        at_s=np.concatenate(([0.0], np.cumsum(steps_s))),
        height_m=terrain.elevation_m.reshape(-1)[cells].astype(np.float64),
        terrain=terrain,
        rule=cost_sentence(scenario.cost),
    )


def print_route(found: DescribedRoute, out: Path | None, as_json: bool) -> None:
    """Prints a route, and writes it where that is asked for."""
    if out is not None:
        write_route(found, out)
    facts = found.facts()
    if as_json:
        typer.echo(json.dumps(facts))
        return
    frame = MapFrame(found.grid)
    typer.echo(f"from {written(frame, int(found.cells[0]))}\nto {written(frame, int(found.cells[-1]))}")
    # A route from a place to itself takes no time, which is the optimum.
    above = max(found.gap - 1, 0) if found.cost_s > 0 else 0.0
    climbed = f"{facts['up_m']:.0f} m up and {facts['down_m']:.0f} m down"
    typer.echo(f"{facts['length_m']:.0f} m in {facts['cost_s']:.0f} s, {climbed}, {facts['steps']} steps")
    typer.echo(
        f"proven to be at most {above:.2%} above the optimum\n{found.rule}, cells of {found.grid.resolution_m:g} m"
    )
    if out is not None:
        typer.echo(f"route: {out}")


def between(scenario: Scenario, start: str, end: str) -> tuple[Terrain, int, int]:
    """Returns the terrain of a scenario, with the cells of two places on it.

    The places are parsed before the terrain is built, so that a mistake in one is reported at once. Raises
    ConfigError or TerrainError.
    """
    places = read_place(start, "--from"), read_place(end, "--to")
    terrain = build_terrain(scenario)
    frame = MapFrame(terrain.grid)
    return terrain, cell_of(places[0], frame, "--from"), cell_of(places[1], frame, "--to")


def finder_for(scenario: Scenario, terrain: Terrain, target: int | None = None) -> RouteFinder:
    """Routes by the scenario's rules, to a cell or between any."""
    names = ("neighbours", "edge", "corner_cutting", "length_weight")
    rules = {name: getattr(scenario.planner, name) for name in names}
    resolution_m, climb = terrain.grid.resolution_m, terrain.climb
    target_cell = None if target is None else terrain.grid.row_col(target)
    return RouteFinder(terrain.pace_s_per_m, target_cell, resolution_m=resolution_m, climb=climb, **rules)


def _check_open(scenario: Scenario, terrain: Terrain, cell: int, option: str, other: int) -> None:
    """Raises TerrainError, which names the nearest place with a way to the other one, if a place is lethal."""
    lethal = terrain.lethal.reshape(-1)
    if not lethal[cell]:
        return
    grid, frame = terrain.grid, MapFrame(terrain.grid)
    kind = [*TerrainClass][terrain.classes.reshape(-1)[cell]].name.lower()
    seconds = terrain.pace_s_per_m if lethal[other] else finder_for(scenario, terrain, other).cost_to_go_s()
    fault = f"{option} is on lethal ground, {written(frame, cell)}, class {kind}: no way leads there"
    if closing := closing_zones(scenario.cost, grid, cell):
        fault += f"; closed by {' and '.join(closing)} (cost.zones)"
    else:
        fault += f"; ground above {scenario.cost.max_slope_deg:g} degrees is lethal (--preset, cost.max_slope_deg)"
    if (near := nearest_open(np.isfinite(seconds), *grid.row_col(cell))) is not None:
        fault += f"; the nearest place that can be reached is {written(frame, grid.cell(*near))}"
    raise TerrainError(fault)


# --- from everywhere --------------------------------------------------------------------------------------------

_MOST_BANDS = 200
"""Most areas of a file: more cannot be distinguished on a map."""
_BAND_S = 600.0
"""Time between two areas, unless --every-s says it. Chosen, not measured."""
_SLACK_BANDS = 5
"""Areas of a corridor, unless --every-s says it. Chosen, not measured."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Driving time from each cell.

    seconds    float32 (rows, cols), s; inf where there is no way. To the place; of a corridor, from one place
               to the other through the cell
    rule       sentence of the speed and slope rule by which it costs
    fastest_s  of a corridor, what the best way takes; None else
    """

    grid: GridSpec
    seconds: Floats
    rule: str
    fastest_s: float | None = None

    @property
    def share(self) -> float:
        """Share of all cells from which a path exists."""
        return float(np.isfinite(self.seconds).mean())

    def quantiles_s(self) -> tuple[float, float]:
        """(median, longest) of all cells from which there is a way."""
        known = self.seconds[np.isfinite(self.seconds)]
        return float(np.median(known)), float(known.max())


def reach(scenario: Scenario, place: str) -> Reach:
    """Computes the driving time to a location from every cell. Raises TerrainError or ConfigError with one
    sentence."""
    goal = read_place(place, "--to")
    terrain = build_terrain(scenario)
    seconds = _to(scenario, terrain, cell_of(goal, MapFrame(terrain.grid), "--to"), "--to")
    return Reach(terrain.grid, seconds, cost_sentence(scenario.cost))


def corridor(scenario: Scenario, start: str, end: str, slack: float) -> Reach:
    """Cells through which a way between two places leads that takes at most `slack` (a share) more than the best.

    Each cell has the time of a way that passes it and can be driven: to the cell along the cheapest way back from
    it, reversed, and on by the cheapest way. A step costs by the cell that it enters, so a reversed way may take a
    little longer than the best one: no cell is in the corridor that should not be, a few at its border may be not.

    Raises
    ------
    ConfigError, TerrainError
        With one sentence, also if there is no way.
    """
    terrain, first, last = between(scenario, start, end)
    if terrain.climb is not None or scenario.planner.length_weight:
        raise ConfigError("--from: no corridors with cost.directional = true or with planner.length_weight")
    back_s = _to(scenario, terrain, first, "--from")
    finder = finder_for(scenario, terrain, last)
    best = finder.route(*terrain.grid.row_col(first))
    if best.status is not RouteStatus.OK:
        _check_open(scenario, terrain, last, "--to", first)
        raise TerrainError("no corridor: lethal ground lies between the two places all around")
    through = finder.cost_to_go_s() + there_s(
        back_s, terrain.pace_s_per_m, terrain.grid.resolution_m, scenario.planner
    )
    through[best.cells[:, 0], best.cells[:, 1]] = best.cost_s
    through[through > best.cost_s * (1 + slack)] = np.inf
    return Reach(terrain.grid, through.astype(np.float32), cost_sentence(scenario.cost), best.cost_s)


def there_s(back_s: Floats, pace: Floats, resolution_m: float, rules: PlannerConfig) -> NDArray[np.float64]:
    """float64 (rows, cols), s: what the cheapest ways to a cell take when they are driven the other way round.

    back_s  float32 (rows, cols), s: cost-to-go of that cell; inf where there is no way
    pace    float32 (rows, cols), s/m
    """
    rows, cols = back_s.shape
    wide = np.pad(back_s.astype(np.float64), 1, constant_values=np.inf)
    paces = np.pad(pace.astype(np.float64), 1, constant_values=np.inf)
    cells = np.arange(rows * cols).reshape(rows, cols)
    least, parent = np.full((rows, cols), np.inf), cells.copy()
    step_s = np.zeros((rows, cols))

    def shifted(of: NDArray[np.float64], down: int, right: int) -> NDArray[np.float64]:
        return of[1 + down : 1 + down + rows, 1 + right : 1 + right + cols]

    for direction in range(0, 8, 1 if rules.neighbours == 8 else 2):
        down, right = STEP_ROW[direction], STEP_COL[direction]
        diagonal = direction % 2 == 1
        length_m = resolution_m * (np.sqrt(2.0) if diagonal and rules.edge == "octile" else 1.0)
        there, entered = shifted(wide, down, right), shifted(paces, down, right)
        whole = np.where(np.isfinite(there) & (there < back_s), there + length_m * entered, np.inf)
        if diagonal and not rules.corner_cutting:
            whole[np.isinf(shifted(paces, down, 0)) | np.isinf(shifted(paces, 0, right))] = np.inf
        nearer = whole < least
        least[nearer], parent[nearer] = whole[nearer], cells[nearer] + down * cols + right
        step_s[nearer] = length_m * pace[nearer]
    # Each cell's steps are summed by doubling: after n turns over 2^n of them.
    taken_s, ahead = step_s.reshape(-1), parent.reshape(-1)
    while (ahead[ahead] != ahead).any():
        taken_s, ahead = taken_s + taken_s[ahead], ahead[ahead]
    taken_s[np.isinf(back_s.reshape(-1))] = np.inf
    return taken_s.reshape(rows, cols)


def _to(scenario: Scenario, terrain: Terrain, cell: int, option: str) -> Floats:
    """float32 (rows, cols), s: from everywhere to a cell."""
    _check_open(scenario, terrain, cell, option, cell)
    return finder_for(scenario, terrain, cell).cost_to_go_s()


def write_reach(found: Reach, path: Path, every_s: float | None, slack: float) -> None:
    """Writes seconds as a GeoTIFF (-1 where there is no way), or areas of equal time in a format of the exporter.

    every_s  how far apart in time the borders of areas are; None: ten minutes; for a corridor, a fifth of its slack
    slack    of a corridor

    Raises ConfigError on another ending or too many areas, StoreError if the file cannot be written.
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        seconds = np.where(np.isfinite(found.seconds), found.seconds, np.float32(-1))
        description = f"{gis_formats.COSTS} {found.rule}"
        texts, tags = ["seconds of travel, -1 no way"], {"TIFFTAG_IMAGEDESCRIPTION": description}
        gis_formats.write_raster(path, [seconds], found.grid, descriptions=texts, unit="s", tags=tags, nodata=-1.0)
        return
    if every_s is None:
        every_s = _BAND_S if found.fastest_s is None else max(found.fastest_s * slack / _SLACK_BANDS, 1e-3)
    many = (found.quantiles_s()[1] - (found.fastest_s or 0.0)) / every_s
    if many > _MOST_BANDS:
        raise ConfigError(f"--every-s {every_s:g} makes {many:.0f} areas, at most {_MOST_BANDS}: ask for fewer")
    # Areas between lines of equal time; of a corridor, of equal time lost against the best way.
    known = np.isfinite(found.seconds)
    above_s = np.where(known, found.seconds - np.float32(found.fastest_s or 0.0), 0)
    bands: NDArray[np.int32] = np.maximum(np.floor(above_s / every_s), 0).astype(np.int32)
    areas = [
        gis_formats.Feature(rings, {"from_s": band * every_s, "to_s": (band + 1) * every_s})
        for band, rings in gis_formats.areas_of(bands, known, found.grid)
    ]
    layer = gis_formats.Layer("reach", "Polygon", {"from_s": "real", "to_s": "real"}, areas, gis_formats.COSTS)
    gis_formats.write_layers(path, [layer], MapFrame(found.grid))
