"""The coarse strategies' skeleton: the cells that carry the traffic, and how all others reach them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.ground import Ground
from planner_service.growth import flood
from planner_service.kernels import coarse, repair
from planner_service.kernels.flood import point_to_parents
from planner_service.kernels.rules import NONE
from shared_map.arrays import Floats


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The cells that carry the traffic, connected, and how all others reach them. Padded arrays.

    cells   uint8    1 on the skeleton
    attach  float32  s; what the way to the skeleton costs; inf where there is none
    parent  uint8    direction of that way; 255 on the skeleton
    anchor  uint32   the skeleton cell it leads to
    reach   s; no way there costs more
    """

    cells: NDArray[np.uint8]
    attach: Floats
    parent: NDArray[np.uint8]
    anchor: NDArray[np.uint32]
    reach: float


def find_skeleton(ground: Ground, samples: int = 8) -> Skeleton:
    """Let exact trees of cells all over the ground vote: where many ways pass in one of them is skeleton."""
    grid = ground.grid
    rule, corners, stride = ground.rule, ground.corners, ground.stride
    passable = np.flatnonzero(ground.weight < np.inf)
    roots = passable[np.linspace(0, passable.size - 1, samples).astype(np.int64)]
    roots = np.concatenate((passable[passable.size // 2 :][:1], roots))
    cells = np.zeros(ground.size, np.uint8)
    cost = np.empty(ground.size, np.float32)
    parent = np.full(ground.size, NONE, np.uint8)
    least = max(16, max(grid.rows, grid.cols) // 8)
    first = int(roots[0])
    flood(ground.weight, ground.low, ground.high, stride, first, rule, corners, cost, parent)
    connected = [int(root) for root in roots[1:] if cost[root] < np.inf]
    cells[first] = 1
    coarse.mark_traffic(parent, stride, least, cells)
    for root in connected:
        # The way between two roots joins what their trees vote for.
        coarse.mark_way(parent, stride, root, cells)
    for root in connected:
        flood(ground.weight, ground.low, ground.high, stride, root, rule, corners, cost, parent)
        coarse.mark_traffic(parent, stride, least, cells)
    chosen = np.flatnonzero(cells)
    attach = np.full(ground.size, np.inf, np.float32)
    attach[chosen] = 0.0
    before = np.full(chosen.size, np.inf, np.float32)
    repair.lower(ground.weight, attach, stride, rule, corners, chosen, before, *ground.buckets, 4 * ground.size)
    box = (0, 0, grid.rows, grid.cols)
    point_to_parents(ground.weight, attach, stride, rule, corners, first, box, parent)
    parent[chosen] = NONE
    anchor = np.zeros(ground.size, np.uint32)
    coarse.find_anchors(parent, stride, cells, anchor)
    finite = attach[attach < np.inf]
    return Skeleton(cells, attach, parent, anchor, float(finite.max(initial=0.0)))
