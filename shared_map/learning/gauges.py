"""What has been learned of each class of ground, as figures that a process tells of itself."""

from __future__ import annotations

import numpy as np

from shared_map.arrays import Bytes, Floats
from shared_map.learning.factors import SLOPE_BINS
from shared_map.learning.words import KEYS
from shared_map.terrain.layers import TerrainClass
from swarm.runtime.stats import LEARNED, Counters


class LearnedGauges:
    """Tells by what the prior pace of each class is multiplied: the mean over its cells, of all slopes. A class
    whose prior stands has no gauge.

    keys  the kind of ground of each cell; None if nothing is learned
    """

    def __init__(self, keys: Bytes | None, counters: Counters) -> None:
        self._counters = counters
        self._told: Floats | None = None
        self._cells = None if keys is None else np.bincount(keys.reshape(-1), minlength=KEYS)

    def tick(self, factors: Floats) -> None:
        """Tell what is new.

        factors  float32 (KEYS,)  another array whenever they have changed
        """
        if self._cells is None or factors is self._told:
            return
        self._told = factors
        for kind in TerrainClass:
            part = slice(kind * SLOPE_BINS, (kind + 1) * SLOPE_BINS)
            moved = (factors[part] != 1).any() and self._cells[part].any()
            name = LEARNED + kind.name.lower()
            self._counters.gauges.pop(name, None)
            if moved:
                self._counters.gauge(name, round(float(np.average(factors[part], weights=self._cells[part])), 3))
