"""The rules of the paper, taken literally, from which this project differs. For docs/method/paper.md only.

Wan, Zhang, Murray, Kaufman: Automatic target tracking on multi-resolution terrain.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from swarm.grid import STEP_COL, STEP_ROW

Pace = NDArray[np.float32]
Place = tuple[int, int]


def printed_costs(pace: Pace, target: Place) -> NDArray[np.float64]:
    """(rows, cols) s: section 3.2 from a target. An edge costs what the cell that it points to costs, and edges are
    followed from the target outward, against the way that a vehicle drives. A diagonal step is sqrt(2) long."""
    return _dijkstra(pace, target, 1, lambda here, there: float(pace[there]))[0]


def printed_range(east: int, south: int, k_min: int) -> int:
    """The width in cells of the window of section 3.3.2, by its printed condition on a movement."""
    for k in range(k_min, 31):
        divides = east % 2**k == 0 or south % 2**k == 0
        if divides and east % 2 ** (k + 1) != 0 and south % 2 ** (k + 1) != 0:
            return (4 << k) + 1
    return 9


def lattice_route(pace: Pace, start: Place, target: Place, stride: int) -> NDArray[np.int64]:
    """(n, 2) places of the cheapest route over every `stride`th cell only, as in section 3.3.3 far from the target.
    Both ends stand on that lattice. Cells between those of the lattice do not count."""
    parent = _dijkstra(pace, target, stride, lambda here, there: float(pace[here]))[1]
    route = [start]
    while route[-1] != target:
        route.append(parent[route[-1]])
    return np.array(route)


def _dijkstra(
    pace: Pace, root: Place, stride: int, price: Callable[[Place, Place], float]
) -> tuple[NDArray[np.float64], dict[Place, Place]]:
    """Costs and parents from a root outward. `price` is of a unit step from a settled cell to its neighbour."""
    cost = np.full(pace.shape, math.inf)
    cost[root] = 0.0
    parent: dict[Place, Place] = {}
    heap = [(0.0, root)]
    while heap:
        at, here = heapq.heappop(heap)
        if at > cost[here]:
            continue
        for there, length in _around(pace, here, stride):
            offered = at + length * price(here, there)
            if offered < cost[there]:
                cost[there] = offered
                parent[there] = here
                heapq.heappush(heap, (offered, there))
    return cost, parent


def _around(pace: Pace, place: Place, stride: int) -> Iterator[tuple[Place, float]]:
    for direction in range(8):
        near = place[0] + stride * STEP_ROW[direction], place[1] + stride * STEP_COL[direction]
        inside = 0 <= near[0] < pace.shape[0] and 0 <= near[1] < pace.shape[1]
        if inside and math.isfinite(pace[near]):
            yield near, stride * (math.sqrt(2) if direction % 2 else 1.0)
