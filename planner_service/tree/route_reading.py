"""Reading routes off a tree: many at once, whole or their next steps, each with its certificate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.route_walk import OK
from planner_service.tree.bounds import LowerBounds
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.partitioned_tree import PieceTree
from swarm.wire.routes import RouteBatch


def read_routes(
    tree: CostToGoTree | PieceTree, bounds: LowerBounds, asked: NDArray[np.int64], max_cells: int
) -> RouteBatch:
    """A route from each cell, in order; statuses, no exceptions. 0 for `max_cells` is the whole route."""
    grid = tree.cost_grid
    starts, statuses = asked.copy(), np.empty(asked.size, np.uint8)
    walks = grid.walk(tree.parent, grid.pad(tree.root), starts, max_cells, grid.time_cost, statuses)
    if max_cells:
        tree.tighten(walks.last)
    rests = tree.time_at(walks.last)
    cost_s = walks.driven + rests
    bound_s = bounds.at(tree, starts, None if grid.length_weight_s else cost_s)
    if grid.length_weight_s:
        bound_s[statuses != OK] = 0.0
    return RouteBatch(statuses, asked, walks.directions, walks.ends, cost_s, bound_s, walks.length, rests)
