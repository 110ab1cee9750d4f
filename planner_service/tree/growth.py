"""A full growth: which queue suits the cell costs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import bucket_queue, directed_buckets, wide_buckets
from planner_service.kernels.climbs import Climbs
from planner_service.kernels.directed_growth import grow_directed
from planner_service.kernels.layout import TOO_FINE, Labels, PaddedGrid
from planner_service.kernels.parents import point_to_parents
from shared_map.arrays import Floats

MOST_BUCKETS = 1 << 8
"""As narrow as the cheapest step: where the dearest takes more of them, their width follows the map."""
FINE = float(1 << 20)
"""While no cost exceeds so many lowest cell costs, float32 tells any cell's cost from its parent's."""

MAX_RATIO = 1 << 12
"""Between dearest and cheapest step that cost by what they climb: beyond it, turning over buckets as narrow as the
cheapest, most of them empty, does not pay; on a small grid, beyond one bucket for so many cells:"""
CELLS_PER_BUCKET = 16
SMALL_RATIO = 64
"""No grid is so small that a queue of this many buckets does not pay."""
MOST_CLIMBED = 1 << 14
"""Buckets of such a growth: few steps are as dear as the dearest, so that more of them pay."""
_NARROW = 0.98
"""Width of a bucket, in lowest cell costs, that no cell in it leads back into, whatever the rounding."""
_WIDE = 2.0
"""Width of a bucket, in lowest cell costs, where a cell may be taken twice. Measured from 1 to 40."""
_MOST_WIDE = 1 << 12


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
    cost, parent   padded, written whole; None where parents are not wanted
    kept           scratch of the last growth, for one of the same size: small ones feel what it takes to make it
    """
    size, stride = padded[0].size, padded[2]
    box = (0, 0, size // stride - 2, stride - 2)
    scratch_of = {} if kept is None else kept
    if climbs is None:
        reach = _grow_alike(padded, bounds, root, cost, scratch_of)
        if parent is not None:
            point_to_parents(padded, None, cost, root, box, parent)
        return reach
    lowest = bounds[0]
    width = float(np.float32(lowest * directed_buckets.WIDTH))
    last = _grow_by_buckets(padded, climbs, bounds, width, root, cost, scratch_of)
    if last != TOO_FINE:
        if parent is not None:
            point_to_parents(padded, climbs, cost, root, box, parent)
        return float((last + 1) * width)
    parents = np.empty(size, np.uint8) if parent is None else parent
    reach = _grow_in_order(padded, climbs, bounds, (cost, parents, root))
    if parent is not None and reach <= FINE * lowest:
        point_to_parents(padded, climbs, cost, root, box, parent)
    return reach


def _grow_alike(padded: PaddedGrid, bounds: Bounds, root: int, cost: Floats, kept: KeptScratch) -> float:
    """Where entering a cell costs the same from everywhere."""
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


def _grow_by_buckets(
    padded: PaddedGrid,
    climbs: Climbs,
    bounds: Bounds,
    width: float,
    root: int,
    cost: Floats,
    kept: KeptScratch,
) -> int:
    """The last bucket; TOO_FINE where buckets do not suit."""
    size, (lowest, highest, dearest) = padded[0].size, bounds
    if highest / lowest > min(MAX_RATIO, max(SMALL_RATIO, size // CELLS_PER_BUCKET)):
        return TOO_FINE
    count = 1 << max(2, math.ceil(math.log2(highest * dearest / width + 3)))
    if count > MOST_CLIMBED:
        return TOO_FINE
    if (size, count) not in kept:
        kept.clear()
        kept[size, count] = directed_buckets.make_scratch(size, count)
    scratch = kept[size, count]
    return int(directed_buckets.grow_directed_by_buckets(padded, cost, root, climbs, (width, count), scratch))


def _grow_in_order(padded: PaddedGrid, climbs: Climbs, bounds: Bounds, labels: Labels) -> float:
    """Whatever the ratio of costs is; parents are written, too."""
    size, (lowest, highest, dearest) = padded[0].size, bounds
    width = max(lowest * _WIDE, highest * dearest / (_MOST_WIDE - 4))
    count = 1 << math.ceil(math.log2(highest * dearest / width + 3))
    links, first = np.empty((size, 2), np.int32), np.empty(count, np.int32)
    return float(grow_directed(padded, labels, climbs, (width, count), links, first))
