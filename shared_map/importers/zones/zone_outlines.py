"""Areas of a file as simple rings, for orders to a running swarm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shared_map.importers.zones.on_grid import Placing
from shared_map.importers.zones.vector_files import open_layer, read_features
from swarm.errors import TerrainError
from swarm.grid import GridSpec

MOST_OUTLINES = 50
_TOLERANCES_CELLS = (0.01, 0.05, 0.1, 0.25)
"""How far corners that are left out may lie off the line, until few enough are left."""

Corner = tuple[float, float]


def outlines_of(
    path: Path, grid: GridSpec, layer: str | None, crs: str | None, most_corners: int
) -> list[list[Corner]]:
    """The areas of a file, each as corners (row, col) of a grid; those that overlap are one.

    Parameters
    ----------
    layer, crs : str or None
        As in a scenario's zone.
    most_corners : int
        Of one area.

    Raises
    ------
    TerrainError
        In one sentence: the file cannot be read, holds no area on the terrain, one with a hole, or too many.
    """
    import shapely

    what = f"zone {path}"
    found = open_layer(path, layer, what)
    if found.bounds is None:
        raise TerrainError(f"{what} holds no area")
    placing = Placing(grid, found, crs, 2 * grid.resolution_m)
    areas = []
    for shift, box in placing.boxes(found.bounds):
        shapes = placing.place(read_features(found, box, ()), box, shift)
        for id, why in shapes.unusable.items():
            raise TerrainError(f"{what}: feature {id} cannot be used: {why}; mend or remove it")
        areas.append(shapes.shapes[shapely.get_type_id(shapes.shapes) == 3])
    parts = shapely.get_parts(shapely.union_all(np.concatenate(areas)))
    parts = parts[shapely.area(parts) > 0] if len(parts) else parts
    if not len(parts):
        raise TerrainError(f"{what} holds no area on the terrain")
    if len(parts) > MOST_OUTLINES:
        raise TerrainError(f"{what} holds {len(parts)} areas; at most {MOST_OUTLINES} are ordered at once")
    return [_ring(part, what, most_corners) for part in parts]


def _ring(area: object, what: str, most: int) -> list[Corner]:
    import shapely

    if shapely.get_num_interior_rings(area):
        raise TerrainError(f"{what} holds an area with a hole, which an order cannot have; cut it in two")
    points = np.zeros((0, 2))
    for tolerance in _TOLERANCES_CELLS:
        points = shapely.get_coordinates(shapely.simplify(area, tolerance))[:-1]
        if len(points) <= most:
            return [(float(row), float(col)) for col, row in points]
    raise TerrainError(f"{what} holds an area of {len(points)} corners, at most {most} are ordered; simplify it")
