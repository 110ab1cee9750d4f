"""The maps of an agent, what its vehicles learn of the ground, and the zones of operators in them.

Vehicles publish marks for the class "ground", which any class can read; a vehicle drives by the map of its own
class. Hazards found in a zone are no news, and a vehicle in one drives out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats
from shared_map.cost_map import CostMap, merged
from shared_map.pace_measurements import Measured, Measurement
from shared_map.replication.mark_sets import NO_STATEMENTS, Statements, dense, is_zone, standing
from shared_map.replication.merge import winners
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import grid_cells, tile_corners
from shared_map.terrain.slope_and_climb import Climb
from shared_map.vehicle_class_grounds import ClassGround, ClassMaps, for_class, read_marks
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec, Window
from swarm.wire.messages.map_data import MarkKind

_SAMPLE = 1 << 16
"""Cells whose times are looked at, to know about how long one takes."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap:
    """The map of an agent: float32 (rows, cols) in s/m, inf is lethal. The owners of the arrays change them in
    place.

    pace       cost of a cell to its vehicles' class, with marks and inflation
    ground     the map's cells for the class "ground", before inflation, with which findings are compared
    prior      as ground, without marks
    physics    the pace at which vehicles really drive
    climb      factor of a step's cost by its slope; None if steps cost the same both ways
    own_prior  the ground to its vehicles' class, without marks; None if that is "ground"
    """

    grid: GridSpec
    pace: NDArray[np.float32]
    ground: NDArray[np.float32]
    prior: NDArray[np.float32]
    physics: NDArray[np.float32]
    climb: Climb | None = None
    own_prior: NDArray[np.float32] | None = None

    def cell_s(self, share: float) -> float:
        """Returns this quantile of the times of passable cells (s), from a sample of them; 0 if there are none."""
        paces = self.physics.reshape(-1)[:: max(self.physics.size // _SAMPLE, 1)]
        paces = paces[np.isfinite(paces)]
        return self.grid.resolution_m * float(np.quantile(paces, share)) if len(paces) else 0.0

    def lethal(self, cells: NDArray[np.int64], paces: NDArray[np.float32]) -> NDArray[np.int64]:
        """Returns which of these cells are lethal to the vehicles' class, if these are their paces for "ground"."""
        if self.own_prior is None:
            return cells[np.isinf(paces)]
        found = np.isinf(paces) & np.isfinite(self.prior.reshape(-1)[cells])
        return cells[found | np.isinf(self.own_prior.reshape(-1)[cells])]


def meet(boxes: NDArray[np.int64], windows: Sequence[Window]) -> NDArray[np.bool_]:
    """Returns which boxes any window meets.

    boxes  int64 (n, 4): the smallest row and column of each, and the greatest; one whose greatest are smaller meets
           none
    """
    if not len(boxes) or not windows:
        return np.zeros(len(boxes), np.bool_)
    row0, col0, row1, col1 = np.ascontiguousarray(boxes.T)
    north, west, south, east = int(row0.min()), int(col0.min()), int(row1.max()), int(col1.max())
    near = [
        (each.row0, each.col0, each.row1, each.col1) for each in windows
        if each.row1 > north and each.col1 > west and each.row0 <= south and each.col0 <= east
    ]  # fmt: skip
    top, left, bottom, right = np.array(near, np.int64).reshape(-1, 4).T[:, :, None]
    met: NDArray[np.bool_] = ((row0 < bottom) & (row1 >= top) & (col0 < right) & (col1 >= left)).any(0)
    met &= row0 <= row1
    return met


_OWN = "own"


class AgentMaps:
    """Vehicles publish marks for "ground", which any class can read; each drives by its own class's map. For
    vehicles of "ground" both are one.

    common, own   the ground for "ground", and for the vehicles' class
    class_number  of that class, 0 for "ground"

    common    the cost map of "ground"
    own       that of the vehicles' class
    sink      applies marks, and measurements, for both
    local     what vehicles drive by
    learning  what they learn of kinds of ground; None if nothing is to be learned
    """

    def __init__(self, common: ClassGround, own: ClassGround, *, learning: bool, class_number: int = 0) -> None:
        self.class_number = class_number
        self.common = CostMap(common.terrain, learning=learning)
        self.sink: CostMap | ClassMaps = self.common
        self.own = self.common
        if own is not common:
            self.sink = maps = ClassMaps(self.common, {_OWN: own.terrain}, {_OWN: class_number})
            self.own = maps.of[_OWN]
        self.local = LocalMap(
            common.terrain.grid,
            self.own.pace_s_per_m,
            self.common.ground_s_per_m,
            self.common.prior_s_per_m,
            own.truth,
            own.terrain.climb,
            None if own is common else own.terrain.ground_s_per_m,
        )
        keys = self.own.keys
        self.learning = None if keys is None else Learning(Measured(keys), own.terrain.ground_s_per_m)

    def take_dirty(self) -> list[Window]:
        """Windows with every cell that has changed in one of the maps since the last call."""
        windows = self.common.take_dirty()
        return windows if self.own is self.common else merged(self.own.take_dirty(), windows)

    def read(
        self,
        cells: NDArray[np.int64],
        kinds: NDArray[np.uint8],
        paces: Floats,
        own_kinds: NDArray[np.uint8],
        own_paces: Floats,
    ) -> tuple[NDArray[np.uint8], Floats]:
        """Combines statements for all classes with those for the vehicles' class. Returns kinds and paces."""
        if self.own is self.common:
            return kinds, paces
        read = read_marks(self.own.terrain, self.common.terrain, cells, kinds, paces)
        return for_class(self.own.terrain, cells, *read, own_kinds, own_paces)


_EVERY_NS = 5 * NS_PER_S
"""Interval of measurements: terrain classes do not change while a vehicle looks."""


class Learning:
    """Compares the pace that was driven with the prior one, cell by cell.

    prior_s_per_m  float32 (rows, cols)  the ground before anything was marked or learned
    """

    def __init__(self, measured: Measured, prior_s_per_m: Floats) -> None:
        self._measured = measured
        self._prior = prior_s_per_m.reshape(-1)
        self._sent_version = 0
        self._due_ns = 0

    def tick(self, driven: Iterable[tuple[int, float]], now_ns: int) -> Mapping[int, Measurement]:
        """Returns the measurements to publish now; empty if there are none, or it is too early.

        driven  (cell, s/m) of each step since the last call
        """
        measured = self._measured
        for cell, pace_s_per_m in driven:
            measured.add(cell, pace_s_per_m, self._prior.item(cell))
        if measured.version == self._sent_version or now_ns < self._due_ns:
            return {}
        self._sent_version, self._due_ns = measured.version, now_ns + _EVERY_NS
        return measured.by_key


_AGAIN_NS = NS_PER_S
"""Interval of searches for a way out while a vehicle needs one: the surroundings of the zone change, too."""


class ZonesAround:
    """The zones in an agent's map: those for all vehicles, and those for the class of its own.

    exit_steps  cell that only a zone closes -> straight steps from there to the nearest open cell
    """

    def __init__(self, replica: MapReplica, maps: AgentMaps) -> None:
        self.exit_steps: Mapping[int, int] = {}
        self._replica = replica
        self._maps = maps
        self._cost_map = maps.own
        self._version = 0
        """Version of the zones in `_cells` and `_tiles`."""
        self._cells: NDArray[np.int64] = np.empty(0, np.int64)
        """Cells of zones for all vehicles, sorted."""
        self._tiles: list[int] = []
        """Tiles of the grid with a zone for all vehicles, or for the own class."""
        self._due_ns = 0

    def update(self, places: Collection[int], now_ns: int, shut: Collection[int] = ()) -> None:
        """Takes in what changed.

        places  the cells that our vehicles hold
        shut    cells over which no way out leads: obstacles stand there, or vehicles have seen that they are lethal
        """
        if self._version != self._replica.zones_version:
            self._version = self._replica.zones_version
            self._find_zones()
            self._due_ns = 0
        pace = self._cost_map.pace_s_per_m.reshape(-1)
        if not self._tiles or not np.isinf(pace[list(places)]).any():
            self.exit_steps = {}
        elif now_ns >= self._due_ns or not self.exit_steps:
            self._due_ns = now_ns + _AGAIN_NS
            self.exit_steps = self._find_exit_steps(shut)

    def free(self, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Returns which cells are in no zone for all vehicles. There an operator's mark overrules findings; in a
        zone for one class the other classes use findings."""
        return ~np.isin(cells, self._cells)

    def _find_zones(self) -> None:
        replica, grid = self._replica, self._replica.grid
        tiles: set[int] = set()
        found = [np.empty(0, np.int64)]
        for tile in replica.held.tiles:
            zones = [each for each in replica.held.of_tile(tile) if is_zone(each.author)]
            class_number, place = grid.class_of_tile(tile)
            if zones and class_number in (0, self._maps.class_number):
                tiles.add(place)
            for each in zones if class_number == 0 else ():
                found.append(self._cells_of(place, standing(each, replica.now_ns).cells))
        self._tiles, self._cells = sorted(tiles), np.unique(np.concatenate(found))

    def _cells_of(self, place: int, cells: NDArray[np.integer]) -> NDArray[np.int64]:
        """Flat indices in the grid of cells of a tile."""
        grid = self._replica.grid
        return grid_cells(grid, tile_corners(grid, place), cells).astype(np.int64)

    def _find_exit_steps(self, shut: Collection[int]) -> dict[int, int]:
        """Breadth first from the open cells around zones, along straight steps over cells that only zones close.
        Shut cells lead out too, as a vehicle may be there, but no path leads over them."""
        grid, pace, closed = self._replica.grid, self._cost_map.pace_s_per_m.reshape(-1), self._closed_by_zones()
        beside = {
            cell: [each for direction, each in grid.neighbours(cell) if direction % 2 == 0] for cell in closed
        }
        depth = {
            cell: 1
            for cell, around in beside.items()
            if any(each not in shut and np.isfinite(pace.item(each)) for each in around)
        }
        queue = deque(depth)
        while queue:
            cell = queue.popleft()
            for each in () if cell in shut else beside[cell]:
                if each in beside and each not in depth:
                    depth[each] = depth[cell] + 1
                    queue.append(each)
        return depth

    def _closed_by_zones(self) -> list[int]:
        """Cells which are lethal, and would not be without the zones."""
        grid, cost_map, found = self._replica.grid, self._cost_map, list[int]()
        ground = cost_map.ground_s_per_m.copy()
        flat, prior = ground.reshape(-1), cost_map.terrain.ground_s_per_m.reshape(-1)
        for place in self._tiles:
            for_all, zones = self._stated_without_zones(place)
            own = NO_STATEMENTS
            if self._maps.class_number:
                own, own_zones = self._stated_without_zones(grid.tile_for(place, self._maps.class_number))
                zones += own_zones
            for each in zones:
                cells = self._cells_of(place, each)
                flat[cells] = prior[cells]
            inner = np.union1d(for_all.cells, own.cells)
            cells = self._cells_of(place, inner)
            spread, own_spread = dense(for_all), dense(own)
            kinds, paces = self._maps.read(
                cells, spread.kinds[inner], spread.paces[inner], own_spread.kinds[inner], own_spread.paces[inner]
            )
            marked = kinds != MarkKind.CLEAR
            flat[cells[marked]] = np.where(kinds == MarkKind.LETHAL, np.inf, paces)[marked]
        for place in self._tiles:
            window = cost_map.padded(grid.tile_window(place))
            pace = cost_map.inflated(ground, window)
            here = cost_map.pace_s_per_m[window.row0 : window.row1, window.col0 : window.col1]
            rows, cols = np.nonzero(np.isinf(here) & np.isfinite(pace))
            found += ((rows + window.row0) * grid.cols + cols + window.col0).tolist()
        return found

    def _stated_without_zones(self, tile: int) -> tuple[Statements, list[NDArray[np.uint16]]]:
        """Returns the marks of a tile without its zones, and the cells in it of each zone."""
        sets, now_ns = self._replica.held.of_tile(tile), self._replica.now_ns
        zones = [standing(each, now_ns).cells for each in sets if is_zone(each.author)]
        return winners([each for each in sets if not is_zone(each.author)], now_ns), zones
