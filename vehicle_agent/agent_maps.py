"""The maps of an agent: that of the class "ground", for which marks speak, and that of its vehicles' own class."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.class_grounds import ClassGround
from shared_map.class_maps import ClassMaps, for_class, read_marks
from shared_map.cost_map import CostMap, merged
from shared_map.learning.factors import Measured
from swarm.grid import Window
from vehicle_agent.learning import Learning
from vehicle_agent.local_map import LocalMap

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
