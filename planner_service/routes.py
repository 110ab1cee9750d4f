"""Reading routes off a tree: many at once, whole or their next steps, each with its certificate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.bounds import LowerBounds
from planner_service.tree import CostToGoTree
from swarm.messages import Route, RouteStatus


def read_routes(tree: CostToGoTree, bounds: LowerBounds, asked: NDArray[np.int64], max_cells: int) -> list[Route]:
    """A route from each cell, in order; statuses, no exceptions. 0 for `max_cells` is the whole route."""
    ground, grid = tree.ground, tree.ground.grid
    inside = (asked >= 0) & (asked < grid.cells)
    starts = ground.pad_all(np.where(inside, asked, 0))
    lethal = inside & ~(ground.weight[starts] < np.inf)
    ok = inside & (tree.cost[starts] < np.inf)
    directions, ends, driven, diagonals, last = ground.walk(
        tree.parent, ground.pad(tree.root), starts[ok], max_cells, ground.weight
    )
    if (ends < 0).any():
        raise AssertionError("a route does not end at the target: the tree is broken")
    begins = np.concatenate(([0], ends))[:-1]
    steps = ends - begins
    lengths = (steps + diagonals * (ground.diagonal - 1.0)) * grid.resolution_m
    remaining = np.maximum(tree.cost[last] + tree.offset, 0.0).astype(np.float64)
    remaining[last == ground.pad(tree.root)] = 0.0
    costs = driven - lengths * ground.config.length_weight + remaining
    proven = np.minimum(bounds.at(tree, starts[ok]), costs)
    packed = directions.tobytes()
    routes: list[Route] = []
    n = 0
    for i, cell in enumerate(asked.tolist()):
        if ok[i]:
            routes.append(
                Route(
                    status=RouteStatus.OK,
                    start=cell,
                    directions=packed[begins[n] : ends[n]],
                    cost_s=float(costs[n]),
                    lower_bound_s=float(proven[n]),
                    length_m=float(lengths[n]),
                    remaining_s=float(remaining[n]),
                )
            )
            n += 1
            continue
        status = RouteStatus.UNREACHABLE
        if not inside[i]:
            status = RouteStatus.OUTSIDE
        elif lethal[i]:
            status = RouteStatus.LETHAL_START
        routes.append(Route(status=status, start=cell))
    return routes
