"""Slow twins: the same answers as the kernels', from the definitions, with scipy or plain Python in float64."""

from __future__ import annotations

import heapq
import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from swarm.grid import STEP_COL, STEP_ROW


def step_length(direction: int, edge: str) -> float:
    """In cells."""
    return math.sqrt(2.0) if direction % 2 and edge == "octile" else 1.0


def steps(
    pace: NDArray[np.float32], neighbours: int = 8, edge: str = "octile", corner_cutting: bool = False
) -> list[tuple[int, int, float]]:
    """Every step (u, v, cost) there is, by the rules."""
    rows, cols = pace.shape
    free = np.isfinite(pace)
    found = []
    for row, col in itertools.product(range(rows), range(cols)):
        if not free[row, col]:
            continue
        for direction in range(0, 8, 2 if neighbours == 4 else 1):
            r, c = row + STEP_ROW[direction], col + STEP_COL[direction]
            if not (0 <= r < rows and 0 <= c < cols) or not free[r, c]:
                continue
            if direction % 2 and not corner_cutting and not (free[row, c] and free[r, col]):
                continue
            cost = float(pace[r, c]) * step_length(direction, edge)
            found.append((row * cols + col, r * cols + c, cost))
    return found


def cost_to_go(
    pace: NDArray[np.float32],
    target: int,
    neighbours: int = 8,
    edge: str = "octile",
    corner_cutting: bool = False,
) -> NDArray[np.float64]:
    """Cheapest cost from every cell to the target on cells of one metre, by scipy on the reversed graph."""
    edges = steps(pace, neighbours, edge, corner_cutting)
    if not edges:
        alone = np.full(pace.size, np.inf)
        alone[target] = 0.0
        return alone.reshape(pace.shape)
    u, v, cost = (np.array(column) for column in zip(*edges, strict=True))
    graph = csr_matrix((cost, (v.astype(int), u.astype(int))), shape=(pace.size, pace.size))
    found: NDArray[np.float64] = dijkstra(graph, indices=target)
    return found.reshape(pace.shape)


def cost_to_go_by_hand(pace: NDArray[np.float32], target: int, **rules: object) -> NDArray[np.float64]:
    """As `cost_to_go`, by twelve lines that can be read, to keep watch over scipy and the graph it is given."""
    into: dict[int, list[tuple[int, float]]] = {}
    for u, v, cost in steps(pace, **rules):  # type: ignore[arg-type]
        into.setdefault(v, []).append((u, cost))
    best = np.full(pace.size, np.inf)
    heap = [(0.0, target)]
    while heap:
        key, v = heapq.heappop(heap)
        if best[v] <= key:
            continue
        best[v] = key
        for u, cost in into.get(v, []):
            if key + cost < best[u]:
                heapq.heappush(heap, (key + cost, u))
    return best.reshape(pace.shape)


def driven(pace: NDArray[np.float32], start: int, directions: bytes, edge: str = "octile") -> float:
    """What a route costs, on cells of one metre."""
    row, col = divmod(start, pace.shape[1])
    total = 0.0
    for direction in directions:
        row, col = row + STEP_ROW[direction], col + STEP_COL[direction]
        total += float(pace[row, col]) * step_length(direction, edge)
    return total


def is_legal(
    pace: NDArray[np.float32],
    start: int,
    directions: bytes,
    neighbours: int = 8,
    corner_cutting: bool = False,
) -> bool:
    """Whether a route enters passable cells only and squeezes past none."""
    rows, cols = pace.shape
    row, col = divmod(start, cols)
    for direction in directions:
        r, c = row + STEP_ROW[direction], col + STEP_COL[direction]
        if not (0 <= r < rows and 0 <= c < cols) or not np.isfinite(pace[r, c]):
            return False
        if direction % 2:
            if neighbours == 4:
                return False
            if not corner_cutting and not (np.isfinite(pace[row, c]) and np.isfinite(pace[r, col])):
                return False
        row, col = r, c
    return True
