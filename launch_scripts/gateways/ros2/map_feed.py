"""The shared map for ROS: a replica that merges the marks of an observer, and its changes. Core: no bus.

With the terrain of the run its cost map is that of every process. Without it the map holds marks alone, and all
else is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.map_messages import Occupancy, occupancy_of
from shared_map.cost_map import CostMap
from shared_map.keeper.zone_orders import cells_of_zones
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import Terrain
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec, Window
from swarm.wire.messages.map_data import MarkSet

QUICK_S_PER_M = 0.1
"""The pace of the quickest ground where the terrain is not known: 10 m/s."""
_WHOLE_NS, _CELLS_AT_ONCE = 10 * NS_PER_S, 1 << 20
"""The whole map is due this time after it was put last if anything has changed, and as many times longer as it has
more cells than a million."""
_Cells = NDArray[np.int64]


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
        self._told_ns: int | None = None
        self._changed = False
        """Changes since the whole map was published last, at `_told_ns`."""
        self._marks: tuple[_Cells, _Cells] | None = None
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
        due = self._told_ns is None or (self._changed and now_ns - self._told_ns >= self._whole_ns)
        if due:
            self._told_ns, self._changed = now_ns, False
        return due

    def occupancy(self, window: Window) -> Occupancy:
        """int8 (rows, cols) of a window, row 0 in the north, as `occupancy_of` has it."""
        pace = self._map.pace_s_per_m[window.row0 : window.row1, window.col0 : window.col1]
        return occupancy_of(pace, self._best_s_per_m)

    @property
    def marked(self) -> tuple[_Cells, _Cells, _Cells]:
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
