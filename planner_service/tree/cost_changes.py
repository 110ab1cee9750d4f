"""Changes of the cell costs of a map, and facts about all of them: their range, the rounding of sums."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.cell_costs import BLOCK, block_ranges
from shared_map.array_files import Floats

Cells = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Changes:
    """Cells whose cost changed (padded, no repetition), and the cell costs before and after, s."""

    cells: Cells
    before: Floats
    after: Floats

    @cached_property
    def any_lower(self) -> bool:
        return self.cells.size > 0 and bool((self.after < self.before).any())


NO_CHANGES = Changes(np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32))


def joined(parts: Sequence[Changes]) -> Changes:
    """All of these, which have no cell in common."""
    if len(parts) == 1:
        return parts[0]
    return Changes(
        np.concatenate([part.cells for part in parts]),
        np.concatenate([part.before for part in parts]),
        np.concatenate([part.after for part in parts]),
    )


class CostRange:
    """The lowest and the highest of cell costs, or of what cells cost to the root: float32, none of them negative.
    It is immutable, so that snapshots share it.

    It is found block by block, so that a change looks at its own blocks only.

    lowest   inf if there is no finite one
    highest  the highest finite cost; 0 if there is none
    last     the highest, inf with them; NaN is beyond that
    """

    def __init__(self, costs: Floats) -> None:
        self._ranges: NDArray[np.int32] = np.empty((3, -(-costs.size // BLOCK)), np.int32)
        """Range of each block: what the attributes say of all, as bits."""
        self._find(costs, np.arange(self._ranges.shape[1]))

    def after(self, costs: Floats, cells: Cells) -> CostRange:
        """Returns the range of the array after these cells of it have changed."""
        changed = copy.copy(self)
        changed._ranges = self._ranges.copy()
        changed._find(costs, np.unique(cells // BLOCK))
        return changed

    def _find(self, costs: Floats, blocks: Cells) -> None:
        block_ranges(costs.view(np.int32), blocks, self._ranges)
        lowest, highest, last = self._ranges
        self.lowest = float(lowest.view(np.float32).min(initial=np.inf))
        self.highest = float(highest.view(np.float32).max(initial=0.0))
        self.last = float(last.max(initial=0).view(np.float32))


_MANY = 1 << 11
"""Classes: all that 11 bits name."""
_PART = 1 << 20
"""Cells that are classed at a time: `bincount` takes 12 bytes for each."""
_LETHAL = 0x7F8
"""The class of inf."""


class Rounding:
    """Bound on the error of float32 in the labels of trees, on a map with the current cell costs.

    docs/method/certificates.md says why that is enough. It is immutable, so that snapshots share it.

    classes  how many cell costs begin with the same 11 bits: classes that are an eighth of a power of two wide
    """

    def __init__(self, classes: Cells) -> None:
        self.classes = classes

    @classmethod
    def of(cls, cell_cost: Floats) -> Self:
        """Returns the rounding of a map; of no cells, before there is one."""
        classes = np.zeros(_MANY, np.int64)
        for part in np.array_split(cell_cost.view(np.int32), cell_cost.size // _PART + 1):
            classes += np.bincount(part >> 20, minlength=_MANY)
        return cls(classes)

    def after(self, changes: Changes) -> Self:
        """Returns the rounding of the map with these changes."""
        kinds = [part.view(np.int32) >> 20 for part in (changes.after, changes.before)]
        more, fewer = (np.bincount(part, minlength=_MANY) for part in kinds)
        return type(self)(self.classes + more - fewer)

    def at(self, cost: NDArray[np.float64] | np.float64) -> NDArray[np.float64]:
        """Returns a bound on the relative float32 rounding error of the label (cost-to-go) of a cell whose cheapest
        path has this cost (s).

        One rounding per step, plus a constant. A path enters no cell twice, so it has at most as many steps as
        there are cheapest cells of the map whose sum reaches this cost. A few very cheap cells therefore change the
        bound little. Dividing the cost by the lowest cell cost would give far more steps.
        """
        return np.minimum((np.interp(cost, *self.cheapest) + 8.0) * 2.0**-24, 1.0)

    @cached_property
    def cheapest(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower bounds (s) on the sum of the n cheapest cells, and each n; both begin with 0."""
        classes = np.flatnonzero(self.classes[:_LETHAL])
        counts = self.classes[classes]
        least = (classes << 20).astype(np.int32).view(np.float32).astype(np.float64)
        # The first class is zero; a path that costs nothing has no steps.
        costs = np.cumsum(counts * np.maximum(least, np.finfo(np.float64).tiny))
        return np.append(0.0, costs), np.append(0.0, np.cumsum(counts))
