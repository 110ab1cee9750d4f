"""What a step's rise does to its cost: the one function by which all kernels price a step.

Where cost depends on direction, a step from v into its neighbour u costs cell_cost[u] * step_price(climbs, v, u,
odd), which holds its length, too.

    height  float32  (size,)           m, padded; NaN is a void, and a step from or to it is level
    prices  float32  (2 * entries,)    of straight steps, then of diagonal ones, by rise: factor times length; the
                                       least is 1, and inf forbids the step
    scale   float32  (2,)              of straight and diagonal steps, entries of `prices` per metre of rise, from
                                       the middle on
    keys, best, codes  float32 (stride,)  scratch of a row: offers, s; the least of them; whose that is
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.compile import helper

Climbs = tuple[NDArray[np.float32], ...]
"""(height, prices, scale, keys, best, codes)."""

CLIMBS = "UniTuple(f4[::1], 6)"

_HALF = np.float32(0.5)
_LEVEL = np.float32(0.0)


@helper
def step_price(climbs, v, u, odd):
    """What the step from v into its neighbour u costs, in cell costs of u; `odd` is 1 of a diagonal step."""
    height, prices, scale = climbs[0], climbs[1], climbs[2]
    entries = prices.size >> 1
    half = np.float32(entries >> 1)
    at = (height[u] - height[v]) * scale[odd]
    at = at if at == at else _LEVEL
    return prices[np.uint64(odd * entries) + np.uint64(np.int64(min(max(at, -half), half) + half + _HALF))]


@helper
def offered(base, own, climbs, v, u, odd, length):
    """What a cell u, which costs `base` and whose cell cost is `own`, offers its neighbour v, s.

    climbs  None where entering a cell costs the same from everywhere: then a step costs its length
    """
    if climbs is None:
        return base + own * length
    return base + own * step_price(climbs, v, u, odd)


@helper
def _rises_to_entries(height, scale, odd, half, first, n, o, entries):
    """entries := as floats, so that it vectorises, the entry of `prices` of each step from v to v + o."""
    length = scale[odd]
    for i in range(n):
        v = first + i
        at = (height[v + o] - height[v]) * length
        at = at if at == at else _LEVEL
        entries[i] = min(max(at, -half), half) + half + _HALF


@helper
def offers_of_row(cell_cost, cost, climbs, odd, first, n, o):
    """keys := what each of `n` cells from `first` on is offered by its neighbour o cells further (unsigned)."""
    height, prices, scale, keys = climbs[0], climbs[1], climbs[2], climbs[3]
    entries = prices.size >> 1
    begin = np.uint64(odd * entries)
    # In two loops: in one, nothing vectorises, and it takes three times as long.
    _rises_to_entries(height, scale, odd, np.float32(entries >> 1), first, n, o, keys)
    for i in range(n):
        u = first + i + o
        keys[i] = cost[u] + cell_cost[u] * prices[begin + np.uint64(np.int32(keys[i]))]
