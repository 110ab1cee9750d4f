"""How far float32 may have put the labels of trees off: docs/certificates.md says why that is enough."""

from __future__ import annotations

from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.cell_costs import count_classes
from planner_service.tree.changes import Cells, Changes
from shared_map.arrays import Floats

_MANY = 1 << 11
_LETHAL = 0x7F8
"""The class of inf."""


class Rounding:
    """Of all trees on a map whose cell costs are as they are now. Nobody changes one, so that snapshots share it.

    classes  how many cell costs begin with the same 11 bits: classes that are an eighth of a power of two wide
    """

    def __init__(self, classes: Cells) -> None:
        self.classes = classes

    @classmethod
    def of(cls, cell_cost: Floats) -> Self:
        """That of a map; of no cells, before there is one."""
        classes = np.zeros(_MANY, np.int64)
        count_classes(cell_cost.view(np.int32), classes)
        return cls(classes)

    def after(self, changes: Changes) -> Self:
        """That of the map with these changes."""
        kinds = [part.view(np.int32) >> 20 for part in (changes.after, changes.before)]
        more, fewer = (np.bincount(part, minlength=_MANY) for part in kinds)
        return type(self)(self.classes + more - fewer)

    def at(self, cost: NDArray[np.float64] | np.float64) -> NDArray[np.float64]:
        """How far float32 may have put an exact label off, relatively, of a cell that has a way of so much, s.

        One rounding for each step and some for the last: a way enters no cell twice, so that it has no more steps
        than the cheapest cells of the map that cost as much together. One cheap cell among many makes little of
        that, where the lowest cell cost alone would say a step for each of it.
        """
        return np.minimum((np.interp(cost, *self.cheapest) + 8.0) * 2.0**-24, 1.0)

    @cached_property
    def cheapest(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What the cheapest cells cost together at least, s, and how many they are; both begin with 0."""
        classes = np.flatnonzero(self.classes[:_LETHAL])
        counts = self.classes[classes]
        least = (classes << 20).astype(np.int32).view(np.float32).astype(np.float64)
        # Of the first class zero; a way that costs nothing has no steps.
        costs = np.cumsum(counts * np.maximum(least, np.finfo(np.float64).tiny))
        return np.append(0.0, costs), np.append(0.0, np.cumsum(counts))
