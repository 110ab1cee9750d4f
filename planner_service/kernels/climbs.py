"""Effect of a step's rise on its cost: the one function by which all kernels price a step.

With direction-dependent costs, a step from v into its neighbour u costs cell_cost[u] * step_price(climbs, v, u,
way), which includes its length; `way` is its direction 0..7. A step that u offers v leads back: its way is that
from u to v, turned round.

    height  float32  (size,)           m, padded; NaN is a void, and a step from or to it is level
    prices  float32  (tables * entries,)  one table behind the other, by rise: factor times length; the least is 1
                                       or more, and inf forbids the step. In still air there are two tables, of
                                       straight steps and of diagonal ones; in wind there is one for each way
    scale   float32  (2,)              of straight and diagonal steps, entries of a table per metre of rise, from
                                       the middle on
    begins  int32    (8,)              where the table of each way begins in `prices`; the second table is that of
                                       way 1, so that begins[1] is how many entries a table has
    keys, best, codes  float32 (stride,)  scratch of a row: offers, s; the least of them; whose that is
    entries            int32   (stride,)  the same: entries of `prices`
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.decorators import helper

Floats = NDArray[np.float32]

Climbs = tuple[Floats, Floats, Floats, NDArray[np.int32], Floats, Floats, Floats, NDArray[np.int32]]
"""(height, prices, scale, begins, keys, best, codes, entries)."""

CLIMBS = "Tuple((f4[::1], f4[::1], f4[::1], i4[::1], f4[::1], f4[::1], f4[::1], i4[::1]))"

_HALF = np.float32(0.5)
_LEVEL = np.float32(0.0)


def with_scratch(climbs: Climbs) -> Climbs:
    """The same, with rows of its own to write to: one thread's."""
    return *climbs[:4], *row_scratch(climbs[4].size)


def row_scratch(stride: int) -> tuple[Floats, Floats, Floats, NDArray[np.int32]]:
    """(keys, best, codes, entries) of a map whose rows are so long."""
    keys, best, codes = np.empty((3, stride), np.float32)
    return keys, best, codes, np.empty(stride, np.int32)


def climbs_in(climbs: Climbs, stride: int, box: tuple[int, int, int, int]) -> Climbs:
    """Returns the climbs of a window, as a padded grid of its own."""
    row0, col0, row1, col1 = box
    part = climbs[0].reshape(-1, stride)[row0 : row1 + 2, col0 : col1 + 2]
    return np.ascontiguousarray(part).reshape(-1), *climbs[1:]


def turned_round(climbs: Climbs) -> Climbs:
    """Reverses grades and wind, for searches that start at the vehicle."""
    height, prices, scale, begins, keys, best, codes, entries = climbs
    tables = np.roll(prices.reshape(-1, int(begins[1])), 4, axis=0)
    return -height, tables.reshape(-1), scale, begins, keys, best, codes, entries


@helper
def entry_of(rise, scale, half):
    """int32: which entry of a table a rise (m) has."""
    at = rise * scale
    at = at if at == at else _LEVEL
    return np.int32(min(max(at, -half), half) + half + _HALF)


@helper
def _half_of(begins):
    """float32: the entry of a level step, in the middle of a table."""
    return np.float32(begins[1] >> 1)


@helper
def is_windy(climbs):
    """Returns True if each direction has a table of its own."""
    return climbs[3][2] != climbs[3][0]


@helper
def step_price(climbs, v, u, way):
    """Returns the cost of the step from v into its neighbour u, in direction `way`, in cell costs of u."""
    height, prices, scale, begins = climbs[0], climbs[1], climbs[2], climbs[3]
    entry = entry_of(height[u] - height[v], scale[way & 1], _half_of(begins))
    return prices[np.uint64(begins[way] + entry)]


@helper
def offered(base, own, climbs, v, u, way, length):
    """Returns the cost that a cell u, which costs `base` and whose cell cost is `own`, offers its neighbour v,
    which enters it in direction `way`, s.

    climbs  None where entering a cell costs the same from everywhere: then a step costs its length
    """
    if climbs is None:
        return base + own * length
    return base + own * step_price(climbs, v, u, way)


@helper
def find_entries(rises, first, n, climbs, way, entries):
    """entries := int32, which of `prices` each of `n` rises (m) in direction `way` has. A loop of its own
    vectorises."""
    length, half, begin = climbs[2][way & 1], _half_of(climbs[3]), climbs[3][way]
    for i in range(n):
        entries[first + i] = begin + entry_of(rises[first + i], length, half)


@helper
def offers_of_row(cell_cost, cost, climbs, way, first, n, o):
    """keys := what each of `n` cells from `first` on is offered by its neighbour o cells further (unsigned), in
    direction `way`.

    In three loops, of which the first and the last vectorise: in one, it takes three times as long.
    """
    height, prices, scale, begins, keys, _, _, entries = climbs
    length, half, begin = scale[way & 1], _half_of(begins), begins[way]
    for i in range(n):
        v = first + i
        entries[i] = begin + entry_of(height[v + o] - height[v], length, half)
    for i in range(n):
        keys[i] = prices[np.uint64(entries[i])]
    for i in range(n):
        u = first + i + o
        keys[i] = cost[u] + cell_cost[u] * keys[i]
