"""The shared map for ROS: a replica that merges what an observer hears, and what has changed of it. Core: no bus.

With the terrain of the run its cost map is that of every process. Without it the map holds marks alone, and all
else is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.grids import Occupancy, occupancy_of
from shared_map.arrays import Floats
from shared_map.cost_map import CostMap, merged
from shared_map.replication.marks import is_zone, standing
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import grid_cells, tile_corners
from shared_map.terrain.terrain import Terrain
from swarm.clock import NS_PER_S
from swarm.grid import TILE_CELLS, GridSpec, Window
from swarm.wire.messages.map_data import MarkKind, MarkSet

QUICK_S_PER_M = 0.1
"""What the quickest ground is taken for where the terrain is not known: 10 m/s."""
_WHOLE_SHARE = 0.02
"""The whole map is due when windows of more than this share of it have changed since it was put last."""
_WHOLE_NS, _CELLS_AT_ONCE = 10 * NS_PER_S, 1 << 20
"""It is due so long after it was put last if anything has changed; as many times longer as it has more cells."""
_REDRAW_NS = 10 * NS_PER_S
"""All marks are looked at again so often, as those that expire are in no set that comes."""
_Cells = NDArray[np.uint32]
_NO_CELLS: _Cells = np.empty(0, np.uint32)


class Sink(Protocol):
    """What a replica keeps at the winning statements: `CostMap`, or `MarksAlone`."""

    pace_s_per_m: Floats

    def apply(self, cells: NDArray[np.uint32], kinds: NDArray[np.uint8], paces: NDArray[np.float32]) -> object: ...
    def learn(self, words: Sequence[MarkSet]) -> bool: ...
    def take_dirty(self) -> list[Window]: ...


class MarksAlone:
    """A cost map that knows no ground: NaN where nothing is marked.

    pace_s_per_m  float32 (rows, cols)
    """

    def __init__(self, grid: GridSpec) -> None:
        self.pace_s_per_m: Floats = np.full((grid.rows, grid.cols), np.nan, np.float32)
        self._cols = grid.cols
        self._dirty: list[Window] = []

    def apply(
        self,
        cells: NDArray[np.uint32],
        kinds: NDArray[np.uint8],
        paces: NDArray[np.float32],
        class_number: int = 0,
    ) -> None:
        if class_number:
            return  # for one class of vehicles alone
        values = np.where(kinds == MarkKind.PACE, paces, np.where(kinds == MarkKind.LETHAL, np.inf, np.nan))
        self.pace_s_per_m.reshape(-1)[cells] = values
        rows, cols = np.divmod(np.asarray(cells, np.int64), self._cols)
        boxes: dict[tuple[int, int], Window] = {}
        for row, col in zip(rows.tolist(), cols.tolist(), strict=True):
            tile, box = (row // TILE_CELLS, col // TILE_CELLS), Window(row, col, row + 1, col + 1)
            boxes[tile] = boxes[tile].union(box) if tile in boxes else box
        self._dirty = merged(boxes.values(), self._dirty)

    def learn(self, words: Sequence[MarkSet]) -> bool:
        """What was learned is about kinds of ground, of which nothing is known here."""
        return False

    def take_dirty(self) -> list[Window]:
        windows, self._dirty = self._dirty, []
        return windows


@dataclass(frozen=True, slots=True)
class Change:
    """What is to be told of the map.

    whole    all of it
    windows  those that have changed since they were told last; empty with `whole`
    """

    whole: bool
    windows: tuple[Window, ...]


class MapFeed:
    """The map of the run, from sets of marks on.

    grid     of the terrain
    terrain  the run's own; None if it is not on this machine
    """

    def __init__(self, grid: GridSpec, terrain: Terrain | None) -> None:
        self.grid = grid
        self.knows_ground = terrain is not None
        self._sink: Sink = MarksAlone(grid) if terrain is None else CostMap(terrain, learning=True)
        self._replica = MapReplica(grid, self._sink)
        self._best_s_per_m = QUICK_S_PER_M if terrain is None else _quickest(terrain.pace_s_per_m)
        self._told_ns: int | None = None
        self._changed_cells = 0
        """Since the whole map was told last, at `_told_ns`."""
        self._whole_ns = _WHOLE_NS * max(1, grid.cells // _CELLS_AT_ONCE)
        self._marked: dict[int, tuple[_Cells, _Cells]] = {}
        """Tile -> cells of it that are marked as lethal, and with a pace."""
        self._redraw_due_ns = 0

    def merge(self, sets: Sequence[MarkSet], now_ns: int, swarm_now_ns: int) -> None:
        """Take in sets of marks, and let expire what has expired.

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
                self._mark(tile)

    def change(self, now_ns: int, *, whole: bool = True) -> Change:
        """What is to be told since the last call. At first the whole map, if that is wanted.

        now_ns  by a clock that never leaps
        """
        windows = self._sink.take_dirty()
        self._changed_cells += sum(each.cells for each in windows)
        much = self._changed_cells > _WHOLE_SHARE * self.grid.cells and self._changed_cells > 1000
        since_ns = None if self._told_ns is None else now_ns - self._told_ns
        if whole and (
            since_ns is None or (self._changed_cells and since_ns >= (_WHOLE_NS if much else self._whole_ns))
        ):
            self._told_ns, self._changed_cells = now_ns, 0
            return Change(True, ())
        return Change(False, tuple(windows))

    def occupancy(self, window: Window) -> Occupancy:
        """int8 (rows, cols) of a window, row 0 in the north, as `occupancy_of` has it."""
        pace = self._sink.pace_s_per_m[window.row0 : window.row1, window.col0 : window.col1]
        return occupancy_of(pace, self._best_s_per_m)

    @property
    def marked(self) -> tuple[_Cells, _Cells]:
        """Cells that are marked as lethal, and those that are marked with a pace; zones among them."""
        if not self._marked:
            return _NO_CELLS, _NO_CELLS
        lethal, paced = zip(*self._marked.values(), strict=True)
        return np.concatenate(lethal), np.concatenate(paced)

    def zones(self, now_ns: int) -> Mapping[str, tuple[bool, _Cells]]:
        """The zones that stand: whether they are closed, and their cells, by name."""
        found: dict[str, tuple[bool, list[_Cells]]] = {}
        for tile in self._replica.held.tiles:
            if tile >= self.grid.tiles:
                continue
            for each in self._replica.held.of_tile(tile):
                if is_zone(each.author) and each.kinds:
                    said = standing(each, now_ns)
                    stated = said.kinds != MarkKind.CLEAR
                    if stated.any():
                        closed = bool((said.kinds[stated] == MarkKind.LETHAL).any())
                        name = each.author.partition(".")[2]
                        _, cells = found.setdefault(name, (closed, []))
                        cells.append(grid_cells(self.grid, tile_corners(self.grid, [tile])[0], said.cells[stated]))
        return {name: (closed, np.concatenate(cells)) for name, (closed, cells) in found.items()}

    def _mark(self, tile: int) -> None:
        won = self._replica.winners(tile)
        cells = grid_cells(self.grid, tile_corners(self.grid, [tile])[0], won.cells)
        lethal, paced = cells[won.kinds == MarkKind.LETHAL], cells[won.kinds == MarkKind.PACE]
        if len(lethal) or len(paced):
            self._marked[tile] = lethal, paced
        else:
            self._marked.pop(tile, None)


def _quickest(pace_s_per_m: Floats) -> float:
    passable = pace_s_per_m[np.isfinite(pace_s_per_m)]
    return float(passable.min()) if len(passable) else QUICK_S_PER_M
