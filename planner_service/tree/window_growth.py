"""A window of a map, grown on its own around a target's new cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.cell_costs import cut_window
from planner_service.kernels.layout import NONE, PaddedGrid, step_offsets
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.growth import KeptScratch, floats_of_bits, grow_tree
from planner_service.tree.padded_climbs import climbs_in
from shared_map.arrays import Floats
from swarm.errors import OutsideGridError
from swarm.grid import Window

Box = tuple[int, int, int, int]

_SMALL = 1 << 16
"""Padded cells of a small window, whose scratch is worth keeping."""


class GrownWindow(NamedTuple):
    """Costs and parents of a window as a padded grid of its own, s.

    way  s; what it costs to get from the old root to the new one inside the window; inf where there is no way
    """

    box: Box
    cost: Floats
    parent: NDArray[np.uint8] | None
    way: float


def grow_window(
    grid: CostGrid, root: int, old: int, window: Window, kept: KeptScratch, with_parents: bool
) -> GrownWindow:
    """Grow a window that holds the new root and the old one. Raises OutsideGridError where it is not inside the
    grid or does not hold both.

    kept  scratch of the last window of one tree
    """
    row0, col0, row1, col1 = box = box_of(grid, window)
    width = col1 - col0 + 2
    start, end = _in_window(grid, root, window), _in_window(grid, old, window)
    part = np.empty((row1 - row0 + 2) * width, np.float32)
    bits = cut_window(grid.cell_cost.view(np.int32), grid.stride, box, part.view(np.int32))
    cost = np.empty_like(part)
    parent = np.full(part.size, NONE, np.uint8) if with_parents else None
    padded: PaddedGrid = part, step_offsets(width), width, grid.rule, grid.corners
    climbs = None if grid.climbs is None else climbs_in(grid.climbs, grid.stride, box)
    scratch = kept if part.size <= _SMALL else None
    grow_tree(padded, climbs, (*floats_of_bits(bits), grid.dearest_step), start, cost, parent, scratch)
    return GrownWindow(box, cost, parent, float(cost[end]))


def box_of(grid: CostGrid, window: Window) -> Box:
    """For kernels. Raises OutsideGridError on a window that is not inside the grid."""
    row0, col0, row1, col1 = window.row0, window.col0, window.row1, window.col1
    if not (0 <= row0 < row1 <= grid.grid.rows and 0 <= col0 < col1 <= grid.grid.cols):
        raise OutsideGridError(f"{window} is not inside the grid")
    return row0, col0, row1, col1


def _in_window(grid: CostGrid, cell: int, window: Window) -> int:
    """A cell's index in the window as a padded grid of its own. Raises OutsideGridError if it lies outside."""
    row, col = grid.grid.row_col(cell)
    if not window.contains(row, col):
        raise OutsideGridError(f"cell {cell} is not in {window}")
    return (row - window.row0 + 1) * (window.col1 - window.col0 + 2) + col - window.col0 + 1
