"""A full growth: which queue suits the cell costs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import bucket_queue, radix_heap
from planner_service.kernels.layout import RULE_OCTILE, SQRT2_EXACT, TOO_FINE, PaddedGrid
from planner_service.kernels.parents import point_to_parents
from shared_map.arrays import Floats

MAX_RATIO = 1 << 12
"""Between dearest and cheapest step: beyond it, turning over buckets as narrow as the cheapest, most of them empty,
costs more than a radix heap; on a small grid, beyond one bucket for so many cells:"""
CELLS_PER_BUCKET = 16
SMALL_RATIO = 64
"""No grid is so small that a queue of this many buckets does not pay."""
FINE = float(1 << 20)
"""While no cost exceeds so many lowest cell costs, float32 tells any cell's cost from its parent's."""


KeptScratch = dict[tuple[int, int], bucket_queue.Scratch]
"""By padded cells and buckets: one at most, of one thread and one rule."""


def grow_tree(
    padded: PaddedGrid,
    lowest: float,
    highest: float,
    root: int,
    cost: Floats,
    parent: NDArray[np.uint8] | None,
    kept: KeptScratch | None = None,
) -> float:
    """Grow the exact tree of a padded, passable root. Returns a bound, s, that no cost exceeds.

    lowest, highest  bounds of the finite cell costs, s
    cost, parent     padded, written whole; None where parents are not wanted
    kept             scratch of the last growth, for one of the same size: small ones feel what it takes to make it
    """
    cell_cost, _, stride, rule, _ = padded
    size = cell_cost.size
    box = (0, 0, size // stride - 2, stride - 2)
    longest = highest * (SQRT2_EXACT if rule == RULE_OCTILE else 1.0)
    if longest <= min(MAX_RATIO, max(SMALL_RATIO, size // CELLS_PER_BUCKET)) * lowest:
        width = np.float32(lowest * 0.98)
        count = 1 << max(2, math.ceil(math.log2(longest / float(width) + 3)))
        kept = {} if kept is None else kept
        if (size, count) not in kept:
            kept.clear()
            kept[size, count] = bucket_queue.make_scratch(size, rule, count)
        scratch = kept[size, count]
        last = bucket_queue.grow_by_buckets(padded, cost, root, (float(width), count), scratch)
        if last != TOO_FINE:
            if parent is not None:
                point_to_parents(padded, cost, root, box, parent)
            return float((last + 1) * width)
    parents = np.empty(size, np.uint8) if parent is None else parent
    labels = (cost, parents, root)
    reach = float(radix_heap.grow_by_radix_heap(padded, labels, lowest, radix_heap.make_scratch(size, rule)))
    if parent is not None and reach <= FINE * lowest:
        point_to_parents(padded, cost, root, box, parent)
    return reach
