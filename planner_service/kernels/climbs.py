"""What a step's rise does to its cost: the one function by which all kernels price a step.

Where cost depends on direction, a step from v into its neighbour u costs cell_cost[u] * step_price(climbs, v, u,
odd), which holds its length, too.

    height  float32  (size,)           m, padded; NaN is a void, and a step from or to it is level
    prices  float32  (2 * entries,)    of straight steps, then of diagonal ones, by rise: factor times length; the
                                       least is 1, and inf forbids the step
    scale   float32  (2,)              of straight and diagonal steps, entries of `prices` per metre of rise, from
                                       the middle on
    keys, best, codes  float32 (stride,)  scratch of a row: offers, s; the least of them; whose that is
    entries            int32   (stride,)  the same: entries of `prices`
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.compile import helper

Floats = NDArray[np.float32]

Climbs = tuple[Floats, Floats, Floats, Floats, Floats, Floats, NDArray[np.int32]]
"""(height, prices, scale, keys, best, codes, entries)."""

CLIMBS = "Tuple((f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], f4[::1], i4[::1]))"

_HALF = np.float32(0.5)
_LEVEL = np.float32(0.0)


@helper
def _entry(rise, scale, half, begin):
    """int32: which of `prices`, from `begin` on, a rise (m) has."""
    at = rise * scale
    at = at if at == at else _LEVEL
    return np.int32(min(max(at, -half), half) + half + _HALF) + begin


@helper
def step_price(climbs, v, u, odd):
    """What the step from v into its neighbour u costs, in cell costs of u; `odd` is 1 of a diagonal step."""
    height, prices, scale = climbs[0], climbs[1], climbs[2]
    count = prices.size >> 1
    begin = np.int32(odd * count)
    return prices[np.uint64(_entry(height[u] - height[v], scale[odd], np.float32(count >> 1), begin))]


@helper
def offered(base, own, climbs, v, u, odd, length):
    """What a cell u, which costs `base` and whose cell cost is `own`, offers its neighbour v, s.

    climbs  None where entering a cell costs the same from everywhere: then a step costs its length
    """
    if climbs is None:
        return base + own * length
    return base + own * step_price(climbs, v, u, odd)


@helper
def find_entries(rises, first, n, climbs, odd, entries):
    """entries := int32, which of `prices` each of `n` rises (m) has. A loop of its own vectorises."""
    prices, scale = climbs[1], climbs[2]
    length, count = scale[odd], prices.size >> 1
    half, begin = np.float32(count >> 1), np.int32(odd * count)
    for i in range(n):
        entries[first + i] = _entry(rises[first + i], length, half, begin)


@helper
def offers_of_row(cell_cost, cost, climbs, odd, first, n, o):
    """keys := what each of `n` cells from `first` on is offered by its neighbour o cells further (unsigned).

    In three loops, of which the first and the last vectorise: in one, it takes three times as long.
    """
    height, prices, scale, keys, _, _, entries = climbs
    length, count = scale[odd], prices.size >> 1
    half, begin = np.float32(count >> 1), np.int32(odd * count)
    for i in range(n):
        v = first + i
        entries[i] = _entry(height[v + o] - height[v], length, half, begin)
    for i in range(n):
        keys[i] = prices[np.uint64(entries[i])]
    for i in range(n):
        u = first + i + o
        keys[i] = cost[u] + cell_cost[u] * keys[i]
