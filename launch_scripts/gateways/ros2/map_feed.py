"""The shared map for ROS: a replica that merges the marks of an observer, and its changes. Core: no bus.

With the terrain of the run its cost map is that of every process. Without it the map holds marks alone, and all
else is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.map_messages import Occupancy, occupancy_of
from shared_map.cost_map import CostMap
from shared_map.replication.marks import is_zone
from shared_map.replication.merge import winners
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import grid_cells, tile_corners
from shared_map.terrain.store import load_prepared, read_meta
from shared_map.terrain.terrain import Terrain
from swarm.clock import NS_PER_S
from swarm.errors import SwarmError, TerrainError
from swarm.grid import GridSpec, Window
from swarm.wire.messages.map_data import MarkKind, MarkSet

QUICK_S_PER_M = 0.1
"""The pace of the quickest ground where the terrain is not known: 10 m/s."""
_WHOLE_NS, _CELLS_AT_ONCE = 10 * NS_PER_S, 1 << 20
"""The whole map is due so long after it was put last if anything has changed, and as many times longer as it has
more cells than a million."""
_REDRAW_NS = 10 * NS_PER_S
"""All marks are looked at again so often, as those that expire are in no set that comes."""
_META = "terrain.json"
_NEWEST = 50
"""The folders of runs that are looked at."""
_Cells = NDArray[np.uint32]
_NO_CELLS: _Cells = np.empty(0, np.uint32)


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
        self._marked: dict[int, tuple[_Cells, _Cells, _Cells]] = {}
        """Tile -> cells of it that are marked as lethal, and with a pace, and those of zones."""
        self._redraw_due_ns = 0

    def merge(self, sets: Sequence[MarkSet], now_ns: int, swarm_now_ns: int) -> None:
        """Merges mark sets, and drops expired marks.

        now_ns        by a clock that never leaps
        swarm_now_ns  by the swarm's clocks
        """
        self._replica.tick(swarm_now_ns)
        taken = self._replica.merge(sets, measured=False).sets if sets else []
        tiles = {each.tile for each in taken}
        if now_ns >= self._redraw_due_ns:
            self._redraw_due_ns = now_ns + _REDRAW_NS
            tiles |= self._marked.keys()
        for tile in tiles:
            if tile < self.grid.tiles:
                zones = [each for each in self._replica.held.of_tile(tile) if is_zone(each.author)]
                stated = winners(zones, swarm_now_ns)
                drawn = stated.cells[stated.kinds != MarkKind.CLEAR]
                won = self._replica.winners(tile)
                marks = np.isin(won.cells, drawn, invert=True)
                lethal, paced = (
                    won.cells[marks & (won.kinds == kind)] for kind in (MarkKind.LETHAL, MarkKind.PACE)
                )
                corner = tile_corners(self.grid, [tile])[0]
                self._marked[tile] = (
                    grid_cells(self.grid, corner, lethal),
                    grid_cells(self.grid, corner, paced),
                    grid_cells(self.grid, corner, drawn),
                )

    def take_changes(self) -> list[Window]:
        """Returns the windows that have changed since the last call."""
        windows = self._map.take_dirty()
        self._changed |= bool(windows)
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
        lethal, paced, zones = zip((_NO_CELLS,) * 3, *self._marked.values(), strict=True)
        return np.concatenate(lethal), np.concatenate(paced), np.concatenate(zones)


def _unknown(grid: GridSpec) -> Terrain:
    """The terrain of which nothing is known: each pace is NaN, until a mark says one."""
    pace, none = np.full((grid.rows, grid.cols), np.nan, np.float32), np.empty((0, 0), np.uint8)
    return Terrain(grid, none.astype(np.float32), none, pace, none, "", pace)


def find_terrain(digest: str, folder: Path | None, runs: Path) -> Terrain | None:
    """The terrain with this digest: in a folder, or in that of any run of this machine, for terrains of one digest
    are equal. None if none is here.

    folder  None: the newest folders in `runs` are looked at

    Raises TerrainError if the folder that was named has none, or another.
    """
    if folder is not None:
        terrain = load_prepared(folder)
        if terrain is None:
            raise TerrainError(
                f"no prepared terrain in {folder}: expected the folder of a run, which holds {_META}"
            )
        if terrain.digest != digest:
            raise TerrainError(f"{folder} holds terrain {terrain.digest}, and the run has {digest}")
        return terrain
    metas: list[Path] = []
    with suppress(OSError):
        metas = sorted(runs.glob(f"*/{_META}"), key=lambda each: each.stat().st_mtime_ns, reverse=True)
    for meta in metas[:_NEWEST]:
        with suppress(SwarmError):  # another run's damage is no business of ours
            known = read_meta(meta, "")
            if known is not None and known.digest == digest and (found := load_prepared(meta.parent)):
                return found
    return None
