"""A full growth: which flood suits the weights."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import bucket_queue as kernels
from planner_service.kernels.layout import RULE_OCTILE, SQRT2_EXACT, TOO_FINE
from planner_service.kernels.radix_heap import flood_wide
from shared_map.arrays import Floats

MAX_RATIO = 1 << 12
"""Between dearest and cheapest step: beyond it, turning over buckets as narrow as the cheapest, most of them empty,
costs more than a radix heap; on a small grid, beyond one bucket for so many cells:"""
CELLS_PER_BUCKET = 16
SMALL_RATIO = 64
"""No grid is so small that a ring of this many buckets does not pay."""
FINE = float(1 << 20)
"""While no cost exceeds so many smallest weights, float32 tells any cell's cost from its parent's."""


def flood(
    weight: Floats,
    low: float,
    high: float,
    stride: int,
    root: int,
    rule: int,
    corners: bool,
    cost: Floats,
    parent: NDArray[np.uint8] | None,
) -> float:
    """Grow the exact tree of a padded root. Returns a bound that no cost exceeds.

    low, high  bounds of the finite weights, s
    """
    box = (0, 0, weight.size // stride - 2, stride - 2)
    longest = high * (SQRT2_EXACT if rule == RULE_OCTILE else 1.0)
    if longest <= min(MAX_RATIO, max(SMALL_RATIO, weight.size // CELLS_PER_BUCKET)) * low:
        width = np.float32(low * 0.98)
        ring = 1 << max(2, math.ceil(math.log2(longest / float(width) + 3)))
        last = kernels.flood(weight, cost, stride, root, rule, corners, width, ring)
        if last != TOO_FINE:
            if parent is not None:
                kernels.point_to_parents(weight, cost, stride, rule, corners, root, box, parent)
            return float((last + 1) * width)
    parents = np.empty(weight.size, np.uint8) if parent is None else parent
    reach = float(flood_wide(weight, cost, stride, root, rule, corners, np.float32(low), parents))
    if parent is not None and reach <= FINE * low:
        kernels.point_to_parents(weight, cost, stride, rule, corners, root, box, parent)
    return reach
