"""A full growth: which queue suits the cell costs."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import queue_dial, queue_wide
from planner_service.kernels.cell_costs import cut_window
from planner_service.kernels.climbs import Climbs
from planner_service.kernels.layout import NONE, RULE_FOUR, RULE_OCTILE, SQRT2, TOO_FINE, PaddedGrid, step_offsets
from planner_service.kernels.parents_from_costs import point_to_parents, untie_parents
from planner_service.kernels.queue_multilevel import BASE_BITS, WIDTH, grow_directed_by_buckets, make_scratch
from planner_service.tree.cost_changes import CostRange
from shared_map.array_files import Floats
from shared_map.terrain.step_climb import Climb
from swarm.errors import OutsideGridError
from swarm.grid import Window

if TYPE_CHECKING:
    from planner_service.tree.cost_grid import CostGrid

MOST_BUCKETS = 1 << 8
"""Buckets are as narrow as the cheapest step: if the costliest takes more of them, their width follows the map."""
NARROW = 0.98
"""Width of a bucket, in lowest cell costs, that no cell in it leads back into, whatever the rounding."""
FINE = float(1 << 20)
"""While no cost exceeds this number of lowest cell costs, float32 distinguishes any cell's cost from its
parent's."""

Bounds = tuple[float, float, float]
"""Lowest and highest finite cell cost, s, and the highest cost of an allowed step, in cell costs."""

KeptScratch = dict[tuple[int, int], Any]
"""Scratch by padded cells and buckets: one at most, of one thread, one rule and one kind of step."""


def grow_tree(
    padded: PaddedGrid,
    climbs: Climbs | None,
    bounds: Bounds,
    root: int,
    cost: Floats,
    parent: NDArray[np.uint8] | None,
    kept: KeptScratch | None = None,
) -> float:
    """Grows the exact tree of a padded, passable root. Returns a bound, s, that no cost exceeds.

    climbs         of the same cells; None where entering a cell costs the same from everywhere
    cost, parent   padded, written whole; None where parents, and a bound, are not wanted
    kept           scratch of the last growth, reused for the same size; allocation is a large share of small
                   growths
    """
    cell_cost, _, stride, _, _ = padded
    size, lowest = cell_cost.size, bounds[0]
    scratch_of = {} if kept is None else kept
    if climbs is not None:
        grow_directed_costs(padded, climbs, bounds, root, cost, scratch_of)
        if parent is None:
            return math.inf
        reach = CostRange(cost).highest
    else:
        reach = _grow_alike(padded, bounds, root, cost, scratch_of)
    if parent is None:
        return reach
    point_to_parents(padded, climbs, cost, root, (0, 0, size // stride - 2, stride - 2), parent)
    if reach > FINE * lowest:
        # Steps may be lost in the rounding of the paths behind them, and parents lead in a circle.
        untie_parents(padded, climbs, (cost, parent, root), np.empty(2 * size, np.uint32))
    return reach


def _grow_alike(padded: PaddedGrid, bounds: Bounds, root: int, cost: Floats, kept: KeptScratch) -> float:
    """Costs where entering a cell costs the same from everywhere. Returns a bound, s, that none exceeds."""
    size, rule, (lowest, highest, dearest) = padded[0].size, padded[3], bounds
    width = float(np.float32(lowest * NARROW))
    needed = highest * dearest / width + 3
    if needed <= MOST_BUCKETS:
        count = 1 << max(2, math.ceil(math.log2(needed)))
        if (size, count) not in kept:
            kept.clear()
            kept[size, count] = queue_dial.make_scratch(size, rule, count)
        last = queue_dial.grow_whole(padded, cost, root, (width, count), kept[size, count])
        if last != TOO_FINE:
            return (last + 1) * width
    if (size, 0) not in kept:
        kept.clear()
        kept[size, 0] = queue_wide.make_scratch(size, rule)
    return float(queue_wide.grow_by_wide_buckets(padded, cost, root, width, kept[size, 0]))


def floats_of_bits(bits: tuple[int, int]) -> tuple[float, float]:
    """Two float32 numbers, given as integers of the same bits."""
    lowest, highest = struct.unpack("=2f", struct.pack("=2i", *bits))
    return lowest, highest


_SAMPLE = 1 << 10
"""Number of cells in the sample for the usual cell cost."""
_RARE = 1 / 16
"""Share of the sampled cells that may cost less than the usual cost."""
_FEW, _NEAR = 16.0, 4.0
"""Buckets are as wide as the lowest cell cost if the highest is at most `_FEW`, or the usual one at most `_NEAR`,
times that."""


def grow_directed_costs(
    padded: PaddedGrid,
    climbs: Climbs,
    bounds: tuple[float, float, float],
    root: int,
    cost: Floats,
    kept: dict[tuple[int, int], Any],
) -> None:
    """Computes exact costs to a padded, passable root, written whole. Arguments as of `grow_tree`."""
    cell_cost = padded[0]
    key = cell_cost.size, 0
    if key not in kept:
        kept.clear()
        kept[key] = make_scratch(cell_cost.size)
    width, may_lead_back = _width(cell_cost, *bounds[:2])
    grow_directed_by_buckets(padded, cost, root, climbs, width, may_lead_back, kept[key])


def _width(cell_cost: Floats, lowest: float, highest: float) -> tuple[float, bool]:
    """Width (s) of the finest buckets, and whether some steps may cost less than that.

    Returns a width at which one level of buckets is as wide as the usual cell cost asks for, and the finest no
    wider than the lowest does.
    """
    if highest > _FEW * lowest:
        sample = cell_cost[:: max(cell_cost.size // _SAMPLE, 1)]
        sample = sample[sample < np.inf]
        rank = int(sample.size * _RARE)
        usual = float(np.partition(sample, rank)[rank]) if sample.size else lowest
        if usual > _NEAR * lowest:
            width = usual * WIDTH
            while width > lowest:
                width /= 1 << BASE_BITS
            return width, True
    return lowest * WIDTH, False


Box = tuple[int, int, int, int]

_SMALL = 1 << 16
"""Padded cells of a small window, whose scratch is worth keeping."""


class GrownWindow(NamedTuple):
    """Costs and parents of a window as a padded grid of its own, s.

    way  s; cost from the old root to the new one inside the window; inf if no path exists
    """

    box: Box
    cost: Floats
    parent: NDArray[np.uint8] | None
    way: float


def grow_window(
    grid: CostGrid, root: int, old: int, window: Window, kept: KeptScratch, with_parents: bool
) -> GrownWindow:
    """Grows a window that holds the new root and the old one. Raises OutsideGridError where it is not inside the
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


def padded_climbs(climb: Climb, rule: int) -> tuple[Climbs, float]:
    """Returns (climbs, the highest cost of an allowed step, in cell costs)."""
    grid = climb.grid
    height = np.zeros((grid.rows + 2, grid.cols + 2), np.float32)
    height[1:-1, 1:-1] = climb.elevation_m
    diagonal = {RULE_FOUR: np.float32(np.inf), RULE_OCTILE: SQRT2}.get(rule, np.float32(1.0))
    tables = climb.table[: 8 if climb.windy else 2] / np.float32(climb.lowest)
    tables[1::2] *= diagonal
    begins = (np.arange(8) % len(tables) * tables.shape[1]).astype(np.int32)
    per_metre = np.array(climb.per_metre, np.float32)
    climbs = height.reshape(-1), tables.reshape(-1), per_metre, begins, *_rows(grid.cols + 2)
    return climbs, float(tables[tables < np.inf].max())


def with_scratch(climbs: Climbs) -> Climbs:
    """The same, with rows of its own to write to: one thread's."""
    return *climbs[:4], *_rows(climbs[4].size)


def _rows(stride: int) -> tuple[Floats, Floats, Floats, NDArray[np.int32]]:
    keys, best, codes = np.empty((3, stride), np.float32)
    return keys, best, codes, np.empty(stride, np.int32)


def climbs_in(climbs: Climbs, stride: int, box: tuple[int, int, int, int]) -> Climbs:
    """Returns the climbs of a window, as a padded grid of its own."""
    row0, col0, row1, col1 = box
    part = climbs[0].reshape(-1, stride)[row0 : row1 + 2, col0 : col1 + 2]
    return np.ascontiguousarray(part).reshape(-1), *climbs[1:]


def turned_round(climbs: Climbs) -> Climbs:
    """Reverses grades and wind, for searches that start at the vehicle."""
    height, prices, scale, begins, keys, best, codes, entries = climbs
    tables = np.roll(prices.reshape(-1, int(begins[1])), 4, axis=0)
    return -height, tables.reshape(-1), scale, begins, keys, best, codes, entries
