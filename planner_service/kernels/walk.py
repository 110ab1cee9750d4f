"""Reading a tree: routes, and what is really driven along the parents. Arrays are laid out as `rules` says."""

from __future__ import annotations

import numpy as np
from numba import njit

from planner_service.kernels.rules import INF, NONE, RULE_OCTILE, SQRT2, SQRT2_EXACT


@njit(cache=True, nogil=True)
def step_offsets(stride):
    """What each direction code 0..7 adds to a padded cell index."""
    return np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))


@njit(cache=True, nogil=True)
def relabel(weight, parent, stride, rule, root, cost):
    """cost := what is really driven from each cell along its parents. `cost` is written whole."""
    offsets = step_offsets(stride)
    unknown = np.float32(-1.0)
    for i in range(cost.size):
        cost[i] = unknown if parent[i] != NONE else INF
    cost[root] = np.float32(0.0)
    trail = np.empty(cost.size, np.uint32)
    for i in range(cost.size):
        v = i
        many = 0
        while cost[v] == unknown:
            trail[many] = v
            many += 1
            v += offsets[parent[v]]
        for j in range(many - 1, -1, -1):
            v = np.int64(trail[j])
            k = parent[v]
            u = v + offsets[k]
            cost[v] = cost[u] + (weight[u] * SQRT2 if rule == RULE_OCTILE and k & 1 else weight[u])


@njit(cache=True, nogil=True)
def walk_routes(weight, parent, stride, rule, root, starts, max_steps, limit):
    """The routes from `starts` (padded cells that have a way), at most `max_steps` long where that is positive.

    limit  no route can be longer than so many steps
    Returns directions (uint8, one route after the other), ends (int64, where each stops in directions), driven
    (float64, s, recomputed along the cells), diagonals (int64, how many steps were diagonal), last (int64, the
    last cell). A cycle or a hole would be a bug: ends is -1 there.
    """
    offsets = step_offsets(stride)
    count = starts.size
    capacity = 1024
    directions = np.empty(capacity, np.uint8)
    ends = np.empty(count, np.int64)
    driven = np.empty(count, np.float64)
    diagonals = np.empty(count, np.int64)
    last = np.empty(count, np.int64)
    n = 0
    most = limit if max_steps <= 0 else min(limit, max_steps)
    for r in range(count):
        v = starts[r]
        straight_sum = 0.0
        diagonal_sum = 0.0
        slants = 0
        steps = 0
        while v != root and steps < most:
            if n == capacity:
                more = np.empty(2 * capacity, np.uint8)
                more[:n] = directions
                directions = more
                capacity *= 2
            k = parent[v]
            if k == NONE:
                break
            directions[n] = k
            n += 1
            steps += 1
            v += offsets[k]
            w = np.float64(weight[v])
            odd = k & 1
            slants += odd
            diagonal_sum += w if odd else 0.0
            straight_sum += 0.0 if odd else w
        broken = v != root and (steps == limit or parent[v] == NONE)
        ends[r] = -1 if broken else n
        driven[r] = straight_sum + diagonal_sum * (SQRT2_EXACT if rule == RULE_OCTILE else 1.0)
        diagonals[r] = slants
        last[r] = v
    return directions[:n], ends, driven, diagonals, last
