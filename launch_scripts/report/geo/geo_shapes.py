"""Areas of equal value of a raster as polygons, in degrees or metres, for GeoJSON and GeoPackage."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.places import MapFrame
from swarm.grid import GridSpec

Ring = NDArray[np.float64]
"""float64 (n, 2): x and y, or longitude and latitude; the last point is the first."""


def areas_of(
    values: NDArray[np.int32], inside: NDArray[np.bool_], frame: MapFrame
) -> Iterator[tuple[int, list[Ring]]]:
    """(value, rings) of each connected area of equal value, in metres of the map: its border, then its holes.

    values, inside  (rows, cols); cells that are not `inside` belong to no area
    """
    from rasterio.features import shapes
    from rasterio.transform import from_origin

    grid = frame.grid
    where = from_origin(grid.west_m, grid.north_m, grid.resolution_m, grid.resolution_m)
    for shape, value in shapes(values, mask=inside, transform=where):
        yield int(value), [wound(np.array(ring, np.float64), n == 0) for n, ring in enumerate(shape["coordinates"])]


def wound(ring: Ring, border: bool) -> Ring:
    """A ring by the right-hand rule (RFC 7946): borders against the clock, holes with it."""
    x, y = ring[:, 0], ring[:, 1]
    # About its own first corner: coordinates of maps are large, and what is subtracted would cancel.
    x, y = x - x[0], y - y[0]
    doubled = float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))
    return ring if (doubled > 0) == border else ring[::-1]


def in_degrees(points: Ring, frame: MapFrame) -> Ring:
    """Longitudes and latitudes of points of the map; without a jump where the map crosses 180 degrees."""
    lat, lon = frame.to_degrees(points[:, 0], points[:, 1])
    return np.stack([np.where(lon < _least_lon(frame), lon + 360.0, lon), lat], axis=1)


def _least_lon(frame: MapFrame) -> float:
    """Smaller longitudes lie beyond 180 degrees."""
    from swarm.places import bounds_of

    box = bounds_of(frame)
    return -360.0 if box is None or box[3] <= 180.0 else 0.0


def polygon(rings: list[Ring], frame: MapFrame) -> dict[str, Any]:
    """A GeoJSON polygon: WGS 84, or metres of the map where the terrain has no place."""
    if frame.grid.crs != "local":
        rings = [wound(in_degrees(ring, frame), n == 0) for n, ring in enumerate(rings)]
    return {"type": "Polygon", "coordinates": [_rounded(ring, frame) for ring in rings]}


def line(points: Ring, frame: MapFrame) -> dict[str, Any]:
    """A GeoJSON line of two points or more, as `polygon`."""
    if frame.grid.crs != "local":
        points = in_degrees(points, frame)
    return {"type": "LineString", "coordinates": _rounded(points, frame)}


def point(there: Ring, frame: MapFrame) -> dict[str, Any]:
    """A GeoJSON point of the first of `there`, as `polygon`."""
    return {"type": "Point", "coordinates": line(there[:1], frame)["coordinates"][0]}


def _rounded(points: Ring, frame: MapFrame) -> Any:
    return points.round(3 if frame.grid.crs == "local" else 8).tolist()


def turns_of(cells: NDArray[np.int64], grid: GridSpec) -> NDArray[np.int64]:
    """The cells of a route at which it turns, and both ends: int64 (n,)."""
    rows, cols = np.divmod(cells, grid.cols)
    turns = np.ones(len(cells), np.bool_)
    turns[1:-1] = (np.diff(rows, 2) != 0) | (np.diff(cols, 2) != 0)
    return cells[turns]
