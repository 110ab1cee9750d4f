"""Kernels of the coarse tree: which cells carry the traffic, and how the others reach them.

Arrays are laid out as `rules` says.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from planner_service.kernels.rules import NONE


@njit(cache=True, nogil=True)
def mark_traffic(parent, stride, least, skeleton):
    """skeleton := 1 wherever the ways of at least `least` cells pass, in a tree given by its parents."""
    offsets = np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))
    children = np.zeros(parent.size, np.uint8)
    traffic = np.ones(parent.size, np.uint32)
    for i in range(parent.size):
        if parent[i] != NONE:
            children[i + offsets[parent[i]]] += 1
    for i in range(parent.size):
        v = i
        # A cell is done once all its children are; then it hands on what passes through it.
        while parent[v] != NONE and children[v] == 0:
            children[v] = NONE
            if traffic[v] >= least:
                skeleton[v] = 1
            u = v + offsets[parent[v]]
            traffic[u] += traffic[v]
            children[u] -= 1
            v = u


@njit(cache=True, nogil=True)
def mark_way(parent, stride, start, skeleton):
    """skeleton := 1 along the way from a cell to where its parents lead."""
    offsets = np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))
    v = start
    skeleton[v] = 1
    while parent[v] != NONE:
        v += offsets[parent[v]]
        skeleton[v] = 1


@njit(cache=True, nogil=True)
def find_anchors(parent, stride, skeleton, anchor):
    """anchor (uint32) := the skeleton cell that each cell's parents lead to; 0 where they lead nowhere."""
    offsets = np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))
    known = np.zeros(parent.size, np.uint8)
    trail = np.empty(parent.size, np.uint32)
    for i in range(parent.size):
        anchor[i] = i if skeleton[i] else 0
        known[i] = 1 if skeleton[i] or parent[i] == NONE else 0
    for i in range(parent.size):
        v = i
        many = 0
        while known[v] == 0:
            trail[many] = v
            many += 1
            v += offsets[parent[v]]
        for j in range(many):
            anchor[trail[j]] = anchor[v]
            known[trail[j]] = 1


@njit(cache=True, nogil=True)
def fill_in(cost, active, attach, anchor):
    """After a flood over the active cells: every cell costs at most its anchor and the way there.

    attach  float32  s; what the way to the anchor costs; inf without one
    Returns how many cells have an anchor that the flood did not reach: none, unless the skeleton is torn.
    """
    torn = 0
    inf = np.float32(np.inf)
    for i in range(np.uint64(cost.size)):
        own = cost[i] if active[i] else inf
        found = min(own, cost[anchor[i]] + attach[i])
        torn += found == inf and attach[i] < inf
        cost[i] = found
    return torn
