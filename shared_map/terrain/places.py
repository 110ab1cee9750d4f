"""Places that people name: latitude and longitude, map coordinates, cells; and cells as latitude and longitude."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm.errors import ConfigError
from swarm.grid import GridSpec

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_PLACE = re.compile(rf"(?:(cell|xy|latlon):)?\s*({_NUMBER})\s*,\s*({_NUMBER})\s*")
FORMS = "LAT,LON in degrees, xy:X,Y in metres of the map, or cell:ROW,COL"


def parse_place(text: str, grid: GridSpec, what: str) -> int:
    """The cell that somebody names.

    Parameters
    ----------
    text : str
        ``46.8,9.85`` is a latitude and longitude in degrees (WGS 84) where the terrain has a place,
        ``xy:779600,190400`` map coordinates, ``cell:40,200`` a row and a column. Where the terrain has no
        place, two plain numbers are metres of its own.
    what : str
        Names the place in errors.

    Raises
    ------
    ConfigError
        In one sentence: the text is no place, is outside the terrain, or needs coordinates that the terrain lacks.
    """
    match = _PLACE.fullmatch(text)
    if match is None:
        raise ConfigError(f"{what} is {text[:60]!r}; expected {FORMS}")
    kind = match[1] or ("xy" if grid.crs == "local" else "latlon")
    first, second = float(match[2]), float(match[3])
    if kind == "latlon":
        if grid.crs == "local":
            raise ConfigError(f"{what} is {text[:60]!r}, and the terrain has no place; give xy:X,Y or cell:ROW,COL")
        if not (abs(first) <= 90 and abs(second) <= 360):
            raise ConfigError(f"{what} is {text[:60]!r}: no latitude and longitude; write xy:X,Y for metres")
        x_m, y_m = (float(value) for value in to_map(grid, np.array([first]), np.array([second]))[:, 0])
    else:
        x_m, y_m = first, second
    if kind == "cell":
        row, col = math.floor(first), math.floor(second)
    else:
        row = math.floor((grid.north_m - y_m) / grid.resolution_m) if math.isfinite(y_m) else -1
        col = math.floor((x_m - grid.west_m) / grid.resolution_m) if math.isfinite(x_m) else -1
    if not grid.inside(row, col):
        raise ConfigError(f"{what} is {text[:60]!r}, outside the terrain: {extent_of(grid)}")
    return grid.cell(row, col)


def extent_of(grid: GridSpec) -> str:
    """Where a terrain lies, for sentences."""
    east_m, south_m = grid.west_m + grid.cols * grid.resolution_m, grid.north_m - grid.rows * grid.resolution_m
    text = f"x {grid.west_m:.0f} to {east_m:.0f}, y {south_m:.0f} to {grid.north_m:.0f}"
    text = f"{grid.rows} x {grid.cols} cells, {text}"
    if grid.crs == "local":
        return text
    corners = np.array([0, grid.cols - 1, (grid.rows - 1) * grid.cols, grid.cells - 1])
    lat, lon = latitudes_of(grid, corners)
    return f"{text}, latitude {lat.min():.4f} to {lat.max():.4f}, longitude {lon.min():.4f} to {lon.max():.4f}"


def middles_of(grid: GridSpec, cells: NDArray[Any]) -> NDArray[np.float64]:
    """float64 (2, n): x and y of the middles of cells, in metres of the map."""
    rows, cols = np.divmod(np.asarray(cells, np.int64), grid.cols)
    x_m = grid.west_m + (cols + 0.5) * grid.resolution_m
    y_m = grid.north_m - (rows + 0.5) * grid.resolution_m
    return np.array([x_m, y_m], np.float64)


def latitudes_of(grid: GridSpec, cells: NDArray[Any]) -> NDArray[np.float64]:
    """float64 (2, n): latitude and longitude of the middles of cells, degrees. The terrain has a place."""
    lon, lat = _transformed(grid.crs, _degrees_of(grid), *middles_of(grid, cells))
    return np.array([lat, lon], np.float64)


def to_map(grid: GridSpec, lat_deg: NDArray[np.float64], lon_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64 (2, n): x and y in metres of the map; inf where the map's system is not defined."""
    return np.array(_transformed(_degrees_of(grid), grid.crs, lon_deg, lat_deg), np.float64)


def _degrees_of(grid: GridSpec) -> Any:
    """Degrees on the body on which the terrain lies."""
    import rasterio

    from shared_map.terrain.importers.georeference import degrees_of

    return degrees_of(rasterio.CRS.from_user_input(grid.crs))


def _transformed(source: Any, target: Any, xs: Any, ys: Any) -> tuple[list[float], list[float]]:
    import rasterio
    from rasterio.warp import transform

    one, other = (rasterio.CRS.from_user_input(crs) for crs in (source, target))
    moved = transform(one, other, list(xs), list(ys))
    return moved[0], moved[1]
