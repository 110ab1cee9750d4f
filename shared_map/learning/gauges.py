"""What has been learned of each class of ground, as figures that a process tells of itself."""

from __future__ import annotations

import numpy as np

from shared_map.cost_map import CostMap
from shared_map.learning.factors import SLOPE_BINS
from shared_map.learning.words import KEYS
from shared_map.terrain.layers import TerrainClass
from swarm.runtime.stats import LEARNED, Counters


class LearnedGauges:
    """Tells by what the prior pace of each class is multiplied: the mean over its cells, of all slopes. A class
    whose prior stands has no gauge."""

    def __init__(self, cost_map: CostMap, counters: Counters) -> None:
        self._cost_map, self._counters = cost_map, counters
        self._told = cost_map.factors
        keys = cost_map.keys
        self._cells = None if keys is None else np.bincount(keys.reshape(-1), minlength=KEYS)

    def tick(self) -> None:
        """Tell what is new."""
        factors = self._cost_map.factors
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
