"""Reading routes off a tree: many at once, whole or their next steps, each with its certificate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.route_walk import find_starts, price_routes
from planner_service.tree.bounds import LowerBounds
from planner_service.tree.cost_to_go import CostToGoTree
from swarm.wire.routes import RouteBatch


def read_routes(tree: CostToGoTree, bounds: LowerBounds, asked: NDArray[np.int64], max_cells: int) -> RouteBatch:
    """A route from each cell, in order; statuses, no exceptions. 0 for `max_cells` is the whole route."""
    grid = tree.cost_grid
    root = grid.pad(tree.root)
    starts = np.empty(asked.size, np.int64)
    statuses = np.empty(asked.size, np.uint8)
    find_starts(grid.cell_cost, tree.parent, grid.stride, root, asked, starts, statuses)
    walks = grid.walk(tree.parent, root, starts, max_cells, grid.cell_cost)
    if max_cells:
        tree.tighten(walks.last)
    bound = bounds.at(tree, starts)
    prices = np.empty((4, asked.size), np.float64)
    metres = (grid.grid.resolution_m, grid.diagonal, grid.config.length_weight)
    rest = tree.cost_at(walks.last)
    whole = price_routes(metres, walks[1:], rest, statuses, bound, prices)
    if not whole:
        raise AssertionError("a route does not end at the target: the tree is broken")
    if max_cells and grid.config.length_weight:
        # The tree's cost of what is cut off holds a price of its length; only driving it tells the time it takes.
        ends = grid.walk(tree.parent, root, starts, 0, grid.cell_cost)
        of_whole = np.empty_like(prices)
        price_routes(metres, ends[1:], np.zeros_like(rest), statuses, bound, of_whole)
        known = np.isfinite(prices[0])
        given_s = prices[0, known] - prices[3, known]
        prices[0, known] = of_whole[0, known]
        prices[3, known] = np.maximum(of_whole[0, known] - given_s, 0.0)
    return RouteBatch(statuses, asked, walks.directions, walks.ends, *prices)
