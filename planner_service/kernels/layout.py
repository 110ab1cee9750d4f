"""What all kernels agree on: how arrays are laid out, which steps there are, what the special values mean.

All arrays are flat and padded: a grid of `rows` x `cols` lies in `(rows + 2) * stride` cells, stride = cols + 2,
with a border of lethal cells, so that no neighbour of an inner cell needs a bounds check.

    weight   float32  s; what entering a cell by a straight step costs (pace * resolution); inf is lethal
    cost     float32  s; cheapest known cost to the root, less the tree's offset; inf where there is no way
    parent   uint8    direction 0..7 of the next cell towards the root; NONE at the root and where there is no way

`rule`: RULE_FOUR steps to 4 neighbours; RULE_PAPER to 8, all of length 1; RULE_OCTILE to 8, diagonals sqrt(2) long.
`corners`: whether a diagonal step may pass a lethal cell.

Kernels take these as constants when they are compiled, and numba's disk cache watches only a kernel's own file:
a value here never changes, and kernels that call each other live in one file, even where two files then hold the
same few lines.
"""

from __future__ import annotations

import numpy as np

RULE_FOUR = 0
RULE_PAPER = 1
RULE_OCTILE = 2

NONE = np.uint8(255)
SQRT2 = np.float32(1.4142135623730951)
SQRT2_EXACT = 1.4142135623730951
INF = np.float32(np.inf)
HUGE = np.float32(3.4028235e38)
WALL = np.float32(-np.inf)
"""While growing, the cost of a lethal cell. No minimum lifts it; and max(key, -WALL) is inf, an offer that nobody
takes, without a branch."""

TOO_FINE = -1
"""Returned by a flood whose keys grew so large, in smallest weights, that float32 could not tell them apart."""
