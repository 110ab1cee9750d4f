"""Ways around obstacles that stand on routes. Planners know no obstacles, so the host drives around them itself.

A route that passes a standing obstacle is replaced by the cheapest path from where the vehicle's path ends back
onto the route behind the obstacle: A* on the host's own map, with the cells of all obstacles closed.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.slope_and_climb import Climb
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.traffic.obstacles import Obstacles

_SEARCH_CELLS = 200
"""Cells of the route ahead that are searched for obstacles, and behind an obstacle for where to come back."""
_CELLS_PER_TICK = 400
"""Expanded by all searches of a host: some 4 ms (docs/design/reported-obstacles.md)."""
_MOST_CELLS = 20_000
"""Expanded by one search: then there is no path around that is worth it."""
_AGAIN_NS = NS_PER_S
_RARELY_NS = 16 * NS_PER_S
"""A vehicle without a path around is tried again after one second, then after twice as long, up to this."""
_DIAGONAL = math.sqrt(2.0)
"""Length of a diagonal step, in cells."""


@dataclass
class Detours:
    """Leads vehicles around standing obstacles.

    grid   cells of right of way
    pace   float32 (rows, cols) of the terrain, s/m; inf is lethal
    steps  the neighbours of a cell to which one may drive: not lethal, not closed, not too steep
    climb  factor of a step's cost by its slope; None if steps cost the same both ways

    found  how many ways around were begun
    """

    grid: GridSpec
    pace: NDArray[np.float32]
    steps: Callable[[int], list[int]]
    obstacles: Obstacles
    climb: Climb | None = None
    found: int = 0
    _searches: dict[str, tuple[int, Iterator[list[int] | None]]] = field(default_factory=dict)
    """Vehicle -> the search under way for it, and the route for which it was begun."""
    _waits: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Vehicle without a path around -> when it is tried again, and the pause before that."""

    def __post_init__(self) -> None:
        self._pace = self.pace.reshape(-1)

    def tick(self, vehicles: Iterable[Vehicle], path: Callable[[str], Sequence[int]], now_ns: int) -> None:
        """Begins and continues searches; vehicles for which one has ended follow what it has found."""
        standing = self.obstacles.standing if self.obstacles.any else set[int]()
        if not standing:
            self._searches.clear()
            self._waits.clear()
            return
        blocked = {
            each.id: each
            for each in vehicles
            if not each.in_reach and not standing.isdisjoint(each.route.ahead(_SEARCH_CELLS))
        }
        self._searches = {id: each for id, each in self._searches.items() if id in blocked}
        self._waits = {id: each for id, each in self._waits.items() if id in blocked}
        left = _CELLS_PER_TICK
        for id, vehicle in blocked.items():
            if left <= 0:
                return
            if now_ns < self._waits.get(id, (0, 0))[0]:
                continue
            changes, search = self._searches.get(id, (-1, iter(())))
            if changes != vehicle.route.changes:
                search = self._search(vehicle, path(id)[-1], standing)
                self._searches[id] = vehicle.route.changes, search
            for way in search:
                left -= 1
                if way is not None:
                    break
                if left <= 0:
                    return
            else:
                way = None
            del self._searches[id]
            self._end(vehicle, way, path(id), now_ns)

    def _end(self, vehicle: Vehicle, way: list[int] | None, path: Sequence[int], now_ns: int) -> None:
        # It may have driven on meanwhile, to where the way does not pass.
        if way is not None and path[-1] in way and vehicle.route.begin(way, path[-1:], vehicle.route.partial):
            self._waits.pop(vehicle.id, None)
            self.found += 1
        else:
            pause_ns = min(2 * self._waits.get(vehicle.id, (0, _AGAIN_NS // 2))[1], _RARELY_NS)
            self._waits[vehicle.id] = now_ns + pause_ns, pause_ns

    def _search(self, vehicle: Vehicle, start: int, standing: set[int]) -> Iterator[list[int] | None]:
        """Yields None per expanded cell, and last the cells of the new route, if there is one."""
        route = vehicle.route.ahead()
        first = next(index for index, cell in enumerate(route) if cell in standing)
        behind = route[first : first + _SEARCH_CELLS]
        rest_s, goals = 0.0, {}
        for index in range(len(behind) - 1, -1, -1):
            if behind[index] not in self.obstacles.closed:
                goals[behind[index]] = (rest_s, first + index)
            if index:
                rest_s += self._step_s(behind[index - 1], behind[index])
        if not goals:
            return
        lowest = 1.0 if self.climb is None else self.climb.lowest
        least = float(self._pace[self.grid.terrain_cell(np.array(behind))].min()) * self.grid.resolution_m * lowest
        end_row, end_col = divmod(behind[-1], self.grid.cols)

        def bound_s(cell: int) -> float:
            row, col = divmod(cell, self.grid.cols)
            south, east = abs(row - end_row), abs(col - end_col)
            return least * (max(south, east) + (_DIAGONAL - 1.0) * min(south, east))

        best_s, best = math.inf, -1
        cost_s, before = {start: 0.0}, {start: start}
        heap, done = [(bound_s(start), start)], set[int]()
        while heap and heap[0][0] < best_s and len(done) < _MOST_CELLS:
            _, cell = heapq.heappop(heap)
            if cell in done:
                continue
            done.add(cell)
            here_s = cost_s[cell]
            if cell in goals and here_s + goals[cell][0] < best_s:
                best_s, best = here_s + goals[cell][0], cell
            for to in self.steps(cell):
                there_s = here_s + self._step_s(cell, to)
                if there_s < cost_s.get(to, math.inf):
                    cost_s[to], before[to] = there_s, cell
                    heapq.heappush(heap, (there_s + bound_s(to), to))
            yield None
        if best < 0:
            return
        way = [best]
        while way[-1] != start:
            way.append(before[way[-1]])
        yield [*way[::-1], *route[goals[best][1] + 1 :]]

    def _step_s(self, tail: int, head: int) -> float:
        straight = abs(head - tail) in (1, self.grid.cols)
        pace = self._pace.item(self.grid.terrain_cell(head))
        level_s = pace * self.grid.resolution_m * (1.0 if straight else _DIAGONAL)
        return level_s if self.climb is None else level_s * self.climb.driven(*self.grid.terrain_step(tail, head))
