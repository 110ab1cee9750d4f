"""Areas of a file as rings, for orders to a running swarm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from shared_map.importers.zones.burn import Drawn
from shared_map.importers.zones.zone_files import Drawing, FileFacts, closed_shapes, draw_zone
from swarm.config.ground import ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec

Corner = tuple[float, float]
MOST_OUTLINES = 50
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
        A scenario's zone would be refused with the same file, or a line or a point has no width, or an area has
        more than `most_corners` corners, or there are too many areas.
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
    if any(each.shape.geom_type != "Polygon" and not each.width_cells for each in drawn):
        raise TerrainError(
            f"{what} holds a line or a point without a width, which an order cannot close; buffer it"
        )
    areas = [shapely.buffer(each.shape, each.width_cells / 2) if each.width_cells else each.shape for each in drawn]
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
