"""Zones: parts of the terrain, drawn as polygons or painted as masks, with a cost of their own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import assert_never

import numpy as np

from shared_map.arrays import Bools, Floats
from shared_map.terrain.importers.rasters import mask_of
from shared_map.terrain.layers import LETHAL, polygon_mask
from shared_map.terrain.places import MapFrame
from swarm.config.scenario import CostConfig, ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec
from swarm.places import corners_of, extent_of

PREFERRED_FACTOR = np.float32(0.5)
ROUGH_FACTOR = np.float32(2.0)


def paint_zones(
    pace: Floats, zones: Sequence[ZoneConfig], grid: GridSpec, cost: CostConfig, void: Bools | None = None
) -> None:
    """Paint zones onto a pace, in place: step 3 of the merge rule in `layers`."""
    for zone in zones:
        inside = zone_mask(zone, grid)
        match zone.kind:
            case "preferred":
                pace[inside] *= PREFERRED_FACTOR
            case "rough":
                pace[inside] *= ROUGH_FACTOR
            case "road":
                if void is not None:
                    inside &= ~void
                pace[inside] = np.float32(1 / cost.road_speed_m_per_s)
            case "forbidden":
                pass  # painted last
            case _:
                assert_never(zone.kind)
    for zone in zones:
        if zone.kind == "forbidden":
            pace[zone_mask(zone, grid)] = LETHAL


def zone_mask(zone: ZoneConfig, grid: GridSpec, where: str = "zone") -> Bools:
    """Cells whose middle lies in the polygon (even-odd), or that are painted in the mask. Raises TerrainError if it
    covers none."""
    if zone.mask is not None:
        inside = mask_of(Path(zone.mask), grid)
    elif zone.polygon is not None:
        frame = MapFrame(grid)
        corners = corners_of(zone.polygon, frame, f"{where} {zone.name or zone.kind!r}: polygon")
        side_m = grid.resolution_m
        inside = polygon_mask([(col * side_m, row * side_m) for row, col in corners], grid)
        if not inside.any():
            raise TerrainError(
                f"{where} {zone.name or zone.kind!r} covers no cell of the terrain: {extent_of(frame)}"
            )
    else:
        inside = polygon_mask(zone.polygon_m or (), grid)
    if not inside.any():
        width, height = grid.cols * grid.resolution_m, grid.rows * grid.resolution_m
        raise TerrainError(
            f"{where} {zone.name or zone.kind!r} covers no cell: its corners are metres east and south of the"
            f" north-west corner of a terrain of {width:.0f} m x {height:.0f} m"
        )
    return inside
