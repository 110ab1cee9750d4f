"""The weights of a map as the kernels want them, and what changed in them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import cell_costs as kernels
from planner_service.kernels.layout import RULE_FOUR, RULE_OCTILE, RULE_PAPER, SQRT2_EXACT
from planner_service.kernels.route_walk import walk_routes
from planner_service.tree.growth import flood
from shared_map.arrays import Floats
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window

Cells = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Changes:
    """Cells whose weight changed (padded, no repetition) and what it was before."""

    cells: Cells
    before: Floats
    weight_now: Floats

    @cached_property
    def any_lower(self) -> bool:
        return self.cells.size > 0 and bool((self.weight_now < self.before).any())


NO_CHANGES = Changes(np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32))


def rule_of(config: PlannerConfig) -> int:
    if config.neighbours == 4:
        return RULE_FOUR
    return RULE_OCTILE if config.edge == "octile" else RULE_PAPER


def check_pace(grid: GridSpec, pace: NDArray[np.float32]) -> None:
    """Raises ValueError unless the array is what kernels may be handed. Values are checked as they are read."""
    if not isinstance(pace, np.ndarray) or pace.dtype != np.float32:
        raise ValueError(f"pace must be a float32 array, not {getattr(pace, 'dtype', type(pace).__name__)}")
    if pace.shape != (grid.rows, grid.cols):
        raise ValueError(f"pace has shape {pace.shape}, the grid is {grid.rows} x {grid.cols}")
    if not pace.flags.c_contiguous:
        raise ValueError("pace must be C-contiguous")


_FEWEST, _MOST = 1 << 9, 1 << 14
"""Buckets of a repair."""


class Walks(NamedTuple):
    """Routes read off a tree, as `kernels.walk.walk_routes` returns them."""

    directions: NDArray[np.uint8]
    ends: Cells
    driven: NDArray[np.float64]
    diagonals: Cells
    last: Cells


class Ground:
    """The weights of a map: what entering each cell costs, s, padded with a lethal border.

    low, high  bounds of the finite weights, not necessarily reached; (inf, 0) if all is lethal
    directed   whether a step costs by where it comes from too; then only whole trees are grown
    """

    directed = False

    def __init__(self, grid: GridSpec, config: PlannerConfig) -> None:
        self.grid = grid
        self.config = config
        self.rule = rule_of(config)
        self.corners = config.corner_cutting
        self.stride = grid.cols + 2
        self.size = (grid.rows + 2) * self.stride
        self.diagonal = SQRT2_EXACT if self.rule == RULE_OCTILE else 1.0
        self._metres = np.float32(grid.resolution_m)
        self.length_weight_s = config.length_weight * grid.resolution_m
        self.weight: Floats = np.full(self.size, np.inf, np.float32)
        self.low = math.inf
        self.high = 0.0

    @property
    def buckets(self) -> tuple[np.float32, int]:
        """Width of a bucket, s, and how many of them hold all that costs at most a step more: for repairs."""
        longest = self.high * self.diagonal
        return np.float32(self.low), min(max(math.ceil(longest / self.low) + 2, _FEWEST), _MOST)

    def pad(self, cell: int) -> int:
        row, col = divmod(cell, self.grid.cols)
        return (row + 1) * self.stride + col + 1

    def pad_all(self, cells: Cells) -> Cells:
        rows, cols = np.divmod(cells, self.grid.cols)
        padded: Cells = (rows + 1) * self.stride + cols + 1
        return padded

    def unpad_all(self, padded: Cells) -> Cells:
        rows, cols = np.divmod(padded, self.stride)
        cells: Cells = (rows - 1) * self.grid.cols + cols - 1
        return cells

    def load(self, pace: Floats) -> None:
        """Take the whole map. Raises ValueError on a pace that is NaN, zero or negative."""
        check_pace(self.grid, pace)
        bad = kernels.pad_weights(pace, self._metres, np.float32(self.length_weight_s), self.stride, self.weight)
        if bad:
            raise ValueError(f"{bad} cells have a pace that is NaN, zero or negative; lethal is inf")
        low, high = kernels.weight_range(self.weight)
        self.low, self.high = float(low), float(high)

    def apply(self, pace: Floats, dirty: Sequence[Window]) -> Changes:
        """Take what changed inside the dirty windows. Raises ValueError on a pace that is NaN, zero or negative."""
        check_pace(self.grid, pace)
        found: list[Changes] = []
        for box in self._boxes(dirty):
            row0, col0, row1, col1 = box
            room = (row1 - row0) * (col1 - col0)
            cells = np.empty(room, np.int64)
            before = np.empty(room, np.float32)
            count, bad, low, high = kernels.changed_cells(
                pace,
                self._metres,
                np.float32(self.length_weight_s),
                box,
                self.stride,
                self.weight,
                cells,
                before,
            )
            if bad:
                raise ValueError(f"{bad} cells have a pace that is NaN, zero or negative; lethal is inf")
            if count:
                self.low = min(self.low, float(low))
                self.high = max(self.high, float(high))
                found.append(Changes(cells[:count], before[:count], self.weight[cells[:count]]))
        if not found:
            return NO_CHANGES
        changes = found[0]
        if len(found) > 1:
            # A cell in two overlapping windows changes in the first only, so there is no repetition.
            changes = Changes(
                np.concatenate([part.cells for part in found]),
                np.concatenate([part.before for part in found]),
                np.concatenate([part.weight_now for part in found]),
            )
        return changes

    def difference(self, older: Floats, dirty: Sequence[Window]) -> Changes:
        """What changed inside the dirty windows since `older` weights."""
        parts: list[Cells] = []
        shape = (self.grid.rows + 2, self.stride)
        for row0, col0, row1, col1 in self._boxes(dirty):
            part = np.s_[row0 + 1 : row1 + 1, col0 + 1 : col1 + 1]
            rows, cols = np.nonzero(self.weight.reshape(shape)[part] != older.reshape(shape)[part])
            parts.append((rows + row0 + 1) * self.stride + cols + col0 + 1)
        if not parts:
            return NO_CHANGES
        cells = np.unique(np.concatenate(parts))
        return Changes(cells, older[cells], self.weight[cells])

    def _boxes(self, windows: Sequence[Window]) -> Iterator[tuple[int, int, int, int]]:
        """(row0, col0, row1, col1) of what of each window lies on the grid, where anything does."""
        for window in windows:
            row0, col0 = max(window.row0, 0), max(window.col0, 0)
            row1, col1 = min(window.row1, self.grid.rows), min(window.col1, self.grid.cols)
            if row0 < row1 and col0 < col1:
                yield row0, col0, row1, col1

    def grow(self, root: int, cost: Floats, parent: NDArray[np.uint8]) -> float:
        """The exact tree of a padded, passable root. Arrays are written whole; no cost exceeds what is returned."""
        return flood(self.weight, self.low, self.high, self.stride, root, self.rule, self.corners, cost, parent)

    def walk(self, parent: NDArray[np.uint8], root: int, starts: Cells, most: int, weight: Floats) -> Walks:
        """Routes from padded cells that have a way to a padded root, over the weights of this or an earlier map.

        most  steps of a route; 0 for all of it
        """
        return Walks(*walk_routes(weight, parent, self.stride, self.rule, root, starts, most, self.grid.cells))

    def passable(self, cell: int) -> bool:
        return bool(self.weight[self.pad(cell)] < np.inf)
