"""Networks of strides on which far cells are planned (section 3.3.3), and how they are found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import stride_networks
from planner_service.kernels.layout import RULE_FOUR, RULE_OCTILE, SQRT2
from planner_service.kernels.stride_networks import StrideNetwork
from planner_service.tree.cost_changes import Cells
from planner_service.tree.cost_grid import CostGrid
from shared_map.array_files import Bytes, Floats

LEAST = 4
"""Doublings of the least stride that has a network: 16 cells. Shorter strides are single steps, near the target: a
network as dense as they would need holds about as many cells as there are."""
FINE = 8
"""Strides below the least one serve this multiple of the narrowest window: there all cells are searched."""
MOST_SHARE = 8
"""The largest stride is at most such a share of the map's side (docs/design/windows-and-strides.md)."""


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Links of one stride.

    ends    int64 (links,) each, nodes: where each way begins and ends
    price   float32 (links,), s
    length  int64 (links,), steps of each way
    paths   uint8, directions, way after way
    """

    ends: tuple[Cells, Cells]
    price: Floats
    length: Cells
    paths: Bytes


def all_cells(cost_grid: CostGrid) -> NDArray[np.int32]:
    """Returns `node` for `find_stride` where there is no stride before: all passable cells."""
    return np.where(cost_grid.cell_cost < np.inf, stride_networks.OPEN, np.int32(-1))


def find_strides(grid: CostGrid) -> StrideNetwork:
    """Finds the network of a map: the least stride first, each from the ways of the one before."""
    node = all_cells(grid)
    centres: list[NDArray[np.uint32]] = []
    links: list[Links] = []
    side = max(grid.grid.rows, grid.grid.cols)
    most = max(LEAST, (side // MOST_SHARE).bit_length() - 1)
    for doublings in range(LEAST, most + 1):
        below = centres[-1].astype(np.int64) if centres else np.empty(0, np.int64)
        centre, found = find_stride(grid, 1 << doublings, node, below, sum(map(len, centres)))
        centres.append(centre)
        links.append(found)
    return _joined(centres, links)


def find_stride(
    grid: CostGrid, stride: int, node: NDArray[np.int32], below: Cells, before: int
) -> tuple[NDArray[np.uint32], Links]:
    """The centres of one stride's nodes, and all links among them and to those of the stride before.

    node    the cells on ways of the stride before, as `cut_blocks` takes them; written: those of this one
    below   centres of the stride before, the last of `before` nodes
    """
    padded, offsets, size = grid.padded, grid.padded[1], grid.size
    room = min(stride, grid.grid.rows) * min(stride, grid.grid.cols)
    most = np.empty(size, np.uint32)
    many = stride_networks.cut_blocks(padded, stride, node, most, np.empty(room, np.uint32))
    centre = most[:many].copy()
    del most
    cost, parent = np.empty(size, np.float32), np.empty(size, np.uint8)
    depth, place = np.empty(size, np.int32), np.empty(size, np.int32)
    heap = np.empty(room, np.float32), np.empty(room, np.int64)
    stride_networks.find_ways_to_centres(padded, node, centre, cost, parent, depth, (*heap, place))
    del place, heap
    steps, price = _joining_steps(grid, node, cost, many)
    u, v = steps >> 3, (steps >> 3) + offsets[steps & 7]
    # The centres of the stride before lie on its ways, so that each is in a node of this one.
    ends = (
        np.concatenate((node[u], node[below])) + before,
        np.concatenate((node[v] + before, np.arange(before - below.size, before))),
    )
    price = np.concatenate((price, cost[below]))
    length = np.concatenate((depth[u] + depth[v] + 1, depth[below])).astype(np.int64)
    paths = np.empty(int(length.sum()), np.uint8)
    steps = np.concatenate((steps, ~below))
    stride_networks.write_paths(offsets, parent, depth, steps, np.cumsum(length) - length, paths, centre, node)
    return centre, Links(ends, price, length, paths)


def _joining_steps(grid: CostGrid, node: NDArray[np.int32], cost: Floats, many: int) -> tuple[Cells, Floats]:
    """The cheapest step of each link, 8 * padded cell + direction, and the price of its way, s; in the order of the
    map."""
    cell_cost, offsets, _, rule, corners = grid.padded
    steps: list[Cells] = []
    pairs: list[Cells] = []
    prices: list[Floats] = []
    for way in range(2, 6, 2 if rule == RULE_FOUR else 1):  # east to south-west: each pair of cells once
        ahead = int(offsets[way])
        one, other = node[:-ahead], node[ahead:]
        u = np.flatnonzero((one != other) & (one >= 0) & (other >= 0))
        if way & 1 and not corners:
            beside = np.maximum(cell_cost[u + offsets[way - 1]], cell_cost[u + offsets[way + 1]])
            u = u[beside < np.inf]
        v = u + ahead
        length = SQRT2 if way & 1 and rule == RULE_OCTILE else np.float32(1.0)
        steps.append(8 * u + way)
        pairs.append(np.minimum(node[u], node[v]) * np.int64(many) + np.maximum(node[u], node[v]))
        prices.append(cost[u] + cost[v] + cell_cost[u] * length + cell_cost[v])
    step, pair, price = np.concatenate(steps), np.concatenate(pairs), np.concatenate(prices)
    order = np.lexsort((step, price, pair))
    best = order[np.unique(pair[order], return_index=True)[1]]
    best = best[np.argsort(step[best])]
    return step[best], price[best]


def _joined(centres: list[NDArray[np.uint32]], links: list[Links]) -> StrideNetwork:
    """Every link from both of its ends, by the node that it begins at."""
    centre = np.concatenate(centres)
    doublings = np.repeat(np.arange(LEAST, LEAST + len(centres)), [len(part) for part in centres]).astype(np.uint8)
    from_, to = (np.concatenate([part.ends[n] for part in links]) for n in range(2))
    length = np.concatenate([part.length for part in links])
    begin = np.cumsum(length) - length
    price = np.concatenate([part.price for part in links])
    source = np.concatenate((from_, to))
    order = np.argsort(source, kind="stable")
    first = np.zeros(centre.size + 1, np.int32)
    np.cumsum(np.bincount(source, minlength=centre.size), out=first[1:])
    # A way without a step, where a node and the one above have the same centre, is never followed backward.
    backward = np.where(length > 0, begin + length - 1, 0)
    return StrideNetwork(
        centre,
        doublings,
        first,
        np.concatenate((to, from_))[order].astype(np.int32),
        np.concatenate((price, price))[order],
        np.concatenate((begin, backward))[order].astype(np.uint32),
        np.concatenate((length, ~length))[order].astype(np.int32),
        np.concatenate([part.paths for part in links]),
    )
