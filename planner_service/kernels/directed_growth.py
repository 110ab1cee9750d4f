"""Growth where a step also costs by what it climbs. Arrays are laid out as `rules` says; and

    height   float32  m; NaN is a void, and a step from or to it is level
    factors  float32  (2 * n + 1) what a step of each rise costs, relative to the cheapest; its least value is 1
    scale    (straight, diagonal) float32; entries of `factors` per metre of difference in height, from the middle
    weight   here what the cheapest straight step into a cell costs, s

Where a step's cost depends on both its ends, a cell's first touch is not its last, and the floods of `flood` do not
hold. Here a cell waits in one bucket, by its cost, and moves to an earlier one when it gets cheaper.
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.compile import njit
from planner_service.kernels.layout import INF, NONE, RULE_FOUR, RULE_OCTILE, SQRT2

_NOBODY = np.int32(-1)
_OUT = np.int32(-2)
"""Of a cell that waits in no bucket."""


@njit
def flood_directed(weight, height, factors, scale, cost, parent, stride, root, rule, corners, width, ring):
    """The tree of cheapest ways to the root. `cost` and `parent` are written whole; returns the largest cost.

    width  of a bucket, s. The tree is exact whatever it is; up to the smallest weight no cell is taken twice
    ring   buckets in the circular queue, a power of two; ring * width exceeds the dearest step by two widths

    Costs end as a fixed point of float32 arithmetic: each is its parent's plus the step, rounded, and the least of
    what its neighbours offer. So no ring of parents can be: its cells would all have one cost, and each would have
    got it, for the last time, after its parent did.
    """
    offsets = np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))
    # Of each waiting cell, who waits before and after it: side by side, as they are read together.
    links = np.empty((weight.size, 2), np.int32)
    for i in range(weight.size):
        cost[i] = INF
        parent[i] = NONE
        links[i, 0] = _OUT
    first = np.full(ring, _NOBODY, np.int32)
    mask = ring - 1
    inverse = 1.0 / np.float64(width)
    half = np.float32(factors.size // 2)
    every = 2 if rule == RULE_FOUR else 1
    cost[root] = np.float32(0.0)
    first[0] = root
    links[root, 0] = _NOBODY
    links[root, 1] = _NOBODY
    waiting = 1
    current = 0
    reach = np.float32(0.0)
    while waiting > 0:
        b = current & mask
        u = np.int64(first[b])
        if u == _NOBODY:
            current += 1
            continue
        first[b] = links[u, 1]
        if links[u, 1] != _NOBODY:
            links[links[u, 1], 0] = _NOBODY
        links[u, 0] = _OUT
        waiting -= 1
        base = cost[u]
        reach = max(reach, base)
        for k in range(0, 8, every):
            v = u + offsets[k]
            w = weight[v]
            old = cost[v]
            # No step costs less than the weight of the cell that it enters, which is u.
            if not w < INF or old <= base + weight[u]:
                continue
            odd = k & 1
            if odd and not corners and not max(weight[u + offsets[k - 1]], weight[u + offsets[(k + 1) & 7]]) < INF:
                continue
            at = (height[u] - height[v]) * scale[odd]
            factor = (
                factors[np.int64(min(max(at, -half), half) + half + np.float32(0.5))]
                if at == at
                else (factors[np.int64(half)])
            )
            step = weight[u] * factor
            new = base + (step * SQRT2 if odd and rule == RULE_OCTILE else step)
            if not new < old:
                continue
            cost[v] = new
            parent[v] = (k + 4) & 7
            c = max(np.int64(np.float64(new) * inverse), current) & mask
            if links[v, 0] != _OUT:
                d = max(np.int64(np.float64(old) * inverse), current) & mask
                if c == d:
                    continue
                ahead, behind = links[v, 0], links[v, 1]
                if ahead == _NOBODY:
                    first[d] = behind
                else:
                    links[ahead, 1] = behind
                if behind != _NOBODY:
                    links[behind, 0] = ahead
                waiting -= 1
            head = first[c]
            links[v, 1] = head
            links[v, 0] = _NOBODY
            if head != _NOBODY:
                links[head, 0] = v
            first[c] = v
            waiting += 1
    return reach
