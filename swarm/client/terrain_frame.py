"""The frame of a swarm's terrain: metres, cells and, where the terrain has coordinates, WGS84."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from textwrap import shorten
from typing import Any

from swarm.errors import ArgumentError, ConfigError, missing
from swarm.grid import GridSpec, brief, is_of_earth, real, whole
from swarm.places import Given, cell_of, written
from swarm.wire.messages.processes import RunInfo

WGS84 = "EPSG:4326"
Point = tuple[float, float]
_Transform = Callable[[float, float], Point]


class Frame:
    """Coordinates on a swarm's terrain. `x_m` grows to the east and `y_m` to the north, in the coordinate system
    `crs` ("local" is metres from anywhere). A cell is `row * cols + col`, row 0 in the north.

    grid     shape and place of the terrain
    traffic  the cells of right of way: the terrain's, or smaller ones
    """

    def __init__(self, grid: GridSpec, parts: int = 1) -> None:
        self.grid, self.traffic = grid, grid.traffic(parts)

    @classmethod
    def of(cls, info: RunInfo) -> Frame:
        """Builds the frame from the reply of a process of the run. Raises ConfigError if it has no grid."""
        try:
            crs = info.crs or "local"
            grid = GridSpec(info.rows, info.cols, info.resolution_m, info.west_m, info.north_m, crs)
            return cls(grid, info.traffic_parts or 1)
        except ValueError as error:
            raise ConfigError(f"{info.role} {info.id} answers with a grid that is none: {error}") from error

    @property
    def crs(self) -> str:
        return self.grid.crs

    def cell(self, x_m: float, y_m: float) -> int:
        """The cell at a place. Raises ConfigError on a location outside the terrain and on a value that is not a
        number."""
        grid, x_m, y_m = self.grid, real("x_m", x_m), real("y_m", y_m)
        if (cell := grid.cell_at(x_m, y_m)) < 0:
            east_m = grid.west_m + grid.cols * grid.resolution_m
            south_m = grid.north_m - grid.rows * grid.resolution_m
            crs = shorten(self.crs, 40, placeholder=" ...")
            raise ConfigError(
                f"x_m {x_m:.10g}, y_m {y_m:.10g} is outside the terrain, which has x_m {grid.west_m:.10g} ... "
                f"{east_m:.10g} and y_m {south_m:.10g} ... {grid.north_m:.10g} in {crs}"
            )
        return cell

    def cell_named(self, place: Given) -> int:
        """The cell of a place as commands and scenarios have it: `"48.27,9.44"` (latitude, longitude), `"xy:X,Y"`
        in metres of the map, `"cell:ROW,COL"`, or `(row, col)`. Raises ConfigError in one sentence."""
        return cell_of(place, self, "the place")

    def written(self, cell: int) -> str:
        """A cell for people, in each form that `cell_named` reads. Raises as `centre_m` and `to_wgs84`."""
        return written(self, checked_cell(self.grid, cell))

    def centre_m(self, cell: int) -> Point:
        """(x_m, y_m) of the middle of a cell. Raises ConfigError on one outside the terrain."""
        return self.grid.centre_m(checked_cell(self.grid, cell))

    def cells_within(self, x_m: float, y_m: float, radius_m: float) -> list[int]:
        """Returns the cells whose middle is within `radius_m` of a place inside the terrain, and its own cell."""
        at, step, radius_m = self.cell(x_m, y_m), self.grid.resolution_m, real("radius_m", radius_m)
        if not 0 <= radius_m < math.inf:
            raise ConfigError(f"radius_m is {radius_m!r}, expected metres, 0 or more")
        window = self.grid.around(at, min(math.ceil(radius_m / step), max(self.grid.rows, self.grid.cols)))
        cells = (
            row * self.grid.cols + col
            for row in range(window.row0, window.row1)
            for col in range(window.col0, window.col1)
        )
        return [each for each in cells if each == at or math.dist(self.centre_m(each), (x_m, y_m)) <= radius_m]

    def from_wgs84(self, lat_deg: float, lon_deg: float) -> Point:
        """Returns (x_m, y_m) of a latitude and longitude in degrees. Raises ConfigError if they are out of range,
        if the terrain has no geographic reference, or if pyproj (extra `wgs84`) is not installed."""
        if not (-90 <= real("lat_deg", lat_deg) <= 90 and -360 <= real("lon_deg", lon_deg) <= 360):
            raise ConfigError(f"lat_deg {lat_deg!r}, lon_deg {lon_deg!r} is no place on Earth")
        return self._transforms[0](lon_deg, lat_deg)

    def to_wgs84(self, x_m: float, y_m: float) -> Point:
        """(lat_deg, lon_deg) of a place. Raises as `from_wgs84`."""
        lon_deg, lat_deg = self._transforms[1](real("x_m", x_m), real("y_m", y_m))
        return lat_deg, lon_deg

    @cached_property
    def _transforms(self) -> tuple[_Transform, _Transform]:
        if self.crs == "local":
            raise ConfigError('this terrain has no coordinates (its crs is "local"): give x_m and y_m')
        try:
            from pyproj import CRS, Transformer
            from pyproj.exceptions import CRSError
        except ModuleNotFoundError as error:
            raise ConfigError(f"latitudes and longitudes need {missing('pyproj')}") from error
        try:
            system = CRS.from_user_input(self.crs)
            degrees = _degrees_of(system)
            there = Transformer.from_crs(degrees, system, always_xy=True)
            back = Transformer.from_crs(system, degrees, always_xy=True)
        except CRSError as error:
            raise ConfigError(f"pyproj does not know the terrain's crs {self.crs[:60]!r}") from error
        return there.transform, back.transform


def _degrees_of(system: Any) -> str:
    """Returns the geographic system of the planet or moon of a coordinate system: WGS 84 on the Earth."""
    ellipsoid = system.ellipsoid
    if ellipsoid is None or is_of_earth(ellipsoid.semi_major_metre):
        return WGS84
    return f"+proj=longlat +a={ellipsoid.semi_major_metre!r} +b={ellipsoid.semi_minor_metre!r} +no_defs"


def checked_cell(grid: GridSpec, given: int) -> int:
    """A cell of a grid. Raises ConfigError on one outside the terrain, and on a value that is not a cell."""
    cell = whole("cell", given)
    if not 0 <= cell < grid.cells:
        raise ConfigError(f"cell {cell} is outside the terrain of {grid.rows} x {grid.cols} cells")
    return cell


def listed(name: str, given: Any) -> list[Any]:
    """The items of a list, array or set. Raises ArgumentError on anything else, such as text; `name` is that of the
    value."""
    if isinstance(given, str | bytes) or not hasattr(given, "__iter__") or getattr(given, "ndim", 1) == 0:
        raise ArgumentError(f"{name} is {brief(given)}, expected a list")
    return list(given)


def point(name: str, given: Any) -> Point:
    """The two numbers of a place in metres. Raises ArgumentError on anything else."""
    if len(pair := listed(name, given)) != 2:
        raise ArgumentError(f"{name} is {brief(given)}, expected x_m and y_m")
    return real(name, pair[0]), real(name, pair[1])
