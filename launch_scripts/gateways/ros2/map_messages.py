"""The swarm's map as ROS has maps, and what RViz and Foxglove draw over it. Pure.

Our row 0 is in the north, that of nav_msgs/OccupancyGrid and map_msgs/OccupancyGridUpdate in the south, so rows are
flipped, once each way: here. A drawing says what to draw in metres of the terrain. All drawings of an instant make
one visualization_msgs/MarkerArray which first deletes the previous drawings: no client has to remember them.
"""

from __future__ import annotations

import enum
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.ros_messages import RosMessages
from shared_map.terrain.map_frame import middles_of
from swarm.grid import GridSpec, Window

UNKNOWN = -1
WORST = 98
LETHAL = 100
"""Nav2's words for values: 99, "inscribed", is left out, as inflation of the swarm's map is lethal already."""
Occupancy = NDArray[np.int8]
Points = NDArray[np.float64]
Colour = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""
ROUTE: Colour = (0.16, 0.55, 0.95, 0.9)
WINDOW: Colour = (0.95, 0.75, 0.1, 0.8)
LETHAL_MARK: Colour = (0.85, 0.1, 0.15, 0.7)
PACE_MARK: Colour = (0.95, 0.55, 0.1, 0.6)
ZONE: Colour = (0.6, 0.2, 0.75, 0.9)
_DELETE_ALL = 3
_HAIR = 0.15
"""Width of lines, in sides of a cell."""


# --- grids --------------------------------------------------------------------------------------------------------


def occupancy_of(pace_s_per_m: NDArray[np.floating[Any]], best_s_per_m: float) -> Occupancy:
    """int8 of the same shape and order: what per cent of the best speed is lost in each cell, up to 98.

    0 is as quick as can be, 50 half as quick, 98 fifty times slower or worse. It depends on no other cell, so a
    window of an update has the values that it would have in the whole map. Lethal (inf) is 100, NaN unknown, -1.

    pace_s_per_m  float, s/m; inf where no vehicle may go, NaN where it is unknown
    best_s_per_m  pace of the quickest ground there may be, above 0
    """
    pace = np.asarray(pace_s_per_m)
    known = np.where(np.isfinite(pace) & (pace > best_s_per_m), pace, best_s_per_m)
    occupancy = np.minimum(np.rint(100 - 100 * best_s_per_m / known), WORST).astype(np.int8)
    occupancy[np.isposinf(pace)] = LETHAL
    occupancy[np.isnan(pace)] = UNKNOWN
    return occupancy


def flipped(window: Window, rows: int) -> Window:
    """Returns a window of a grid with `rows` rows, with its rows counted from the other side. Its own inverse."""
    return Window(rows - window.row1, window.col0, rows - window.row0, window.col1)


def occupancy_grid(messages: RosMessages, stamp_ns: int, occupancy: Occupancy, side: int = 1) -> Any:
    """nav_msgs/OccupancyGrid, in the map frame.

    occupancy  int8 (rows, cols), row 0 in the north: of the whole grid, or of blocks of it
    side       cells to the side of a block; the last blocks in the south and east may reach beyond the grid
    """
    grid = messages.map.grid
    rows, cols = occupancy.shape
    west_m, south_m = messages.map.origin_m
    beyond_m = (rows * side - grid.rows) * grid.resolution_m
    info = {
        "map_load_time": messages.stamp(stamp_ns), "resolution": grid.resolution_m * side,
        "width": cols, "height": rows, "origin": messages.pose(west_m, south_m - beyond_m),
    }  # fmt: skip
    return messages.types.make(
        "nav_msgs/msg/OccupancyGrid", header=messages.header(stamp_ns), info=info, data=_flat(occupancy)
    )


def occupancy_update(messages: RosMessages, stamp_ns: int, occupancy: Occupancy, window: Window) -> Any:
    """map_msgs/OccupancyGridUpdate of a window of the grid: what changes of an OccupancyGrid of single cells.

    occupancy  int8 (rows, cols) of the window, row 0 in the north
    """
    theirs = flipped(window, messages.map.grid.rows)
    return messages.types.make(
        "map_msgs/msg/OccupancyGridUpdate", header=messages.header(stamp_ns), x=theirs.col0, y=theirs.row0,
        width=theirs.col1 - theirs.col0, height=theirs.row1 - theirs.row0, data=_flat(occupancy),
    )  # fmt: skip


def _flat(occupancy: Occupancy) -> NDArray[np.int8]:
    return np.ascontiguousarray(occupancy[::-1]).reshape(-1)


# --- drawings -----------------------------------------------------------------------------------------------------


class Form(enum.IntEnum):
    """Form of drawn points: the numbers are ROS's."""

    LINE = 4
    """Through all points."""
    LINES = 5
    """From the first to the second, from the third to the fourth, and so on."""
    CUBES = 6
    """One around each."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """One thing to draw.

    layer     group that is switched on and off together, such as "routes" or "zones"
    points_m  float64 (n, 2): x, y
    size_m    width of a line, or side of a cube
    """

    layer: str
    form: Form
    points_m: Points
    colour: Colour
    size_m: float


def marker_array(messages: RosMessages, stamp_ns: int, drawings: Iterable[Drawing]) -> Any:
    """visualization_msgs/MarkerArray of all that is drawn now, in place of all that was drawn before. A drawing
    without a point is left out, and a line of one point, of which RViz complains."""
    header = messages.header(stamp_ns)
    markers: list[dict[str, Any]] = [{"header": header, "action": _DELETE_ALL}]
    numbers: Counter[str] = Counter()
    for each in drawings:
        if len(each.points_m) < (1 if each.form is Form.CUBES else 2):
            continue
        x_m, y_m = messages.map.to_ros(*np.asarray(each.points_m, np.float64).T)
        markers.append(
            {
                "header": header, "ns": each.layer, "id": numbers[each.layer], "type": int(each.form),
                "pose": messages.pose(*messages.map.origin_m), "scale": dict.fromkeys("xyz", each.size_m),
                "color": dict(zip("rgba", each.colour, strict=True)),
                "points": [{"x": x, "y": y} for x, y in zip(x_m.tolist(), y_m.tolist(), strict=True)],
            }
        )  # fmt: skip
        numbers[each.layer] += 1
    return messages.types.make("visualization_msgs/msg/MarkerArray", markers=markers)


def route(grid: GridSpec, points_m: Points, colour: Colour = ROUTE) -> Drawing:
    """The way of a vehicle: float64 (n, 2), x, y."""
    return Drawing("routes", Form.LINE, points_m, colour, _HAIR * grid.resolution_m)


def marked_cells(
    grid: GridSpec, lethal: Sequence[int], slower: Sequence[int], zones: Sequence[int]
) -> list[Drawing]:
    """Cells that are marked as lethal, those that have a pace of their own, and those of zones."""
    return [
        Drawing(layer, Form.CUBES, middles_of(grid, cells).T, colour, grid.resolution_m)
        for layer, cells, colour in (
            ("marks", lethal, LETHAL_MARK), ("marks", slower, PACE_MARK), ("zones", zones, ZONE),
        )
    ]  # fmt: skip


def windows(grid: GridSpec, windows: Iterable[Window]) -> Drawing:
    """Outlines of windows of cells: four sides each."""
    sides: list[Points] = [np.empty((0, 2), np.float64)]
    for each in windows:
        west, east = (grid.west_m + col * grid.resolution_m for col in (each.col0, each.col1))
        north, south = (grid.north_m - row * grid.resolution_m for row in (each.row0, each.row1))
        corners = np.array([(west, north), (east, north), (east, south), (west, south)], np.float64)
        sides.append(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).reshape(-1, 2))
    return Drawing("windows", Form.LINES, np.concatenate(sides), WINDOW, _HAIR * grid.resolution_m)


def corners(points_m: Points) -> Points:
    """A line without the points after which it goes on as before: float64 (n, 2) to float64 (at most n, 2)."""
    kept = np.ones(len(points_m), np.bool_)
    kept[1:-1] = np.diff(points_m, 2, axis=0).any(axis=1)
    return points_m[kept]
