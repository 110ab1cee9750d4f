"""What an agent has learned while its vehicles drove, and when to say it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from shared_map.arrays import Floats
from shared_map.learning.factors import Measured
from shared_map.learning.words import Said
from swarm.clock import NS_PER_S

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
