"""What zones of operators mean to an agent: what is found in them is no news, and who stands in one drives out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.cost_map import CostMap
from shared_map.replication.marks import is_zone, standing
from shared_map.replication.merge import winners
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import grid_cells, tile_corners
from swarm.clock import NS_PER_S
from swarm.wire.statements import MarkKind
from vehicle_agent.sensing.sensor import Findings

Read = Callable[
    [NDArray[Any], NDArray[np.uint8], NDArray[np.float32]], tuple[NDArray[np.uint8], NDArray[np.float32]]
]
_AGAIN_NS = NS_PER_S
"""Ways out are looked for again so often while somebody needs one: what is around the zone changes, too."""


class ZonesAround:
    """The zones in an agent's map.

    read      what statements about the ground are to the map's class of vehicles

    ways_out  cell that only a zone closes -> straight steps from there to the nearest open cell
    """

    def __init__(self, replica: MapReplica, cost_map: CostMap, read: Read) -> None:
        self.ways_out: Mapping[int, int] = {}
        self._replica = replica
        self._cost_map = cost_map
        self._read = read
        self._version = 0
        """Of the zones that `_cells` are the cells of, sorted."""
        self._cells: NDArray[np.int64] = np.empty(0, np.int64)
        self._due_ns = 0

    def update(self, places: Collection[int], now_ns: int, shut: Collection[int] = ()) -> None:
        """Take in what changed.

        places  the cells that our vehicles hold
        shut    cells over which no way out leads: bodies stand there, or vehicles have seen that they are lethal
        """
        if self._version != self._replica.zones_version:
            self._version = self._replica.zones_version
            self._cells = self._zone_cells()
            self._due_ns = 0
        pace = self._cost_map.pace_s_per_m.reshape(-1)
        if not len(self._cells) or not np.isinf(pace[list(places)]).any():
            self.ways_out = {}
        elif now_ns >= self._due_ns or not self.ways_out:
            self._due_ns = now_ns + _AGAIN_NS
            self.ways_out = self._find_ways_out(shut)

    def without(self, findings: Findings) -> Findings:
        """Findings without those in zones: an operator's word stands, whatever a vehicle sees there."""
        if not len(self._cells) or not len(findings):
            return findings
        free = ~np.isin(findings.cells, self._cells)
        return Findings(findings.cells[free], findings.kinds[free], findings.paces[free])

    def _zone_cells(self) -> NDArray[np.int64]:
        replica, found = self._replica, [np.empty(0, np.int64)]
        for tile in replica.held.tiles:
            for each in replica.held.of_tile(tile):
                if is_zone(each.author):
                    cells = standing(each, replica.now_ns).cells
                    found.append(grid_cells(replica.grid, tile_corners(replica.grid, tile), cells).astype(np.int64))
        return np.unique(np.concatenate(found))

    def _find_ways_out(self, shut: Collection[int]) -> dict[int, int]:
        """Breadth first from the open cells around zones, along straight steps over cells that only zones close.
        What is shut leads out too, as a vehicle may stand there, but nothing leads over it."""
        closed = self._closed_by_zones()
        cols, pace = self._cost_map.grid.cols, self._cost_map.pace_s_per_m.reshape(-1)
        passable = ~np.isin(closed, list(shut))
        depth = np.zeros(len(closed), np.int64)
        beside = _straight(closed, cols, len(pace))
        at = np.searchsorted(closed, beside.clip(0))
        at[at == len(closed)] = 0
        inside = (closed[at] == beside) if len(closed) else np.zeros_like(beside, bool)
        outside = (beside >= 0) & np.isfinite(pace[beside.clip(0)]) & ~np.isin(beside, list(shut))
        front = outside.any(axis=1)
        level = 0
        while front.any():
            level += 1
            depth[front] = level
            reached = np.zeros(len(closed), bool)
            reached[at[front & passable][inside[front & passable]]] = True
            front = reached & (depth == 0)
        led = depth > 0
        return dict(zip(closed[led].tolist(), depth[led].tolist(), strict=True))

    def _closed_by_zones(self) -> NDArray[np.int64]:
        """Cells which are lethal, and would not be without the zones; sorted."""
        replica, cost_map, found = self._replica, self._cost_map, [np.empty(0, np.int64)]
        ground = cost_map.ground_s_per_m.copy()
        flat = ground.reshape(-1)
        tiles = [tile for tile in replica.held.tiles if any(is_zone(s.author) for s in replica.held.of_tile(tile))]
        for tile in tiles:
            corner = tile_corners(replica.grid, tile)
            others = []
            for each in replica.held.of_tile(tile):
                if is_zone(each.author):
                    cells = grid_cells(replica.grid, corner, standing(each, replica.now_ns).cells)
                    flat[cells] = cost_map.terrain.ground_s_per_m.reshape(-1)[cells]
                else:
                    others.append(each)
            said = winners(others, replica.now_ns)
            stated = said.kinds != MarkKind.CLEAR
            cells = grid_cells(replica.grid, corner, said.cells[stated])
            kinds, paces = self._read(cells, said.kinds[stated], said.paces[stated])
            marked = kinds != MarkKind.CLEAR
            flat[cells[marked]] = np.where(kinds == MarkKind.LETHAL, np.inf, paces)[marked]
        for tile in tiles:
            window = cost_map.padded(replica.grid.tile_window(tile))
            pace = cost_map.inflated(ground, window)
            here = cost_map.pace_s_per_m[window.row0 : window.row1, window.col0 : window.col1]
            rows, cols = np.nonzero(np.isinf(here) & np.isfinite(pace))
            found.append((rows + window.row0) * replica.grid.cols + cols + window.col0)
        return np.unique(np.concatenate(found))


def _straight(cells: NDArray[np.int64], cols: int, area: int) -> NDArray[np.int64]:
    """The four neighbours beside each cell, int64 (n, 4); -1 where the grid ends."""
    col = cells % cols
    beside = np.stack((cells - cols, np.where(col < cols - 1, cells + 1, -1), cells + cols, cells), axis=1)
    beside[:, 3] = np.where(col > 0, cells - 1, -1)
    beside[(beside < 0) | (beside >= area)] = -1
    return beside
