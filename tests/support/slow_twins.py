"""Slow twins: the same answers as the kernels', from the definitions, with scipy or plain Python in float64."""

import heapq
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from planner_service.tree.cost_to_go import NO_WINDOW, CostToGoTree
from shared_map.terrain.slope_and_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.wire.route_columns import RouteBatch

Cells = NDArray[np.int64]


def step_length(direction: int, edge: str) -> float:
    """In cells."""
    return math.sqrt(2.0) if direction % 2 and edge == "octile" else 1.0


def legal_steps(
    pace: NDArray[np.float32], neighbours: int, corner_cutting: bool
) -> Iterator[tuple[int, Cells, Cells]]:
    """For each direction: the cells from which a step leads there, and the cells to which it leads."""
    rows, cols = pace.shape
    cells = np.arange(pace.size).reshape(rows, cols)
    free = np.isfinite(pace)
    for direction in range(0, 8, 2 if neighbours == 4 else 1):
        dr, dc = STEP_ROW[direction], STEP_COL[direction]
        here = np.s_[max(0, -dr) : rows - max(0, dr), max(0, -dc) : cols - max(0, dc)]
        there = np.s_[max(0, dr) : rows + min(0, dr), max(0, dc) : cols + min(0, dc)]
        legal = free[here] & free[there]
        if direction % 2 and not corner_cutting:
            legal &= free[here[0], there[1]] & free[there[0], here[1]]
        yield direction, cells[here][legal], cells[there][legal]


def cost_to_go(
    pace: NDArray[np.float32],
    target: int,
    neighbours: int = 8,
    edge: str = "octile",
    corner_cutting: bool = False,
    climb: Climb | None = None,
    length_weight: float = 0.0,
    left_share: float = 0.0,
) -> NDArray[np.float64]:
    """Cheapest cost from every cell to the target on cells of one metre, by scipy on the graph of all steps with
    every edge turned round, so that a search from the target finds the ways to it.

    length_weight  what a metre costs beside its time
    left_share     share of a step that has the pace of the cell which it leaves: half of it in GRASS, none in ours
    """
    into, out, costs = [], [], []
    for direction, here, there in legal_steps(pace, neighbours, corner_cutting):
        length = step_length(direction, edge)
        left, entered = (pace.reshape(-1)[cells].astype(np.float64) for cells in (here, there))
        cost = (left_share * left + (1 - left_share) * entered) * length
        if climb is not None:
            cost *= climb.along(here, there)
        allowed = np.isfinite(cost)
        out.append(here[allowed])
        into.append(there[allowed])
        costs.append(cost[allowed] + length_weight * length)
    graph = (np.concatenate(costs), (np.concatenate(into), np.concatenate(out)))
    found: NDArray[np.float64] = dijkstra(csr_matrix(graph, shape=(pace.size, pace.size)), indices=target)  # type: ignore[call-overload]
    return found.reshape(pace.shape)


def cost_to_go_in_float32(
    cell_cost: NDArray[np.float32],
    target: int,
    neighbours: int = 8,
    edge: str = "octile",
    corner_cutting: bool = False,
    climb: Climb | None = None,
) -> NDArray[np.float32]:
    """Expected costs of trees, to the last bit, by a heap: each sum and each product rounded like theirs.

    Float32 sums grow with their terms, so the order in which cells are served makes no difference.

    cell_cost  float32 (rows, cols), s; of the cheapest straight step into each cell
    """
    into: list[list[tuple[int, np.float32]]] = [[] for _ in range(cell_cost.size)]
    for direction, out, to in legal_steps(cell_cost, neighbours, corner_cutting):
        prices = np.full(to.size, step_length(direction, edge), np.float32)
        if climb is not None:
            prices *= climb.along(out, to) / np.float32(climb.lowest)
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
    return best.reshape(cell_cost.shape)


class Driven(NamedTuple):
    """The outcome of routes that were driven step by step.

    last    int64 (n,), cell; -1 where a step breaks a rule
    time_s  float64 (n,), s
    """

    last: Cells
    time_s: NDArray[np.float64]


def drive(
    grid: GridSpec, config: PlannerConfig, pace: NDArray[np.float32], climb: Climb | None, routes: RouteBatch
) -> Driven:
    """Drives every route of a batch, step by step from its start to the end of its given part."""
    last, seconds = np.array(routes.starts), np.zeros(len(routes))
    begin = np.concatenate(([0], routes.ends[:-1])).astype(np.int64)
    steps = routes.ends - begin
    order = np.argsort(-steps, kind="stable")
    for n in range(int(steps.max(initial=0))):
        going = order[: np.searchsorted(-steps[order], -n, side="left")]
        going = going[last[going] >= 0]
        code = routes.directions[begin[going] + n].astype(np.int64)
        there, taken = _step(grid, config, pace, climb, last[going], code)
        last[going] = there
        seconds[going] += taken
    return Driven(last, seconds)


def _step(
    grid: GridSpec, config: PlannerConfig, pace: NDArray[np.float32], climb: Climb | None, here: Cells, code: Cells
) -> tuple[Cells, NDArray[np.float64]]:
    """Cell to which a step leads from each cell, and its time, s; -1 and inf where the rules forbid it."""
    row, col = np.divmod(here, grid.cols)
    r, c = row + np.array(STEP_ROW)[code], col + np.array(STEP_COL)[code]
    inside = (r >= 0) & (r < grid.rows) & (c >= 0) & (c < grid.cols)
    r, c, diagonal = np.where(inside, r, row), np.where(inside, c, col), code % 2 == 1
    there = r * grid.cols + c
    length_m = np.where(diagonal & (config.edge == "octile"), math.sqrt(2), 1.0) * grid.resolution_m
    taken = pace[r, c].astype(np.float64) * length_m
    if climb is not None:
        taken = taken * climb.along(here, there)
    legal = inside & np.isfinite(pace[row, col]) & np.isfinite(taken)
    if config.neighbours == 4:
        legal &= ~diagonal
    elif not config.corner_cutting:
        legal &= ~diagonal | (np.isfinite(pace[row, c]) & np.isfinite(pace[r, col]))
    return np.where(legal, there, -1), np.where(legal, taken, math.inf)


def lower_bound(tree: CostToGoTree, heuristic: NDArray[np.float32] | None, cell: int, cost: float) -> float:
    """The proven bound, s, of a padded cell of this cost, by docs/method/certificates.md."""
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
