"""Choice of the queue which grows a tree: the one that suits the cell costs, with its scratch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import queue_dial, queue_directed, queue_wide_buckets
from planner_service.kernels.climbs import Climbs
from planner_service.kernels.layout import TOO_FINE, PaddedGrid
from planner_service.kernels.parents_from_costs import point_to_parents, untie_parents
from planner_service.tree.cost_changes import CostRange
from shared_map.array_files import Floats

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
    size, lowest = cell_cost.size, bounds[0]
    scratch_of = {} if kept is None else kept
    if climbs is not None:
        width, may_lead_back = _directed_width(cell_cost, *bounds[:2])
        scratch = _scratch(scratch_of, (size, 0), lambda: queue_directed.make_scratch(size))
        queue_directed.grow_directed_by_buckets(padded, cost, root, climbs, width, may_lead_back, scratch)
        reach = math.inf if parent is None else CostRange(cost).highest
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
        narrow = _scratch(kept, (size, count), lambda: queue_dial.make_scratch(size, rule, count))
        state, at_once = np.empty(5, np.int64), (np.array((root,)), queue_dial.WHOLE, queue_dial.NO_AIM)
        last = int(queue_dial.grow_by_buckets(padded, cost, (width, count), narrow, state, *at_once))
        if last != TOO_FINE:
            return (last + 1) * width
    wide = _scratch(kept, (size, 0), lambda: queue_wide_buckets.make_scratch(size, rule))
    return float(queue_wide_buckets.grow_by_wide_buckets(padded, cost, root, width, wide))


def _directed_width(cell_cost: Floats, lowest: float, highest: float) -> tuple[float, bool]:
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
            width = usual * queue_directed.WIDTH
            while width > lowest:
                width /= 1 << queue_directed.BASE_BITS
            return width, True
    return lowest * queue_directed.WIDTH, False


def _scratch(kept: KeptScratch, key: tuple[int, int], make: Callable[[], Any]) -> Any:
    if key not in kept:
        kept.clear()
        kept[key] = make()
    return kept[key]
