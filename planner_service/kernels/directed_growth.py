"""Exact growth where a step also costs by what it climbs: a label-correcting search with approximate buckets and
decrease-key (Dial 1969 with buckets wider than a step: B. V. Cherkassky, A. V. Goldberg, T. Radzik, "Shortest paths
algorithms", Mathematical Programming 73, 1996, 129-174).

Where a step's cost depends on both its ends, a cell's first offer is not its least, and the growths of
`bucket_queue` and `wide_buckets` do not hold. Here a cell waits in one bucket, by its cost, and moves to an earlier
one when it gets cheaper.

Arrays, beside those of `layout`:
    cell_cost  here what the cheapest straight step into a cell costs, s
    links      int32  (size, 2)  of each waiting cell, which waits before and which after it in its bucket; _NOBODY
                                 at the ends; links[v, 0] is _OUT where v waits in none
    first      int32  (count,)   first cell of each bucket; _NOBODY if empty
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.climbs import CLIMBS, step_price
from planner_service.kernels.compile import kernel
from planner_service.kernels.layout import BUCKETS, GRID, INF, LABELS, NONE, RULE_FOUR

_NOBODY = np.int32(-1)
_OUT = np.int32(-2)


@kernel(f"({GRID}, {LABELS}, {CLIMBS}, {BUCKETS}, i4[:, ::1], i4[::1])")
def grow_directed(grid, labels, climbs, buckets, links, first):
    """The tree of cheapest ways to a padded, passable root. Costs and parents are written whole; returns the
    largest cost.

    buckets  width: the tree is exact whatever it is; up to the lowest cell cost no cell is taken twice. count: a
             power of two, the circular queue; count * width exceeds the dearest step by two widths

    Costs end as a fixed point of float32 arithmetic: each is its parent's plus the step, rounded, and the least of
    what its neighbours offer. So no cycle of parents can be: its cells would all have one cost, and each would have
    got it, for the last time, after its parent did.
    """
    cell_cost, offsets, _, rule, corners = grid
    cost, parent, root = labels
    width, count = buckets
    for i in range(cell_cost.size):
        cost[i] = INF
        parent[i] = NONE
        links[i, 0] = _OUT
    for i in range(count):
        first[i] = _NOBODY
    mask = count - 1
    inverse = 1.0 / np.float64(width)
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
            old = cost[v]
            # No step costs less than the cell cost of the cell that it enters, which is u.
            if not cell_cost[v] < INF or old <= base + cell_cost[u]:
                continue
            odd = k & 1
            if (
                odd
                and not corners
                and max(cell_cost[u + offsets[k - 1]], cell_cost[u + offsets[(k + 1) & 7]]) == INF
            ):
                continue
            new = base + cell_cost[u] * step_price(climbs, v, u, odd)
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
            # In place: as a call, for whose array arguments references are counted, this took a third more time.
            head = first[c]
            links[v, 1] = head
            links[v, 0] = _NOBODY
            if head != _NOBODY:
                links[head, 0] = v
            first[c] = v
            waiting += 1
    return reach
