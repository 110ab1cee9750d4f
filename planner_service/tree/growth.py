"""A full growth: which queue suits the cell costs."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import bucket_queue, wide_buckets
from planner_service.kernels.climbs import Climbs
from planner_service.kernels.layout import TOO_FINE, PaddedGrid
from planner_service.kernels.parents import point_to_parents
from planner_service.kernels.tied_parents import untie_parents
from planner_service.tree.cost_range import CostRange
from planner_service.tree.directed_growth import grow_directed_costs
from shared_map.arrays import Floats

MOST_BUCKETS = 1 << 8
"""As narrow as the cheapest step: where the dearest takes more of them, their width follows the map."""
_NARROW = 0.98
"""Width of a bucket, in lowest cell costs, that no cell in it leads back into, whatever the rounding."""
FINE = float(1 << 20)
"""While no cost exceeds so many lowest cell costs, float32 tells any cell's cost from its parent's."""

Bounds = tuple[float, float, float]
"""Lowest and highest finite cell cost, s, and what the dearest step that is not forbidden costs, in cell costs."""

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
    """Grow the exact tree of a padded, passable root. Returns a bound, s, that no cost exceeds.

    climbs         of the same cells; None where entering a cell costs the same from everywhere
    cost, parent   padded, written whole; None where parents, and a bound, are not wanted
    kept           scratch of the last growth, for one of the same size: small ones feel what it takes to make it
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
        # Steps may be lost in the rounding of the ways behind them, and parents lead in a circle.
        untie_parents(padded, climbs, (cost, parent, root), np.empty(2 * size, np.uint32))
    return reach


def _grow_alike(padded: PaddedGrid, bounds: Bounds, root: int, cost: Floats, kept: KeptScratch) -> float:
    """Costs where entering a cell costs the same from everywhere. Returns a bound, s, that none exceeds."""
    size, rule, (lowest, highest, dearest) = padded[0].size, padded[3], bounds
    width = float(np.float32(lowest * _NARROW))
    needed = highest * dearest / width + 3
    if needed <= MOST_BUCKETS:
        count = 1 << max(2, math.ceil(math.log2(needed)))
        if (size, count) not in kept:
            kept.clear()
            kept[size, count] = bucket_queue.make_scratch(size, rule, count)
        last = int(bucket_queue.grow_by_buckets(padded, cost, root, (width, count), kept[size, count]))
        if last != TOO_FINE:
            return (last + 1) * width
    if (size, 0) not in kept:
        kept.clear()
        kept[size, 0] = wide_buckets.make_scratch(size, rule)
    return float(wide_buckets.grow_by_wide_buckets(padded, cost, root, width, kept[size, 0]))


def floats_of_bits(bits: tuple[int, int]) -> tuple[float, float]:
    """Two float32 numbers, given as integers of the same bits."""
    lowest, highest = struct.unpack("=2f", struct.pack("=2i", *bits))
    return lowest, highest
