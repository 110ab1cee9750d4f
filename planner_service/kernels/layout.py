"""Conventions of all kernels: layout of arrays, steps, sentinels.

Arrays are flat and padded. A grid of `rows` x `cols` takes `(rows + 2) * stride` cells, stride = cols + 2, with a
border of lethal cells, so that no neighbour of an inner cell needs a bounds check. "Padded cell" is an index into
such an array, "cell" an index into the grid without its border.

    cell_cost  float32  (size,)  s; price of a straight step into a cell (pace * resolution); inf is lethal
    cost       float32  (size,)  s; cheapest known cost to the root, less the tree's offset; inf where there is no
                                 way
    parent     uint8    (size,)  direction 0..7 of the next cell towards the root; NONE at the root and where there
                                 is no way

A step from u into its neighbour v costs cell_cost[v] times its length. Trees grow from the root outward, on
reversed steps: a cell u offers each neighbour its *exit key*, cost[u] + cell_cost[u] * length.
`box` is (row0, col0, row1, col1) of a window of the grid; row1 and col1 lie outside.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.decorators import helper

RULE_FOUR = 0
"""4 neighbours."""
RULE_PAPER = 1
"""8 neighbours, every step of length 1."""
RULE_OCTILE = 2
"""8 neighbours, diagonal steps sqrt(2) long."""

NONE = np.uint8(255)
"""Parent of a cell without a path: no direction code."""
SQRT2 = np.float32(1.4142135623730951)
SQRT2_EXACT = 1.4142135623730951
INF = np.float32(np.inf)
HUGE = np.float32(3.4028235e38)
"""The largest finite float32."""
WALL = np.float32(-np.inf)
"""While growing, the cost of a lethal cell. No minimum lifts it; and max(key, -WALL) is inf, an offer that no cell
takes, without a branch."""

Bytes = NDArray[np.uint8]
ByteRows = NDArray[np.uint8]
Shorts = NDArray[np.int16]
Ints = NDArray[np.int32]
IntRows = NDArray[np.int32]
Longs = NDArray[np.int64]
LongRows = NDArray[np.int64]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
DoubleRows = NDArray[np.float64]
"""Arrays of one axis, and of two, as fields of NamedTuples: `decorators.type_of` reads these names."""

TOO_FINE = -1
"""Returned by a growth whose keys grew so large, in lowest cell costs, that float32 could not tell them apart."""


PaddedGrid = tuple[NDArray[np.float32], NDArray[np.int64], int, int, bool]
"""Input of a search: (cell_cost, offsets, stride, rule, corners).

offsets  int64 (8,), what each direction 0..7 (north, then clockwise) adds to a padded cell
rule     RULE_FOUR, RULE_PAPER or RULE_OCTILE
corners  whether a diagonal step may pass a lethal cell
A plain tuple, as all that kernels are handed from Python: numba takes two microseconds to read a named one, and as
long to read a NumPy scalar.
"""

Labels = tuple[NDArray[np.float32], NDArray[np.uint8], int]
"""Output of a search: (cost, parent, root), a tree's labels and its padded root cell."""

Buckets = tuple[float, int]
"""Size of a bucket queue: (width, count). Keys less than `width` (s, rounded to float32) apart share a bucket."""


GRID = "Tuple((f4[::1], i8[::1], i8, i8, b1))"
LABELS = "Tuple((f4[::1], u1[::1], i8))"
BUCKETS = "Tuple((f8, i8))"
BOX = "UniTuple(i8, 4)"
"""The same as numba writes these types, for signatures of kernels."""


def step_offsets(stride: int) -> NDArray[np.int64]:
    """int64 (8,): what each direction 0..7 (north, then clockwise) adds to a padded cell."""
    return np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1), np.int64)


@helper
def diagonal_length(rule):
    """float32: length of a diagonal step in straight ones; inf where there is none."""
    if rule == RULE_FOUR:
        return INF
    return SQRT2 if rule == RULE_OCTILE else np.float32(1.0)


@helper
def step_length(rule, odd):
    """float32: length of a step in straight ones; `odd` is 1 of a diagonal one."""
    return SQRT2 if odd and rule == RULE_OCTILE else np.float32(1.0)


@helper
def leads_by(parent, offsets, x, k, past):
    """Returns True if the neighbour of padded cell `x` in direction `k` has x for its parent or, if `past`, one
    beyond a corner of x."""
    v = x + offsets[k]
    way = parent[v]
    if way == NONE:
        return False
    beside = way & 1 == 1 and (v + offsets[way - 1] == x or v + offsets[(way + 1) & 7] == x)
    return way == (k + 4) & 7 or (past and beside)


@helper
def is_shut(cell_cost, offsets, v, way):
    """Returns True if a lethal cell lies beside the diagonal step from cell `v` in direction `way`."""
    u = np.uint64(v)
    one, other = u + np.uint64(offsets[way - 1]), u + np.uint64(offsets[(way + 1) & 7])
    return not max(cell_cost[one], cell_cost[other]) < INF


@helper
def check_cells(cells, size):
    """Raises ValueError unless these are padded cells (int64): valid indices into arrays of this size. Called by
    kernels that are handed cells, because from Python it would take a microsecond."""
    outside = 0
    for i in range(cells.size):
        outside += cells[i] < 0 or cells[i] >= size
    if outside:
        raise ValueError("padded cells lie outside the map")
