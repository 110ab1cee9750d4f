"""The map of an agent, and which places a change of it concerns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.class_grounds import ClassGround
from shared_map.class_maps import ClassMaps, for_class, read_marks
from shared_map.cost_map import CostMap, merged
from shared_map.learning.factors import Measured
from shared_map.learning.words import Said
from shared_map.terrain.step_climb import Climb
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec, Window


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap:
    """The map of an agent: float32 (rows, cols) in s/m, inf is lethal. Their owners change them in place.

    pace       cost of a cell to its vehicles' class, with marks and inflation
    ground     what the map says of cells to the class "ground", before inflation: what is found is compared with it
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

    def lethal(self, cells: NDArray[np.int64], paces: NDArray[np.float32]) -> NDArray[np.int64]:
        """Which of these cells are lethal to the vehicles' class, if these are their paces for "ground"."""
        if self.own_prior is None:
            return cells[np.isinf(paces)]
        found = np.isinf(paces) & np.isfinite(self.prior.reshape(-1)[cells])
        return cells[found | np.isinf(self.own_prior.reshape(-1)[cells])]


def meet(boxes: NDArray[np.int64], windows: Sequence[Window]) -> NDArray[np.bool_]:
    """Which boxes any window meets.

    boxes  int64 (n, 4): the smallest row and column of each, and the greatest; one whose greatest are smaller meets
           none
    """
    met = np.zeros(len(boxes), np.bool_)
    if not len(boxes):
        return met
    row0, col0, row1, col1 = np.ascontiguousarray(boxes.T)
    north, west, south, east = int(row0.min()), int(col0.min()), int(row1.max()), int(col1.max())
    for window in windows:
        if window.row1 <= north or window.col1 <= west or window.row0 > south or window.col0 > east:
            continue  # far from all of them, as half of the windows are that concern an agent
        rows = (row0 < window.row1) & (row1 >= window.row0)
        met |= rows & (col0 < window.col1) & (col1 >= window.col0)
    met &= row0 <= row1
    return met


# The maps of an agent: that of the class "ground", for which marks speak, and that of its vehicles' own class.

_OWN = "own"


class AgentMaps:
    """What a vehicle finds it tells as for "ground", which any class can read; it drives by its own class's map.
    For vehicles of "ground" both are one.

    common, own   the ground for "ground", and for the vehicles' class
    class_number  of that class, 0 of "ground"

    common    the cost map of "ground"
    own       that of the vehicles' class
    sink      takes in marks, and what is learned, for both
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
        """Kinds and paces that hold for the vehicles' class, of statements for all and for that class alone."""
        if self.own is self.common:
            return kinds, paces
        read = read_marks(self.own.terrain, self.common.terrain, cells, kinds, paces)
        return for_class(self.own.terrain, cells, *read, own_kinds, own_paces)


# What an agent has learned while its vehicles drove, and when to say it.

_EVERY_NS = 5 * NS_PER_S


class Learning:
    """Compares the pace that was driven with the prior one, cell by cell.

    prior_s_per_m  float32 (rows, cols)  the ground before anything was marked or learned
    """

    def __init__(self, measured: Measured, prior_s_per_m: Floats) -> None:
        self._measured = measured
        self._prior = prior_s_per_m.reshape(-1)
        self._told_version = 0
        self._due_ns = 0

    def tick(self, driven: Iterable[tuple[int, float]], now_ns: int) -> Mapping[int, Said]:
        """What to tell now, of all that was measured so far; nothing if nothing is new, or it is too early.

        driven  (cell, s/m) of each step since the last call
        """
        measured = self._measured
        for cell, pace_s_per_m in driven:
            measured.add(cell, pace_s_per_m, self._prior.item(cell))
        if measured.version == self._told_version or now_ns < self._due_ns:
            return {}
        self._told_version, self._due_ns = measured.version, now_ns + _EVERY_NS
        return measured.said
