"""Areas of a file as rings, for orders to a running swarm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from shared_map.importers.zones.burn import Drawn
from shared_map.importers.zones.zone_files import Drawing, FileFacts, closed_shapes, draw_zone
from swarm.config.ground import ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec

Corner = tuple[float, float]
MOST_OUTLINES = 50
_POLYGON = 3
_LEAST_HALF = 0.71
"""Half the least width of a line or a point in cells: the middle of each cell that it crosses is within it, and an
order closes a cell by its middle."""
_TOLERANCES_CELLS = (0.01, 0.05, 0.1, 0.25)
"""Tolerances for dropped corners, tried in order until few enough are left."""


def outlines_of(zone: ZoneConfig, grid: GridSpec, most_corners: int) -> list[list[list[Corner]]]:
    """The areas that a zone's file closes, each as rings of corners (row, col): its border, then its holes.

    Areas that overlap are one.

    Parameters
    ----------
    most_corners : int
        Of one area.

    Raises
    ------
    TerrainError
        A scenario's zone would be refused with the same file, or an area has more than `most_corners` corners, or
        there are too many areas.
    """

    what = f"zone {zone.file}"
    return _outlines(draw_zone(zone, grid, what), grid, what, most_corners)


def all_but(corners: Sequence[Corner], grid: GridSpec, most_corners: int) -> list[list[list[Corner]]]:
    """The areas of a terrain outside of a polygon of corners (row, col), as `outlines_of` has them."""
    import shapely

    kept = shapely.Polygon([(col, row) for row, col in corners])
    if not kept.is_valid:
        raise TerrainError("the polygon which keeps in crosses itself")
    drawing = Drawing(FileFacts("", "", ""), kept=[Drawn(kept, 1.0, 0.0)])
    return _outlines(drawing, grid, "the polygon which keeps in", most_corners)


def _outlines(drawing: Drawing, grid: GridSpec, what: str, most_corners: int) -> list[list[list[Corner]]]:
    import shapely

    drawn = closed_shapes(drawing, grid)
    shapes = np.array([each.shape for each in drawn], object)
    halves = np.maximum([each.width_cells / 2 for each in drawn], _LEAST_HALF)
    areas = np.where(shapely.get_type_id(shapes) == _POLYGON, shapes, shapely.buffer(shapes, halves))
    parts = shapely.get_parts(shapely.union_all(areas))
    if not len(parts):
        raise TerrainError(f"{what} holds no area on the terrain")
    if len(parts) > MOST_OUTLINES:
        raise TerrainError(f"{what} holds {len(parts)} areas; at most {MOST_OUTLINES} are ordered at once")
    return [_rings(part, what, most_corners) for part in parts]


def _rings(area: Any, what: str, most: int) -> list[list[Corner]]:
    import shapely

    count = 0
    for tolerance in _TOLERANCES_CELLS:
        rings = shapely.get_rings(shapely.simplify(area, tolerance))
        corners = [[(float(row), float(col)) for col, row in shapely.get_coordinates(ring)[:-1]] for ring in rings]
        count = sum(map(len, corners))
        if count <= most:
            return corners
    raise TerrainError(f"{what} holds an area of {count} corners, at most {most} are ordered; simplify it")
