"""Slow twins: the same answers as the kernels', from the definitions, with scipy or plain Python in float64."""

from __future__ import annotations

import functools
import heapq
import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from planner_service.tree.cost_to_go import NO_WINDOW, CostToGoTree
from shared_map.terrain.step_climb import Climb
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


def graph_into(
    pace: NDArray[np.float32],
    neighbours: int = 8,
    edge: str = "octile",
    corner_cutting: bool = False,
    climb: Climb | None = None,
) -> csr_matrix:
    """The graph of all steps with every edge turned round, so that a search from the target finds the ways to
    it."""
    rows, cols = pace.shape
    cells = np.arange(pace.size).reshape(rows, cols)
    free = np.isfinite(pace)
    into, out, costs = [], [], []
    for direction in range(0, 8, 2 if neighbours == 4 else 1):
        dr, dc = STEP_ROW[direction], STEP_COL[direction]
        here = np.s_[max(0, -dr) : rows - max(0, dr), max(0, -dc) : cols - max(0, dc)]
        there = np.s_[max(0, dr) : rows + min(0, dr), max(0, dc) : cols + min(0, dc)]
        legal = free[here] & free[there]
        if direction % 2 and not corner_cutting:
            legal &= free[here[0], there[1]] & free[there[0], here[1]]
        out.append(cells[here][legal])
        into.append(cells[there][legal])
        costs.append(pace[there][legal].astype(np.float64) * step_length(direction, edge))
        if climb is not None:
            costs[-1] *= climb.along(out[-1], into[-1])
            allowed = np.isfinite(costs[-1])
            out[-1], into[-1], costs[-1] = out[-1][allowed], into[-1][allowed], costs[-1][allowed]
    shape = (pace.size, pace.size)
    return csr_matrix((np.concatenate(costs), (np.concatenate(into), np.concatenate(out))), shape=shape)


@functools.lru_cache(maxsize=4)
def factors_of(climb: Climb) -> list[list[float]]:
    """Of each direction and cell: the factor of the step; 1 where it would leave the grid."""
    rows, cols = climb.grid.rows, climb.grid.cols
    row, col = np.divmod(np.arange(rows * cols), cols)
    found = []
    for direction in range(8):
        r = np.clip(row + STEP_ROW[direction], 0, rows - 1)
        c = np.clip(col + STEP_COL[direction], 0, cols - 1)
        inside = (abs(r - row) == abs(STEP_ROW[direction])) & (abs(c - col) == abs(STEP_COL[direction]))
        factors = climb.along(row * cols + col, np.where(inside, r * cols + c, row * cols + col))
        found.append(np.where(inside, factors, 1.0).tolist())
    return found


def cost_to_go(
    pace: NDArray[np.float32],
    target: int,
    neighbours: int = 8,
    edge: str = "octile",
    corner_cutting: bool = False,
    climb: Climb | None = None,
) -> NDArray[np.float64]:
    """Cheapest cost from every cell to the target on cells of one metre, by scipy on the reversed graph."""
    graph = graph_into(pace, neighbours, edge, corner_cutting, climb)
    found: NDArray[np.float64] = dijkstra(graph, indices=target)
    return found.reshape(pace.shape)


def directed_cost_to_go_in_float32(
    cell_cost: NDArray[np.float32],
    target: int,
    climb: Climb,
    neighbours: int = 8,
    edge: str = "octile",
    corner_cutting: bool = False,
) -> NDArray[np.float32]:
    """What directed trees are to cost, to the last bit, by a heap: each sum and each product rounded as theirs.

    Float32 sums grow with what is added to, so that the order in which cells are served makes no difference.

    cell_cost  float32 (rows, cols), s; of the cheapest straight step into each cell
    """
    rows, cols = cell_cost.shape
    cells = np.arange(cell_cost.size).reshape(rows, cols)
    free = np.isfinite(cell_cost)
    into: list[list[tuple[int, np.float32]]] = [[] for _ in range(cell_cost.size)]
    for direction in range(0, 8, 2 if neighbours == 4 else 1):
        dr, dc = STEP_ROW[direction], STEP_COL[direction]
        here = np.s_[max(0, -dr) : rows - max(0, dr), max(0, -dc) : cols - max(0, dc)]
        there = np.s_[max(0, dr) : rows + min(0, dr), max(0, dc) : cols + min(0, dc)]
        legal = free[here] & free[there]
        if direction % 2 and not corner_cutting:
            legal &= free[here[0], there[1]] & free[there[0], here[1]]
        out, to = cells[here][legal], cells[there][legal]
        prices = climb.along(out, to) / np.float32(climb.lowest)
        prices *= np.float32(step_length(direction, edge))
        costs = cell_cost.reshape(-1)[to] * prices
        for v, u, cost in zip(out.tolist(), to.tolist(), costs, strict=True):
            if cost < np.inf:
                into[u].append((v, cost))
    best: NDArray[np.float32] = np.full(cell_cost.size, np.inf, np.float32)
    best[target] = 0
    heap = [(np.float32(0), target)]
    while heap:
        key, u = heapq.heappop(heap)
        if best[u] < key:
            continue
        for v, cost in into[u]:
            if key + cost < best[v]:
                best[v] = key + cost
                heapq.heappush(heap, (best[v], v))
    return best.reshape(rows, cols)


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


def way_down(pace: NDArray[np.float32], cost: NDArray[np.float64], start: int, most: int = 0) -> bytes:
    """Directions of a cheapest route by the default rules to where cost is 0; `most` of them, if given."""
    rows, cols = pace.shape
    row, col = divmod(start, cols)
    directions = bytearray()
    while cost[row, col] > 0 and (not most or len(directions) < most):
        best = (math.inf, 0, row, col)
        for direction in range(8):
            r, c = row + STEP_ROW[direction], col + STEP_COL[direction]
            if not (0 <= r < rows and 0 <= c < cols) or math.inf in (pace[row, c], pace[r, col], pace[r, c]):
                continue
            best = min(best, (cost[r, c] + float(pace[r, c]) * step_length(direction, "octile"), direction, r, c))
        _, direction, row, col = best
        directions.append(direction)
    return bytes(directions)


def follow(
    pace: NDArray[np.float32],
    start: int,
    directions: bytes,
    neighbours: int = 8,
    edge: str = "octile",
    corner_cutting: bool = False,
    climb: Climb | None = None,
) -> tuple[int, float] | None:
    """(last cell, cost) of a route on cells of one metre; None if it breaks a rule on the way."""
    rows, cols = pace.shape
    row, col = divmod(start, cols)
    total = 0.0
    for direction in directions:
        r, c = row + STEP_ROW[direction], col + STEP_COL[direction]
        if not (0 <= r < rows and 0 <= c < cols) or pace[r, c] == math.inf:
            return None
        if direction % 2:
            if neighbours == 4:
                return None
            if not corner_cutting and (pace[row, c] == math.inf or pace[r, col] == math.inf):
                return None
        factor = 1.0 if climb is None else factors_of(climb)[direction][row * cols + col]
        if factor == math.inf:
            return None
        total += float(pace[r, c]) * step_length(direction, edge) * factor
        row, col = r, c
    return row * cols + col, total


def lower_bound(tree: CostToGoTree, heuristic: NDArray[np.float32] | None, cell: int, cost: float) -> float:
    """s, what is proven of a padded cell that costs so much, as docs/certificates.md has it."""
    grid = tree.cost_grid

    def rounding(cost: float) -> float:
        return float(grid.rounding.at(np.array([cost]))[0])

    if cost == math.inf:
        return 0.0
    own = rounding(cost)
    if tree.exact:
        return (cost - cost * min(2.0 * own, 1.0)) * grid.time_share
    part, (row0, col0, row1, col1), rim, rim_cost = tree.window_bound or NO_WINDOW
    inner = rim_cost * (1.0 - rounding(rim_cost.max(initial=0.0)))
    way, shift = inner.min(initial=math.inf), -math.inf
    if heuristic is not None:
        falls = heuristic.astype(np.float64)
        fall = falls[cell] * (1.0 - own) if falls[cell] < math.inf else 0.0
        shift = fall - falls[grid.pad(tree.root)]
        if rim.size:
            way = max(way, fall - (falls[rim] - inner).max())
    row, col = (at - 1 for at in divmod(cell, grid.stride))
    if row0 <= row < row1 and col0 <= col < col1:
        inside = float(part.reshape(row1 - row0 + 2, -1)[row - row0 + 1, col - col0 + 1])
        way = min(way, inside * (1.0 - own) if inside < math.inf else math.inf)
    return max(0.0, shift, way if way < math.inf else 0.0) * grid.time_share
