"""The swarm's map as ROS has maps: nav_msgs/OccupancyGrid and map_msgs/OccupancyGridUpdate. Pure.

Our row 0 is in the north, theirs in the south, so rows are flipped, once each way: here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.messages import RosMessages
from swarm.grid import Window

UNKNOWN = -1
WORST = 98
LETHAL = 100
"""Nav2's words for values: 99, "inscribed", is left out, as inflation of the swarm's map is lethal already."""
Occupancy = NDArray[np.int8]


def occupancy_of(pace_s_per_m: NDArray[np.floating[Any]], best_s_per_m: float) -> Occupancy:
    """int8 of the same shape and order: what per cent of the best speed is lost in each cell, up to 98.

    0 is as quick as can be, 50 half as quick, 98 fifty times slower or worse. It depends on no other cell, so a
    window of an update has the values that it would have in the whole map. Lethal (inf) is 100, NaN unknown, -1.

    pace_s_per_m  float, s/m; inf where nobody may go, NaN where nothing is known
    best_s_per_m  pace of the quickest ground there may be, above 0
    """
    pace = np.asarray(pace_s_per_m)
    known = np.where(np.isfinite(pace) & (pace > best_s_per_m), pace, best_s_per_m)
    occupancy = np.minimum(np.rint(100 - 100 * best_s_per_m / known), WORST).astype(np.int8)
    occupancy[np.isposinf(pace)] = LETHAL
    occupancy[np.isnan(pace)] = UNKNOWN
    return occupancy


def flipped(window: Window, rows: int) -> Window:
    """A window of a grid of so many rows, with its rows counted from the other side. Its own inverse."""
    return Window(rows - window.row1, window.col0, rows - window.row0, window.col1)


def occupancy_grid(
    messages: RosMessages, stamp_ns: int, occupancy: Occupancy, side: int = 1, *, loaded_ns: int | None = None
) -> Any:
    """nav_msgs/OccupancyGrid, in the map frame.

    occupancy  int8 (rows, cols), row 0 in the north: of the whole grid, or of blocks of it
    side       cells to the side of a block; the last blocks in the south and east may reach beyond the grid
    loaded_ns  when the map was made; at the stamp without it
    """
    grid = messages.map.grid
    rows, cols = occupancy.shape
    if (rows, cols) != (-(-grid.rows // side), -(-grid.cols // side)):
        raise ValueError(f"{rows} x {cols} blocks of {side} cells are not those of {grid.rows} x {grid.cols} cells")
    beyond_m = (rows * side - grid.rows) * grid.resolution_m
    origin = messages.pose(messages.map.origin_m[0], messages.map.origin_m[1] - beyond_m)
    info = messages.types.make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=messages.time(stamp_ns if loaded_ns is None else loaded_ns),
        resolution=grid.resolution_m * side,
        width=cols,
        height=rows,
        origin=origin,
    )
    return messages.types.make(
        "nav_msgs/msg/OccupancyGrid", header=messages.header(stamp_ns), info=info, data=_flat(occupancy)
    )


def occupancy_update(messages: RosMessages, stamp_ns: int, occupancy: Occupancy, window: Window) -> Any:
    """map_msgs/OccupancyGridUpdate of a window of the grid: what changes of an OccupancyGrid of single cells.

    occupancy  int8 (rows, cols) of the window, row 0 in the north
    """
    grid = messages.map.grid
    if occupancy.shape != (window.row1 - window.row0, window.col1 - window.col0):
        raise ValueError(f"{occupancy.shape} cells do not fill {window}")
    theirs = flipped(window, grid.rows)
    return messages.types.make(
        "map_msgs/msg/OccupancyGridUpdate",
        header=messages.header(stamp_ns),
        x=theirs.col0,
        y=theirs.row0,
        width=theirs.col1 - theirs.col0,
        height=theirs.row1 - theirs.row0,
        data=_flat(occupancy),
    )


def rows_from_north(data: NDArray[np.int8], height: int, width: int) -> Occupancy:
    """int8 (height, width) with row 0 in the north, of the data of a grid that ROS made. Raises ValueError if they
    are not as many."""
    return np.asarray(data, np.int8).reshape(height, width)[::-1]


def cell_at(map: RosMap, x_m: float, y_m: float) -> int:
    """Our cell under a place of the map frame, -1 outside the grid."""
    return map.grid.cell_at(*map.to_terrain(x_m, y_m))


def _flat(occupancy: Occupancy) -> NDArray[np.int8]:
    return np.ascontiguousarray(occupancy[::-1]).reshape(-1)
