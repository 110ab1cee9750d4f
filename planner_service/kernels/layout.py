"""What all kernels agree on: how arrays are laid out, which steps there are, what the special values mean.

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

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.compile import njit

RULE_FOUR = 0
"""4 neighbours."""
RULE_PAPER = 1
"""8 neighbours, every step of length 1."""
RULE_OCTILE = 2
"""8 neighbours, diagonal steps sqrt(2) long."""

NONE = np.uint8(255)
SQRT2 = np.float32(1.4142135623730951)
SQRT2_EXACT = 1.4142135623730951
INF = np.float32(np.inf)
HUGE = np.float32(3.4028235e38)
WALL = np.float32(-np.inf)
"""While growing, the cost of a lethal cell. No minimum lifts it; and max(key, -WALL) is inf, an offer that nobody
takes, without a branch."""

TOO_FINE = -1
"""Returned by a growth whose keys grew so large, in lowest cell costs, that float32 could not tell them apart."""


class PaddedGrid(NamedTuple):
    """What a search runs on. From Python it takes two microseconds more to pass one than its four parts: growth and
    parents of a small window are called with the parts."""

    cell_cost: NDArray[np.float32]
    stride: int
    rule: int
    """RULE_FOUR, RULE_PAPER or RULE_OCTILE."""
    corners: bool
    """Whether a diagonal step may pass a lethal cell."""


class Labels(NamedTuple):
    """What a search writes: a tree's labels, and the padded cell where it leads."""

    cost: NDArray[np.float32]
    parent: NDArray[np.uint8]
    root: int


class Buckets(NamedTuple):
    """Size of a bucket queue."""

    width: float | np.float32
    """s; keys less than this apart share a bucket."""
    count: int
    """How many buckets there are."""


@njit
def step_offsets(stride):
    """int64 (8,): what each direction 0..7 (north, then clockwise) adds to a padded cell."""
    return np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))


@njit
def diagonal_length(rule):
    """float32: length of a diagonal step in straight ones; inf where there is none."""
    if rule == RULE_FOUR:
        return INF
    return SQRT2 if rule == RULE_OCTILE else np.float32(1.0)


@njit
def enlarged(array, count, size):
    """Room for `size` elements, the first `count` copied. By a loop: assigning to a slice would bring along what
    numba needs for the text of its error, which takes longer to compile than any kernel here."""
    larger = np.empty(size, array.dtype)
    for i in range(count):
        larger[i] = array[i]
    return larger


@njit
def check_cells(cells, size):
    """Raises ValueError unless these are padded cells (int64): indices into arrays of so many. Called by kernels
    that are handed cells, because from Python it would take a microsecond."""
    outside = 0
    for i in range(cells.size):
        outside += cells[i] < 0 or cells[i] >= size
    if outside:
        raise ValueError("padded cells lie outside the map")
