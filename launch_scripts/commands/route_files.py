"""A route and the ground along it, written for other programs by the one exporter, or as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.palette import said_length
from launch_scripts.report.exporter import COSTS, Feature, FieldKind, Layer, write_layers
from shared_map.terrain.map_frame import MapFrame, middles_of
from shared_map.terrain.terrain import Terrain
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.places import fields_of

_BARS = "▁▂▃▄▅▆▇█"
_PROFILE_BARS = 60


@dataclass(frozen=True, eq=False)
class DescribedRoute:
    """A route and the ground along it; arrays have an entry per cell, the start's first.

    cells        int64 (n,)       flat indices
    at_m         float64 (n,)     metres driven until there
    at_s         float64 (n,)     seconds driven until there; None if not known
    height_m     float64 (n,)     m, NaN over a void; None if not known
    terrain      what it lies on, for a picture; None if not at hand
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


def profile_of(route: DescribedRoute) -> str:
    """Heights along the route as one line of bars."""
    heights = np.full(len(route.cells), np.nan) if route.height_m is None else route.height_m
    known = np.isfinite(heights)
    if not known.any():
        return ""
    heights = np.interp(np.linspace(0, route.at_m[-1], _PROFILE_BARS), route.at_m[known], heights[known])
    low, high = heights.min(), heights.max()
    levels = np.round((heights - low) / max(high - low, 1e-9) * (len(_BARS) - 1)).astype(int)
    return f"{''.join(_BARS[n] for n in levels)}  {low:.0f} to {high:.0f} m"


def layers_of(route: DescribedRoute, ending: str) -> list[Layer]:
    """The route as a line; in a table its cells instead, and in a GeoPackage these, too."""
    x_m, y_m = route.metres()
    steps: dict[str, NDArray[Any]] = {"at_m": route.at_m.round(2)}
    if route.at_s is not None:
        steps["at_s"] = route.at_s.round(2)
    xy_m = np.stack([x_m, y_m], axis=1)
    if route.height_m is not None and np.isfinite(route.height_m).all():
        xy_m = np.column_stack([xy_m, route.height_m.round(2)])
    kinds: dict[type, FieldKind] = {str: "text", int: "int", float: "real", dict: "json", list: "json"}
    values = {"name": route.name, **route.facts()}
    if ending == ".geojson":
        values |= {name: each.tolist() for name, each in steps.items()}
    # A line has two points at least, also of somebody who is there already.
    whole = Feature([xy_m if len(xy_m) > 1 else xy_m[[0, 0]]], values)
    line = Layer("route", "LineString", {name: kinds[type(v)] for name, v in values.items()}, [whole], COSTS)
    if ending not in (".csv", ".gpkg"):
        return [line]
    rows, cols = np.divmod(route.cells, route.grid.cols)
    columns: dict[str, NDArray[Any]] = {"row": rows, "col": cols}
    if route.height_m is not None:
        columns["height_m"] = route.height_m.round(2)
    columns |= steps
    told = zip(*(column.tolist() for column in columns.values()), strict=True)
    cells = Layer(
        "route_cells",
        "Point",
        {name: "int" if name in ("row", "col") else "real" for name in columns},
        [
            Feature([place], dict(zip(columns, each, strict=True)))
            for place, each in zip(xy_m[:, None, :2], told, strict=True)
        ],
        COSTS,
    )
    return [cells] if ending == ".csv" else [line, cells]


def write_route(route: DescribedRoute, path: Path) -> None:
    """Writes a route in the format of the file's ending. Raises ConfigError or StoreError in one sentence, also
    without a place on Earth or a terrain where the format needs one."""
    ending = path.suffix.lower()
    if ending != ".png":
        write_layers(path, layers_of(route, ending), MapFrame(route.grid))
        return
    if route.terrain is None or route.height_m is None:
        raise ConfigError(
            f"--out {path}: a picture needs the terrain; find the route with --terrain, or write .geojson"
        )
    from launch_scripts.report.terrain_figure import draw_route

    up_m, down_m = route.climb_m or (0.0, 0.0)
    title = f"{route.name}: {said_length(float(f'{route.length_m:.4g}'))} in {route.cost_s:.0f} s"
    title += f", {up_m:.0f} m up, {down_m:.0f} m down"
    draw_route(route.terrain, path, title, route.metres(), route.at_m, route.height_m)
