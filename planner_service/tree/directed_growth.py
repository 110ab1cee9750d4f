"""A full growth where steps cost by what they climb, too: how wide its buckets are."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner_service.kernels.climbs import Climbs
from planner_service.kernels.directed_buckets import BASE_BITS, WIDTH, grow_directed_by_buckets, make_scratch
from planner_service.kernels.layout import PaddedGrid
from shared_map.arrays import Floats

_SAMPLE = 1 << 10
"""Cells by which the usual cell cost is told."""
_RARE = 1 / 16
"""Of them, so many may cost less than the usual."""
_FEW, _NEAR = 16.0, 4.0
"""Buckets are as narrow as the lowest cell cost asks for where none is more than `_FEW` times as much, or the usual
one no more than `_NEAR` times."""


def grow_directed_costs(
    padded: PaddedGrid,
    climbs: Climbs,
    bounds: tuple[float, float, float],
    root: int,
    cost: Floats,
    kept: dict[tuple[int, int], Any],
) -> None:
    """Exact costs to a padded, passable root, written whole; the arguments are those of `growth.grow_tree`."""
    cell_cost = padded[0]
    key = cell_cost.size, 0
    if key not in kept:
        kept.clear()
        kept[key] = make_scratch(cell_cost.size)
    width, look = _width(cell_cost, *bounds[:2])
    grow_directed_by_buckets(padded, cost, root, climbs, width, look, kept[key])


def _width(cell_cost: Floats, lowest: float, highest: float) -> tuple[float, bool]:
    """s, of the finest buckets; whether some steps may cost less than that.

    So narrow that one level of buckets is as wide as the usual cell cost asks for, and the finest no wider than the
    lowest does.
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
