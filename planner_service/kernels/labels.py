"""What is known of each cell of a tree beyond its cost: how long the way is.

Arrays are laid out as `rules` says.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from planner_service.kernels.rules import INF, NONE


@njit(cache=True, nogil=True)
def step_offsets(stride):
    """What each direction code 0..7 adds to a padded cell index."""
    return np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))


@njit(cache=True, nogil=True)
def path_lengths(parent, stride, straight, diagonal, root, length):
    """length (float32) := how long the way of each cell along its parents is; inf where there is none."""
    offsets = step_offsets(stride)
    unknown = np.float32(-1.0)
    for i in range(length.size):
        length[i] = unknown if parent[i] != NONE else INF
    length[root] = np.float32(0.0)
    trail = np.empty(length.size, np.uint32)
    for i in range(length.size):
        v = i
        many = 0
        while length[v] == unknown:
            trail[many] = v
            many += 1
            v += offsets[parent[v]]
        so_far = np.float64(length[v])
        for j in range(many - 1, -1, -1):
            v = np.int64(trail[j])
            so_far += diagonal if parent[v] & 1 else straight
            length[v] = so_far
