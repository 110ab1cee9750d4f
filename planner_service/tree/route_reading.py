"""Reading routes off a tree: many at once, whole or their next steps, each with its certificate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.route_walk import OK, find_starts, price_routes
from planner_service.tree.bounds import LowerBounds
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.pieces import PieceTree
from swarm.wire.routes import RouteBatch


def read_routes(
    tree: CostToGoTree | PieceTree, bounds: LowerBounds, asked: NDArray[np.int64], max_cells: int
) -> RouteBatch:
    """A route from each cell, in order; statuses, no exceptions. 0 for `max_cells` is the whole route."""
    grid = tree.cost_grid
    root = grid.pad(tree.root)
    starts = np.empty(asked.size, np.int64)
    statuses = np.empty(asked.size, np.uint8)
    find_starts(grid.cell_cost, tree.parent, grid.stride, root, asked, starts, statuses)
    walks = grid.walk(tree.parent, root, starts, max_cells, grid.time_cost)
    if max_cells:
        tree.tighten(walks.last)
    prices = np.empty((4, asked.size), np.float64)
    metres = (grid.grid.resolution_m, grid.diagonal)
    if not price_routes(metres, walks[1:], tree.time_at(walks.last), statuses, prices):
        raise AssertionError("a route does not end at the target: the tree is broken")
    if statuses.any():  # some have no way; a single route feels what a mask takes
        found = statuses == OK
        prices[1, found] = bounds.at(tree, starts[found], None if grid.length_weight_s else prices[0, found])
    else:
        prices[1] = bounds.at(tree, starts, None if grid.length_weight_s else prices[0])
    return RouteBatch(statuses, asked, walks.directions, walks.ends, *prices)
