"""Cheapest ways to a target, grown the slow and obvious way."""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from swarm.grid import STEP_COL, STEP_ROW


def naive_tree(
    pace: NDArray[np.float32], target: int, resolution_m: float
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Cost-to-go in seconds and direction towards the target of every cell; no diagonal past a lethal corner."""
    rows, cols = pace.shape
    free = np.isfinite(pace).tolist()
    paces = pace.tolist()
    cost = np.full(rows * cols, math.inf)
    parent = np.full(rows * cols, 255, np.uint8)
    if not free[target // cols][target % cols]:
        return cost, parent
    cost[target] = 0.0
    frontier = [(0.0, target)]
    while frontier:
        so_far, cell = heapq.heappop(frontier)
        if so_far > cost[cell]:
            continue
        row, col = divmod(cell, cols)
        for code in range(8):
            # The neighbour from which a step in direction `code` leads here.
            r, c = row - STEP_ROW[code], col - STEP_COL[code]
            if not (0 <= r < rows and 0 <= c < cols and free[r][c]):
                continue
            if code % 2 and not (free[row][c] and free[r][col]):
                continue
            step = (math.sqrt(2.0) if code % 2 else 1.0) * resolution_m * paces[row][col]
            if so_far + step < cost[r * cols + c]:
                cost[r * cols + c] = so_far + step
                parent[r * cols + c] = code
                heapq.heappush(frontier, (so_far + step, r * cols + c))
    return cost, parent
