"""The networks of strides 2, 4, 8, ...: components of blocks of cells, and cheapest ways of single steps between
them.

At stride s the map is cut into blocks of s x s cells. A *node* is a connected component of a block: passable cells
that legal steps inside the block join, so that a wall through a block makes two nodes of it. Each has a centre, one
of its cells. A *link* joins two nodes where a legal step leads from one to the other, and has the cheapest path
between their centres through that step and otherwise inside the two. Cut so, no wall is jumped, and whatever single
steps connect is connected at every stride: `docs/method/certificates.md` has the proof.

Arrays, beside those of `layout`:
    node    int32  (size,)   which node of a stride each cell belongs to; -1 where it is lethal
    centre  uint32 (nodes,)  a padded cell of each
    depth   int32  (size,)   steps from a cell to its node's centre
    parent  uint8  (size,)   direction of the next cell to there; NONE at the centre
    paths   uint8            directions from one centre to another, link after link
"""

from __future__ import annotations

import numpy as np

from planner_service.kernels.decorators import helper, kernel
from planner_service.kernels.layout import GRID, INF, NONE, RULE_FOUR, step_length
from planner_service.kernels.queue_heap import heap_lower, heap_pop

OPEN = np.int32(-2)
"""`node` of a cell that belongs to one which has no number yet."""
_OFF_CENTRE = np.float32(1.0)
"""For the choice of a centre: share by which a cell at a block's border counts as more expensive than its
middle."""


@helper
def _leads(cell_cost, offsets, corners, u, k):
    """Returns True if a step may be taken from a passable cell: not into a lethal one, nor past one, unless
    allowed."""
    if not cell_cost[u + offsets[k]] < INF:
        return False
    if not k & 1 or corners:
        return True
    return max(cell_cost[u + offsets[k - 1]], cell_cost[u + offsets[(k + 1) & 7]]) < INF


@kernel(f"({GRID}, i8, i4[::1], u4[::1], u4[::1])")
def cut_blocks(grid, side, node, centre, queue):
    """Finds the nodes of blocks of `side` x `side` cells, and their centres: cells that are cheap, and near the
    middle of their block.

    node    which cells there are: OPEN, or -1; written
    centre  written, with room for all cells
    queue   with room for the cells of a block
    Returns how many nodes there are.
    """
    stride = grid[2]
    rows = node.size // stride
    count = 0
    for row0 in range(1, rows - 1, side):
        row1 = min(row0 + side, rows - 1)
        for col0 in range(1, stride - 1, side):
            col1 = min(col0 + side, stride - 1)
            for row in range(row0, row1):
                for col in range(col0, col1):
                    v = row * stride + col
                    if node[v] == OPEN:
                        box = row0, col0, row1, col1
                        centre[count] = _flood(grid, side, box, node, count, v, queue)
                        count += 1
    return count


@helper
def _flood(grid, side, box, node, count, first, queue):
    """Gives a component its number. Returns its centre."""
    cell_cost, offsets, stride, rule, corners = grid
    row0, col0, row1, col1 = box
    node[first] = count
    queue[0] = first
    found = 1
    best = INF
    centre = np.int64(first)
    i = 0
    while i < found:
        u = np.int64(queue[i])
        i += 1
        row = u // stride
        col = u - row * stride
        off = max(abs(2 * (row - row0) + 1 - side), abs(2 * (col - col0) + 1 - side))
        key = cell_cost[u] * (np.float32(1.0) + _OFF_CENTRE * np.float32(off) / np.float32(side))
        if key < best:
            best = key
            centre = u
        for k in range(0, 8, 2 if rule == RULE_FOUR else 1):
            v = u + offsets[k]
            if node[v] != OPEN or not _leads(cell_cost, offsets, corners, u, k):
                continue
            if row0 <= v // stride < row1 and col0 <= v % stride < col1:
                node[v] = count
                queue[found] = v
                found += 1
    return centre


@kernel(f"({GRID}, i4[::1], u4[::1], f4[::1], u1[::1], i4[::1], Tuple((f4[::1], i8[::1], i4[::1])))")
def find_ways_to_centres(grid, node, centre, cost, parent, depth, heap):
    """Grows a tree from each centre over the cells of its node (Dijkstra's algorithm with a binary heap). Writes
    cost, parent and depth of all cells that belong to a node.

    heap  keys, items, place: the first two with room for the cells of a block, the last for all
    """
    cell_cost, offsets, _, rule, corners = grid
    keys, items, place = heap
    for v in range(cost.size):
        cost[v] = INF
        place[v] = -1
    for n in range(centre.size):
        root = np.int64(centre[n])
        cost[root] = np.float32(0.0)
        parent[root] = NONE
        depth[root] = 0
        size = heap_lower(keys, items, place, np.int64(0), np.float32(0.0), root)
        while size > 0:
            u = items[0]
            heap_pop(keys, items, place, size)
            size -= 1
            for k in range(0, 8, 2 if rule == RULE_FOUR else 1):
                v = u + offsets[k]
                if node[v] != n:
                    continue
                offer = cost[u] + cell_cost[u] * step_length(rule, k & 1)
                if offer < cost[v] and _leads(cell_cost, offsets, corners, u, k):
                    cost[v] = offer
                    parent[v] = (k + 4) & 7
                    depth[v] = depth[u] + 1
                    size = heap_lower(keys, items, place, size, offer, v)


@kernel(f"({GRID}, i4[::1], f4[::1], i8, i8[::1], f4[::1], i8[::1])")
def join_nodes(grid, node, cost, nodes, pairs, prices, steps):
    """Finds all links, each with its cheapest step.

    pairs   int64, a power of two, 0: a hash table; written: lower node * `nodes` + higher node + 1
    prices  float32, s, of the same size; written: of the way through the step
    steps   int64, of the same size; written: 8 * padded cell + direction
    Returns how many links there are, or -1 where they fill more than half of the table: a larger one is to be
    handed in.
    """
    cell_cost, offsets, _, rule, corners = grid
    mask = pairs.size - 1
    found = 0
    for u in range(node.size):
        if node[u] < 0:
            continue
        for k in range(2, 6, 2 if rule == RULE_FOUR else 1):  # east to south-west: each pair of cells once
            v = u + offsets[k]
            if node[v] == node[u] or node[v] < 0 or not _leads(cell_cost, offsets, corners, u, k):
                continue
            pair = np.int64(min(node[u], node[v])) * nodes + max(node[u], node[v]) + 1
            at = (pair * 0x9E3779B97F4A7C1 >> 20) & mask
            while pairs[at] != 0 and pairs[at] != pair:
                at = (at + 1) & mask
            price = cost[u] + cost[v] + cell_cost[u] * step_length(rule, k & 1) + cell_cost[v]
            if pairs[at] == 0:
                pairs[at] = pair
                prices[at] = INF
                found += 1
                if 2 * found > pairs.size:
                    return -1
            if price < prices[at]:
                prices[at] = price
                steps[at] = 8 * u + k
    return found


@kernel("(i8[::1], u1[::1], i4[::1], i8[::1], i8[::1], u1[::1], u4[::1], i4[::1])")
def write_paths(offsets, parent, depth, steps, begins, paths, centre, node):
    """Writes the ways of links, from the centre of the node that the step leaves to that of the other.

    steps   int64, as `join_nodes` writes them; less than 0: ~padded cell, where the way ends
    begins  int64, where each begins in `paths`
    node    written: OPEN on all ways and centres, -1 elsewhere, which is what the next stride is cut from
    """
    for v in range(node.size):
        node[v] = -1
    for n in range(centre.size):
        node[centre[n]] = OPEN
    for i in range(steps.size):
        u = ~steps[i] if steps[i] < 0 else steps[i] >> 3
        at = begins[i] + depth[u]
        v = u
        for j in range(depth[u]):
            node[v] = OPEN
            k = parent[v]
            paths[at - 1 - j] = (k + 4) & 7
            v += offsets[k]
        if steps[i] < 0:
            continue
        paths[at] = steps[i] & 7
        v = u + offsets[steps[i] & 7]
        while parent[v] != NONE:
            node[v] = OPEN
            at += 1
            paths[at] = parent[v]
            v += offsets[parent[v]]
