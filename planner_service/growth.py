"""A full growth: which flood suits the weights."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import flood as kernels
from planner_service.kernels.rules import RULE_OCTILE, RULE_PAPER, SQRT2_EXACT, TOO_FINE
from shared_map.arrays import Floats

MAX_RATIO = 1 << 14
"""Between dearest and cheapest step: beyond it buckets as wide as the cheapest give way to a heap."""
FINE = float(1 << 20)
"""While no cost exceeds so many smallest weights, float32 tells any cell's cost from its parent's."""

ALL_CELLS = np.empty(0, np.uint8)


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
    active: NDArray[np.uint8] = ALL_CELLS,
) -> float:
    """Grow the exact tree of a padded root. Returns a bound that no cost exceeds.

    active  cells that take part; the cost of others is without meaning, and so are all parents. inf is returned,
    and
            nothing done, where the weights' ratio is too large for that
    """
    longest = high * (SQRT2_EXACT if rule == RULE_OCTILE else 1.0)
    if longest <= min(MAX_RATIO, max(512, weight.size // 16)) * low:
        width = np.float32(low * 0.98)
        ring = 1 << max(2, math.ceil(math.log2(longest / float(width) + 3)))
        shift = 6 if ring <= 64 else 4
        if rule == RULE_OCTILE:
            last = kernels.flood_octile(weight, active, cost, stride, root, corners, width, ring, shift)
        else:
            diagonals = rule == RULE_PAPER
            last = kernels.flood_single(weight, active, cost, stride, root, diagonals, corners, width, ring, shift)
        if last != TOO_FINE:
            if parent is not None:
                rows = weight.size // stride - 2
                kernels.point_to_parents(
                    weight, cost, stride, rule, corners, root, (0, 0, rows, stride - 2), parent
                )
            return float((last + 1) * width)
    if active.size:
        return math.inf
    touched = np.empty(weight.size, np.uint8) if parent is None else parent
    reach = float(kernels.flood_wide(weight, cost, stride, root, rule, corners, touched))
    if parent is not None and reach <= FINE * low:
        box = (0, 0, weight.size // stride - 2, stride - 2)
        kernels.point_to_parents(weight, cost, stride, rule, corners, root, box, parent)
    return reach
