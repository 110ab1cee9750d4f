"""The networks of strides 2, 4, 8, ...: components of blocks of cells, cheapest ways of single steps between them,
and new costs spreading over them, ever wider ones the further from the root.

At stride s the map is cut into blocks of s x s cells. A *node* is a connected component of a block: passable cells
that legal steps inside the block join, so that a wall through a block makes two nodes of it. Each has a centre, one
of its cells. A *link* joins two nodes where a legal step leads from one to the other, and has the cheapest path
between their centres through that step and otherwise inside the two. Cut so, no wall is jumped, and whatever single
steps connect is connected at every stride: `docs/method/certificates.md` has the proof.

`grow_strides` is Dijkstra's algorithm (E. W. Dijkstra 1959) with a binary heap over the nodes:
what a link costs was found with the network and says only in which order nodes are taken and by which link each is
reached. The costs of cells are read from the current map, step by step along that link.

Arrays, beside those of `layout`:
    node    int32  (size,)   which node of a stride each cell belongs to; -1 where it is lethal
    centre  uint32 (nodes,)  a padded cell of each
    depth   int32  (size,)   steps from a cell to its node's centre
    parent  uint8  (size,)   direction of the next cell to there; NONE at the centre
    paths   uint8            directions from one centre to another, link after link
    stamp   uint8  (size,)   whether a cost has been recomputed: `now` if it has, less if not
    trail   uint32 (size,)   the cells of a way
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import CLIMBS, offered
from planner_service.kernels.decorators import helper, kernel, step_kernel
from planner_service.kernels.heap_and_buckets import heap_lower, heap_pop
from planner_service.kernels.layout import (
    BOX,
    GRID,
    INF,
    LABELS,
    NONE,
    RULE_FOUR,
    Bytes,
    Floats,
    Ints,
    Longs,
    check_cells,
    is_shut,
    step_length,
)

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
    return not k & 1 or corners or not is_shut(cell_cost, offsets, u, k)


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


@kernel("(i8[::1], u1[::1], i4[::1], i8[::1], i8[::1], u1[::1], u4[::1], i4[::1])")
def write_paths(offsets, parent, depth, steps, begins, paths, centre, node):
    """Writes the ways of links, from the centre of the node that the step leaves to that of the other.

    steps   int64, of each link 8 * padded cell + direction; less than 0: ~padded cell, where the way ends
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


class StrideNetwork(NamedTuple):
    """The nodes of all strides, their links, and the way of each: what a growth of far cells goes along.

    Advice, not knowledge: whatever it says, costs and passability are read from the map as it is now. Marks
    therefore never make it wrong, only less good. Kernels take it as a plain tuple.

    centre     uint32 (nodes,), a padded cell of each
    doublings  uint8 (nodes,), ascending: its stride is two to the power of this
    first      int32 (nodes + 1,), where each node's links begin in the arrays that follow
    other      int32, the node that a link leads to
    price      float32, s, what its way cost when it was found
    begin      uint32, where its way begins in `paths`
    steps      int32, how many steps that has; where it is `paths` backward, from `begin` down, less than 0: ~steps
    paths      uint8, directions
    """

    centre: NDArray[np.uint32]
    doublings: Bytes
    first: Ints
    other: Ints
    price: Floats
    begin: NDArray[np.uint32]
    steps: Ints
    paths: Bytes


NETWORK = "Tuple((u4[::1], u1[::1], i4[::1], i4[::1], f4[::1], u4[::1], i4[::1], u1[::1]))"

Scratch = tuple[Floats, Longs, Ints, Floats, Ints, Ints, NDArray[np.uint32]]
"""Arrays of a heap: keys, items, places; of each node: the lowest key up to now, -inf once it is settled or where
it takes no part; its link, and the node from which that leads; a trail."""


def make_scratch(nodes: int, cells: int) -> Scratch:
    """Makes the scratch for these numbers of nodes and padded cells."""
    return (
        np.empty(nodes, np.float32),
        np.empty(nodes, np.int64),
        np.empty(nodes, np.int32),
        np.empty(nodes, np.float32),
        np.empty(nodes, np.int32),
        np.empty(nodes, np.int32),
        np.empty(cells, np.uint32),
    )


@helper
def _tighten(cell_cost, climbs, cost, parent, stamp, now, offsets, rule, v, trail):
    """Like `tighten`, for one padded cell. Returns cells visited."""
    many = 0
    while stamp[v] < now and parent[v] != NONE:
        trail[many] = v
        many += 1
        v += offsets[parent[v]]
    if stamp[v] < now:  # no way leads from here
        return 0
    for j in range(many - 1, -1, -1):
        v = np.int64(trail[j])
        k = parent[v]
        u = v + offsets[k]
        driven = offered(cost[u], cell_cost[u], climbs, v, u, k, step_length(rule, k & 1))
        cost[v] = min(cost[v], driven)
        stamp[v] = now
    return many


@step_kernel(f"({GRID}, CLIMBS, {LABELS}, u1[::1], i8, i8[::1], u4[::1])", CLIMBS)
def tighten(grid, climbs, labels, stamp, now, cells, trail):
    """Lowers costs, which are upper bounds, to those driven along the parents, less the tree's offset: of `cells`
    (int64, padded) and of all on their paths to the root.

    They stay at least what the parent offers. Cells whose stamp is `now` are taken to be right, and those that
    become so are stamped. Returns cells visited. Raises ValueError where one is no padded cell.
    """
    check_cells(cells, stamp.size)
    cell_cost, offsets, _, rule, _ = grid
    cost, parent, root = labels
    visited = 0
    stamp[root] = now
    for i in range(cells.size):
        visited += _tighten(cell_cost, climbs, cost, parent, stamp, now, offsets, rule, cells[i], trail)
    return visited


@step_kernel(
    f"({GRID}, CLIMBS, {LABELS}, {NETWORK}, Tuple((u1[::1], i8)), {BOX}, UniTuple(i8, 2),"
    " Tuple((f4[::1], i8[::1], i4[::1], f4[::1], i4[::1], i4[::1], u4[::1])))",
    CLIMBS,
)
def grow_strides(grid, climbs, labels, network, stamps, box, reach, scratch):
    """Spreads the costs of a window around the root outward over the networks of strides.

    stamps  (stamp, now)
    box     the window, whose costs are new
    reach   cells: the least stride is for distances from the root up to the first, the next one for up to twice
            that, and so on; none for more than the second

    Along each link a cell is tightened, then offered what the one before it offers. Only what gets cheaper is
    rewritten, with its parent, so that costs stay upper bounds and grow strictly along every way. If a step has
    become impossible the cells beyond keep their own paths, and it goes on from there. Returns cells visited.
    """
    cost, _, root = labels
    centre, _, first, other, price, _, _, _ = network
    keys, items, place, lowest, by, source, _ = scratch
    stamps[0][root] = stamps[1]
    size = _seed(cost, network, grid[2], root, box, reach, scratch)
    visited = 0
    while size > 0:
        n = items[0]
        heap_pop(keys, items, place, size)
        size -= 1
        lowest[n] = -INF
        if by[n] >= 0:
            begins = np.int64(centre[source[n]])
            visited += _follow(grid, climbs, labels, network, stamps, by[n], begins, scratch[6])
        base = cost[centre[n]]
        for i in range(first[n], first[n + 1]):
            key = base + price[i]
            if key < lowest[other[i]]:
                lowest[other[i]] = key
                by[other[i]] = i
                source[other[i]] = n
                size = heap_lower(keys, items, place, size, key, np.int64(other[i]))
    return visited


@helper
def _seed(cost, network, stride, root, box, reach, scratch):
    """Begins the heap with the nodes of the least stride inside the window, and shut out those of the wrong stride.

    A node takes part where its stride is the one for its distance, or a block nearer or further: the centre of any
    cell's node is less than a block away. Returns how many are in the heap.
    """
    centre, doublings = network[0], network[1]
    keys, items, place, lowest, by, _, _ = scratch
    row0, col0, row1, col1 = box
    root_row, root_col = root // stride, root % stride
    size = np.int64(0)
    for n in range(centre.size):
        v = np.int64(centre[n])
        row = v // stride
        col = v - row * stride
        away = max(abs(row - root_row), abs(col - root_col))
        block = np.int64(1) << np.int64(doublings[n])
        far = reach[0] << np.int64(doublings[n] - doublings[0])
        begins = doublings[n] == doublings[0] or away + block >= far >> 1
        ends = doublings[n] == doublings[centre.size - 1] or away - block <= far
        place[n] = -1
        by[n] = -1
        lowest[n] = INF if begins and ends and away - block <= reach[1] else -INF
        inside = row0 < row <= row1 and col0 < col <= col1  # rows and columns are padded ones
        if inside and doublings[n] == doublings[0] and cost[v] < lowest[n]:
            lowest[n] = cost[v]
            size = heap_lower(keys, items, place, size, cost[v], n)
    return size


@helper
def _follow(grid, climbs, labels, network, stamps, link, u, trail):
    """Offer costs along the way of a link, from a cell on. Returns cells visited."""
    cell_cost, offsets, _, rule, corners = grid
    cost, parent, _ = labels
    stamp, now = stamps
    begin, steps, paths = np.int64(network[5][link]), network[6][link], network[7]
    many = np.int64(max(steps, ~steps))
    visited = many
    for j in range(many):
        k = np.int64(paths[begin + j] if steps >= 0 else (paths[begin - j] + 4) & 7)
        v = u + offsets[k]
        if stamp[v] < now:
            visited += _tighten(cell_cost, climbs, cost, parent, stamp, now, offsets, rule, v, trail)
        offer = offered(cost[u], cell_cost[u], climbs, v, u, k ^ 4, step_length(rule, k & 1))
        if offer < cost[v] and _leads(cell_cost, offsets, corners, u, k):
            cost[v] = offer
            parent[v] = (k + 4) & 7
            stamp[v] = now
        u = v
    return visited
