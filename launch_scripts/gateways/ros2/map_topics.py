"""The topics of the map: the grid, windows that change, and what RViz draws over it. Core: no bus, no clock."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.actions import Action, Channel, Put
from launch_scripts.gateways.ros2.grids import occupancy_grid, occupancy_update
from launch_scripts.gateways.ros2.map_feed import MapFeed
from launch_scripts.gateways.ros2.markers import ZONE, Drawing, Form, MarkerBook, marked_cells, route, windows
from launch_scripts.gateways.ros2.messages import RosMessages
from launch_scripts.gateways.ros2.moving import Moving
from launch_scripts.gateways.ros2.topics import TopicRow
from shared_map.cost_map import merged
from swarm.grid import GridSpec, Window

MOST_CUBES = 5000
"""Marked cells that are drawn, of each kind; all of them are in the map."""


class MapTopics:
    """rows  of the table that are forwarded"""

    def __init__(self, rows: Mapping[str, TopicRow], messages: RosMessages, feed: MapFeed) -> None:
        self._rows = rows
        self._messages = messages
        self._feed = feed
        self._book = MarkerBook(messages)
        self._fresh: list[Window] = []
        """Windows that have changed since markers were put last."""
        self._changed: list[Window] = []
        """Windows that have changed since the map or its updates were put last."""

    def tell(
        self, due: Collection[str], moving: Iterable[Moving], now_ns: int, stamp_ns: int, swarm_now_ns: int
    ) -> Iterator[Action]:
        """Messages of the rows that are due."""
        if "map" in due or "map_updates" in due:
            yield from self._map(due, now_ns, stamp_ns)
        if "markers" in due:
            drawn = [*self._routes(moving), *self._marks(), *self._zones(swarm_now_ns)]
            drawn.append(windows(self._feed.grid, "changed", self._fresh))
            self._fresh = []
            yield self._put("markers", self._book.array(stamp_ns, drawn))

    def _map(self, due: Collection[str], now_ns: int, stamp_ns: int) -> Iterator[Action]:
        change = self._feed.change(now_ns, whole="map" in due)
        if change.whole:
            self._changed = []
            whole = self._feed.occupancy(self._feed.grid.window)
            yield self._put("map", occupancy_grid(self._messages, stamp_ns, whole))
        self._fresh += change.windows
        if "map_updates" in self._rows:
            self._changed = merged(change.windows, self._changed)
        if "map_updates" in due:
            changed, self._changed = self._changed, []
            for window in changed:
                cells = self._feed.occupancy(window)
                yield self._put("map_updates", occupancy_update(self._messages, stamp_ns, cells, window))

    def _routes(self, moving: Iterable[Moving]) -> Iterator[Drawing]:
        for each in moving:
            if len(each.route):
                yield route(self._feed.grid, each.name, corners(each.route))

    def _marks(self) -> list[Drawing]:
        lethal, paced = (cells[:MOST_CUBES].tolist() for cells in self._feed.marked)
        return marked_cells(self._feed.grid, lethal, paced)

    def _zones(self, now_ns: int) -> Iterator[Drawing]:
        for name, (closed, cells) in self._feed.zones(now_ns).items():
            lines = outline(self._feed.grid, cells)
            layer = "zones/closed" if closed else "zones/pace"
            yield Drawing(layer, name, Form.LINES, lines, ZONE, 0.3 * self._feed.grid.resolution_m)

    def _put(self, row: str, message: Any) -> Put:
        return Put(Channel(row, self._rows[row].topic), message)


def corners(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """A line without the points at which it goes straight on: float64 (n, 2) to float64 (at most n, 2)."""
    if len(points_m) < 3:
        return points_m
    steps = np.diff(points_m, axis=0)
    turns = steps[1:, 0] * steps[:-1, 1] != steps[1:, 1] * steps[:-1, 0]
    back = (steps[1:] * steps[:-1]).sum(axis=1) <= 0  # or it stands
    kept = np.concatenate([[True], turns | back, [True]])
    return np.asarray(points_m[kept])


def outline(grid: GridSpec, cells: NDArray[np.uint32]) -> NDArray[np.float64]:
    """The sides between cells of a set and others: float64 (2 n, 2), from the first point to the second, from the
    third to the fourth, and so on."""
    rows, cols = np.divmod(np.asarray(cells, np.int64), grid.cols)
    row0, col0 = rows.min(initial=grid.rows), cols.min(initial=grid.cols)
    inside = np.zeros((rows.max(initial=row0) - row0 + 3, cols.max(initial=col0) - col0 + 3), np.bool_)
    inside[rows - row0 + 1, cols - col0 + 1] = True
    # A line below each cell that differs from the one south of it, and right of each that differs from that east.
    level_row, level_col = np.nonzero(inside[1:] != inside[:-1])
    upright_row, upright_col = np.nonzero(inside[:, 1:] != inside[:, :-1])
    starts = np.concatenate(
        [np.stack([level_row + 1, level_col]), np.stack([upright_row, upright_col + 1])], axis=1
    )
    ends = np.concatenate(
        [np.stack([level_row + 1, level_col + 1]), np.stack([upright_row + 1, upright_col + 1])], axis=1
    )
    lines = np.stack([starts.T, ends.T], axis=1).reshape(-1, 2)
    east_m = grid.west_m + (lines[:, 1] - 1 + col0) * grid.resolution_m
    south_m = grid.north_m - (lines[:, 0] - 1 + row0) * grid.resolution_m
    return np.stack([east_m, south_m], axis=1)
