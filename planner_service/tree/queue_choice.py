"""Choice of the queue which grows a tree: the one that suits the cell costs, with its scratch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import dial_growth, multilevel_growth
from planner_service.kernels.climbs import Climbs
from planner_service.kernels.layout import TOO_FINE, PaddedGrid
from planner_service.kernels.parents_from_costs import point_to_parents, untie_parents
from planner_service.tree.cost_changes import CostRange
from shared_map.array_files import Floats

MOST_BUCKETS = 1 << 8
"""Buckets are as narrow as the cheapest step, unless the costliest takes more of them."""
NARROW = 0.98
"""Width of a bucket, in lowest cell costs, that no cell in it leads back into, whatever the rounding."""
FINE = float(1 << 20)
"""While no cost exceeds this number of lowest cell costs, float32 distinguishes any cell's cost from its
parent's."""

Bounds = tuple[float, float, float]
"""Lowest and highest finite cell cost, s, and the highest cost of an allowed step, in cell costs."""

KeptScratch = dict[tuple[int, int], Any]
"""Scratch by padded cells and buckets: one at most, of one thread, one rule and one kind of step."""

_SAMPLE = 1 << 10
"""Number of cells in the sample for the usual cell cost."""
_RARE = 1 / 16
"""Share of the sampled cells that may cost less than the usual cost."""
_FEW, _NEAR = 16.0, 4.0
"""Buckets are as wide as the lowest cell cost if the highest is at most `_FEW`, or the usual one at most `_NEAR`,
times that."""


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
    size, lowest, scratch_of = cell_cost.size, bounds[0], {} if kept is None else kept
    reach = None if climbs is not None else _grow_narrow(padded, bounds, root, cost, scratch_of)
    if reach is None:
        width, may_lead_back = _finest_width(cell_cost, *bounds[:2])
        scratch = _scratch(scratch_of, (size, 0), lambda: multilevel_growth.make_scratch(size))
        multilevel_growth.grow_by_levels(padded, climbs, cost, root, width, may_lead_back, scratch)
        reach = math.inf if parent is None else CostRange(cost).highest
    if parent is None:
        return reach
    point_to_parents(padded, climbs, cost, root, (0, 0, size // stride - 2, stride - 2), parent)
    if reach > FINE * lowest:
        # Steps may be lost in the rounding of the paths behind them, and parents lead in a circle.
        untie_parents(padded, climbs, (cost, parent, root), np.empty(2 * size, np.uint32))
    return reach


def _grow_narrow(padded: PaddedGrid, bounds: Bounds, root: int, cost: Floats, kept: KeptScratch) -> float | None:
    """Costs by buckets as narrow as the cheapest step. Returns a bound, s, that none exceeds; None where it takes
    too many buckets, or where costs become too large for float32."""
    size, rule, (lowest, highest, dearest) = padded[0].size, padded[3], bounds
    width = float(np.float32(lowest * NARROW))
    needed = highest * dearest / width + 3
    if needed > MOST_BUCKETS:
        return None
    count = 1 << max(2, math.ceil(math.log2(needed)))
    scratch = _scratch(kept, (size, count), lambda: dial_growth.make_scratch(size, rule, count))
    state, at_once = np.empty(5, np.int64), (np.array((root,)), dial_growth.WHOLE, dial_growth.NO_AIM)
    last = int(dial_growth.grow_by_buckets(padded, cost, (width, count), scratch, state, *at_once))
    return None if last == TOO_FINE else (last + 1) * width


def _finest_width(cell_cost: Floats, lowest: float, highest: float) -> tuple[float, bool]:
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
            width = usual * multilevel_growth.WIDTH
            while width > lowest:
                width /= 1 << multilevel_growth.BASE_BITS
            return width, True
    return lowest * multilevel_growth.WIDTH, False


def _scratch(kept: KeptScratch, key: tuple[int, int], make: Callable[[], Any]) -> Any:
    if key not in kept:
        kept.clear()
        kept[key] = make()
    return kept[key]
