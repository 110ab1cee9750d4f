"""The swarm's map as ROS has maps, and what RViz and Foxglove draw over it. Pure.

Our row 0 is in the north, that of nav_msgs/OccupancyGrid and map_msgs/OccupancyGridUpdate in the south, so rows are
flipped, once each way: here. A drawing says what to draw in metres of the terrain. All drawings of an instant make
one visualization_msgs/MarkerArray which first deletes the previous drawings: no client has to remember them.

The map itself is a replica that merges the marks of an observer. With the terrain of the run its cost map is that
of every process. Without it the map holds marks alone, and all else is unknown.
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
from shared_map.cost_map import CostMap
from shared_map.keeper.zone_orders import cells_of_zones
from shared_map.replication.replica import MapReplica
from shared_map.terrain.map_frame import middles_of
from shared_map.terrain.terrain import Terrain
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec, Window
from swarm.wire.messages.map_data import MarkSet

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
QUICK_S_PER_M = 0.1
"""The pace of the quickest ground where the terrain is not known: 10 m/s."""
_WHOLE_NS, _CELLS_AT_ONCE = 10 * NS_PER_S, 1 << 20
"""The whole map is due this time after it was put last if anything has changed, and as many times longer as it has
more cells than a million."""
Cells = NDArray[np.int64]
_DELETE_ALL = 3
"""visualization_msgs/Marker.DELETEALL."""
_LINE_CELLS = 0.15
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
        "nav_msgs/msg/OccupancyGrid", header=messages.header(stamp_ns), info=info, data=_from_south(occupancy)
    )


def occupancy_update(messages: RosMessages, stamp_ns: int, occupancy: Occupancy, window: Window) -> Any:
    """map_msgs/OccupancyGridUpdate of a window of the grid: what changes of an OccupancyGrid of single cells.

    occupancy  int8 (rows, cols) of the window, row 0 in the north
    """
    theirs = flipped(window, messages.map.grid.rows)
    return messages.types.make(
        "map_msgs/msg/OccupancyGridUpdate", header=messages.header(stamp_ns), x=theirs.col0, y=theirs.row0,
        width=theirs.col1 - theirs.col0, height=theirs.row1 - theirs.row0, data=_from_south(occupancy),
    )  # fmt: skip


def _from_south(occupancy: Occupancy) -> NDArray[np.int8]:
    return np.ascontiguousarray(occupancy[::-1]).reshape(-1)


# --- the map of the run -------------------------------------------------------------------------------------------


class MapFeed:
    """The map of the run, from sets of marks on.

    grid     of the terrain
    terrain  the run's own; None if it is not on this machine
    """

    def __init__(self, grid: GridSpec, terrain: Terrain | None) -> None:
        self.grid = grid
        self.knows_ground = terrain is not None
        self._whole_ns = _WHOLE_NS * max(1, grid.cells // _CELLS_AT_ONCE)
        self._map = CostMap(_unknown(grid)) if terrain is None else CostMap(terrain, learning=True)
        self._replica = MapReplica(grid, self._map)
        passable = self._map.pace_s_per_m[np.isfinite(self._map.pace_s_per_m)]
        self._best_s_per_m = float(passable.min()) if len(passable) else QUICK_S_PER_M
        self._published_ns: int | None = None
        self._changed = False
        """Changes since the whole map was published last, at `_published_ns`."""
        self._marks: tuple[Cells, Cells] | None = None
        """Cells that are lethal by marks, and those with a pace by marks; None since the map has changed."""
        self._now_ns = 0
        """Time of the last merge, by the swarm's clocks."""

    def merge(self, sets: Sequence[MarkSet], swarm_now_ns: int) -> None:
        """Merges mark sets, and drops expired marks."""
        self._now_ns = swarm_now_ns
        self._replica.tick(swarm_now_ns)
        self._replica.merge(sets, measured=False)

    def take_changes(self) -> list[Window]:
        """Returns the windows that have changed since the last call."""
        windows = self._map.take_dirty()
        if windows:
            self._changed, self._marks = True, None
        return windows

    def whole_is_due(self, now_ns: int) -> bool:
        """Returns True if the whole map is to be published now, and counts it as published.

        now_ns  by a clock that never leaps
        """
        due = self._published_ns is None or (self._changed and now_ns - self._published_ns >= self._whole_ns)
        if due:
            self._published_ns, self._changed = now_ns, False
        return due

    def occupancy(self, window: Window) -> Occupancy:
        """int8 (rows, cols) of a window, row 0 in the north, as `occupancy_of` has it."""
        pace = self._map.pace_s_per_m[window.row0 : window.row1, window.col0 : window.col1]
        return occupancy_of(pace, self._best_s_per_m)

    @property
    def marked(self) -> tuple[Cells, Cells, Cells]:
        """Cells that are marked as lethal, those that are marked with a pace, and those of zones."""
        if self._marks is None:
            now, prior = self._map.ground_s_per_m.reshape(-1), self._map.prior_s_per_m.reshape(-1)
            closed, paced = np.isinf(now) & ~np.isinf(prior), np.isfinite(now) & (now != prior)
            self._marks = np.flatnonzero(closed), np.flatnonzero(paced)
        zones = cells_of_zones(self._replica, self._now_ns).values()
        drawn = np.concatenate([np.empty(0, np.int64), *(each.cells for each in zones if not each.class_number)])
        of_lethal, of_paces = (cells[~np.isin(cells, drawn)] for cells in self._marks)
        return of_lethal, of_paces, drawn


def _unknown(grid: GridSpec) -> Terrain:
    """The terrain of which nothing is known: each pace is NaN, until a mark says one."""
    pace, none = np.full((grid.rows, grid.cols), np.nan, np.float32), np.empty((0, 0), np.uint8)
    return Terrain(grid, none.astype(np.float32), none, pace, none, "", pace)


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
    return Drawing("routes", Form.LINE, points_m, colour, _LINE_CELLS * grid.resolution_m)


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
    return Drawing("windows", Form.LINES, np.concatenate(sides), WINDOW, _LINE_CELLS * grid.resolution_m)


def corners(points_m: Points) -> Points:
    """A line without the points after which it goes on as before: float64 (n, 2) to float64 (at most n, 2)."""
    kept = np.ones(len(points_m), np.bool_)
    kept[1:-1] = np.diff(points_m, 2, axis=0).any(axis=1)
    return points_m[kept]
