"""A full growth: which queue suits the cell costs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import bucket_queue, radix_heap
from planner_service.kernels.cell_costs import cell_cost_range
from planner_service.kernels.climbs import Climbs
from planner_service.kernels.layout import TOO_FINE, PaddedGrid
from planner_service.kernels.parents import point_to_parents
from planner_service.kernels.tied_parents import untie_parents
from planner_service.tree.directed_growth import grow_directed_costs
from shared_map.arrays import Floats

MAX_RATIO = 1 << 12
"""Between dearest and cheapest step: beyond it, turning over buckets as narrow as the cheapest, most of them empty,
costs more than a radix heap; on a small grid, beyond one bucket for so many cells:"""
CELLS_PER_BUCKET = 16
SMALL_RATIO = 64
"""No grid is so small that a queue of this many buckets does not pay."""
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
    box = (0, 0, size // stride - 2, stride - 2)
    if climbs is not None:
        grow_directed_costs(padded, climbs, bounds, root, cost, {} if kept is None else kept)
        if parent is None:
            return math.inf
        reach = float(np.array(cell_cost_range(cost.view(np.int32)), np.int32).view(np.float32)[1])
        point_to_parents(padded, climbs, cost, root, box, parent)
        if reach > FINE * lowest:
            untie_parents(padded, climbs, (cost, parent, root), np.empty(2 * size, np.uint32))
        return reach
    width = float(np.float32(lowest * 0.98))
    last = _grow_by_buckets(padded, bounds, width, root, cost, {} if kept is None else kept)
    if last != TOO_FINE:
        if parent is not None:
            point_to_parents(padded, None, cost, root, box, parent)
        return float((last + 1) * width)
    parents = np.empty(size, np.uint8) if parent is None else parent
    scratch = radix_heap.make_scratch(size, padded[3])
    reach = float(radix_heap.grow_by_radix_heap(padded, (cost, parents, root), lowest, scratch))
    if parent is not None and reach <= FINE * lowest:
        point_to_parents(padded, None, cost, root, box, parent)
    return reach


def _grow_by_buckets(
    padded: PaddedGrid, bounds: Bounds, width: float, root: int, cost: Floats, kept: KeptScratch
) -> int:
    """The last bucket; TOO_FINE where buckets do not suit."""
    cell_cost, _, _, rule, _ = padded
    size, (lowest, highest, dearest) = cell_cost.size, bounds
    if highest / lowest > min(MAX_RATIO, max(SMALL_RATIO, size // CELLS_PER_BUCKET)):
        return TOO_FINE
    count = 1 << max(2, math.ceil(math.log2(highest * dearest / width + 3)))
    if (size, count) not in kept:
        kept.clear()
        kept[size, count] = bucket_queue.make_scratch(size, rule, count)
    return int(bucket_queue.grow_by_buckets(padded, cost, root, (width, count), kept[size, count]))
