"""Coordinates of a terrain's cells: in metres of its map, and as latitudes and longitudes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm.errors import ConfigError
from swarm.grid import GridSpec


@dataclass(frozen=True, eq=False)
class MapFrame:
    """A grid and the way between its metres and degrees: a `swarm.places.Frame`. rasterio is imported on first use.

    Degrees are WGS 84 on the Earth, and those of its own ellipsoid on another planet or moon.
    """

    grid: GridSpec

    def from_wgs84(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        x_m, y_m = self.to_map([lat_deg], [lon_deg])[:, 0]
        return float(x_m), float(y_m)

    def to_wgs84(self, x_m: float, y_m: float) -> tuple[float, float]:
        lat, lon = self.to_degrees([x_m], [y_m])[:, 0]
        return float(lat), float(lon)

    def to_map(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> NDArray[np.float64]:
        """float64 (2, n): x and y in metres of the map; not finite where the map's system is not defined."""
        return _moved(self.degrees, self.system, lon_deg, lat_deg)

    def to_degrees(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """float64 (2, n): latitudes and longitudes; not finite where the map's system is not defined."""
        return _moved(self.system, self.degrees, x_m, y_m)[::-1]

    @cached_property
    def system(self) -> Any:
        """The CRS of the map, as rasterio has it. Raises ConfigError if it has none, or one that is not known."""
        import rasterio
        from rasterio.errors import CRSError

        if self.grid.crs == "local":
            raise ConfigError(
                'the terrain has no place on Earth (its crs is "local"); say where it lies with terrain.crs'
            )
        try:
            return rasterio.CRS.from_user_input(self.grid.crs)
        except (CRSError, ValueError) as error:
            raise ConfigError(f"the terrain's crs {self.grid.crs[:60]!r} is no coordinate system") from error

    @cached_property
    def degrees(self) -> Any:
        """The CRS of latitudes and longitudes on the body on which the map lies."""
        from shared_map.importers.georeference import degrees_of

        return degrees_of(self.system)


def middles_of(grid: GridSpec, cells: ArrayLike) -> NDArray[np.float64]:
    """float64 (2, n): x and y of the middles of cells, in metres of the map."""
    rows, cols = np.divmod(np.asarray(cells, np.int64), grid.cols)
    x_m = grid.west_m + (cols + 0.5) * grid.resolution_m
    y_m = grid.north_m - (rows + 0.5) * grid.resolution_m
    return np.array([x_m, y_m], np.float64)


def _moved(source: Any, target: Any, xs: ArrayLike, ys: ArrayLike) -> NDArray[np.float64]:
    """float64 (2, n): NaN where a system says that there is no such place."""
    from rasterio._err import CPLE_BaseError
    from rasterio.warp import transform

    x, y = (np.atleast_1d(np.asarray(values, np.float64)) for values in (xs, ys))
    try:
        return np.array(transform(source, target, x, y), np.float64)
    except CPLE_BaseError:
        if len(x) < 2:
            return np.full((2, len(x)), np.nan)
    return np.concatenate([_moved(source, target, x[n], y[n]) for n in range(len(x))], axis=1)
