"""Ways around an occupied cell: a search over a few cells, without any planner."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from swarm.grid import GridSpec

HORIZON_CELLS = 40
"""A detour comes back to the route within so many cells of it."""
_REACH_CELLS = 6


class Detours:
    """Searches detours on a map.

    pace        float32 (rows, cols), s/m; inf is lethal; read at each search
    neighbours  4 or 8; with 8 a diagonal step needs both cells beside it, unless `corner_cutting`
    """

    def __init__(self, grid: GridSpec, pace: NDArray[np.float32], neighbours: int, corner_cutting: bool) -> None:
        self._grid = grid
        self._pace = pace.reshape(-1)
        self._neighbours = neighbours
        self._corner_cutting = corner_cutting

    def closed(self, cell: int) -> bool:
        """Whether a cell is lethal."""
        return not math.isfinite(self._pace[cell])

    def steps(self, cell: int) -> list[tuple[int, float]]:
        """(neighbour, length in cells) of each step that the map allows from a cell."""
        around: list[int | None] = [None] * 8
        for direction, neighbour in self._grid.neighbours(cell):
            if not self.closed(neighbour):
                around[direction] = neighbour
        steps: list[tuple[int, float]] = []
        for direction, found in enumerate(around):
            if found is None:
                continue
            if direction % 2 == 0:
                steps.append((found, 1.0))
            elif self._neighbours == 8:
                sides = around[direction - 1] is not None and around[(direction + 1) % 8] is not None
                if sides or self._corner_cutting:
                    steps.append((found, math.sqrt(2.0)))
        return steps

    def find(
        self,
        here: int,
        route: Sequence[int],
        blocked: int,
        in_reach: Callable[[int], bool],
        occupied: Callable[[int], bool],
    ) -> list[int] | None:
        """The cells from `here` back to the route, or to one in reach of the target; None if there is no detour.

        Dijkstra's algorithm within `_REACH_CELLS` of `here`. Of all places to rejoin the route the one with the
        lowest sum of the detour and the rest of the route is taken.

        route     the next cells of the route, at most `HORIZON_CELLS`
        blocked   index of the occupied cell in the route: rejoin it behind that one
        """
        rest_s = self._rest_s(route, blocked)
        reached_s: dict[int, float] = {here: 0.0}
        came_from: dict[int, int] = {}
        frontier = [(0.0, here)]
        best: tuple[float, int] | None = None
        while frontier:
            cost_s, cell = heapq.heappop(frontier)
            if cost_s > reached_s[cell] or (best is not None and cost_s >= best[0]):
                continue
            if cell != here:
                whole_s = cost_s if in_reach(cell) else cost_s + rest_s.get(cell, math.inf)
                if math.isfinite(whole_s) and (best is None or whole_s < best[0]):
                    best = (whole_s, cell)
            for neighbour, length in self.steps(cell):
                if self._grid.distance_cells(here, neighbour) > _REACH_CELLS or occupied(neighbour):
                    continue
                through_s = cost_s + length * float(self._pace[neighbour])
                if through_s < reached_s.get(neighbour, math.inf):
                    reached_s[neighbour] = through_s
                    came_from[neighbour] = cell
                    heapq.heappush(frontier, (through_s, neighbour))
        if best is None:
            return None
        detour = [best[1]]
        while came_from[detour[-1]] != here:
            detour.append(came_from[detour[-1]])
        detour.reverse()
        return detour

    def _rest_s(self, route: Sequence[int], blocked: int) -> dict[int, float]:
        """Cell -> cost of the route behind it, of the cells behind the blocked one."""
        rest_s: dict[int, float] = {}
        total_s = 0.0
        for index in range(len(route) - 1, blocked, -1):
            rest_s[route[index]] = total_s
            total_s += float(self._pace[route[index]])
        return rest_s
