"""The bound that crowds are compared with: PIBT in lockstep, which knows everything at once and sends no messages.

Vehicles of the same worlds step at the same instant to one of four neighbours, by the core with which leaders plan.
One may follow another into its cell; none go around in a ring. Four targets walk a cell in five steps, and jump
when they are captured.
"""

from __future__ import annotations

import random
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from swarm.right_of_way.pibt import Mover, Round

_TARGETS = 4
_WALK_STEPS, _COOL_STEPS, _ASSIGN_STEPS = 5, 20, 50
_WORTH = 0.85
"""A vehicle changes its target for one at less than this share of the distance."""
_OCCUPIED = 0.3
"""Cost of a cell on which another vehicle is now, in cells."""


class IdealCrowd:
    """Vehicles and targets on the open cells of a ground. Pure."""

    def __init__(self, pace: NDArray[np.float32], vehicles: int, seed: int) -> None:
        self._cols = pace.shape[1]
        self._chance = random.Random(f"ideal/{seed}")
        is_open = np.isfinite(pace)
        cells = np.arange(pace.size).reshape(pace.shape)
        tails, heads = [], []
        for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            both = is_open[one] & is_open[other]
            tails += [cells[one][both], cells[other][both]]
            heads += [cells[other][both], cells[one][both]]
        steps = np.concatenate(tails), np.concatenate(heads)
        self._graph = coo_array((np.ones(steps[0].size), steps), (pace.size, pace.size)).tocsr()
        _, parts = connected_components(self._graph)
        largest = np.bincount(parts[is_open.reshape(-1)]).argmax()
        self._home = np.flatnonzero((parts == largest) & is_open.reshape(-1)).tolist()
        self._distances: dict[int, NDArray[np.float64]] = {}
        self.cells: list[int] = self._chance.sample(self._home, vehicles)
        self._targets: list[int] = [self._chance.choice(self._home) for _ in range(_TARGETS)]
        self._cool = [0] * _TARGETS
        self._chased = [0] * vehicles
        self._ages = [0] * vehicles

    def _beside(self, cell: int) -> list[int]:
        found: list[int] = self._graph.indices[self._graph.indptr[cell] : self._graph.indptr[cell + 1]].tolist()
        return found

    def _distance(self, target: int) -> NDArray[np.float64]:
        cell = self._targets[target]
        if cell not in self._distances:
            self._distances[cell] = np.asarray(dijkstra(self._graph, unweighted=True, indices=[cell]))[0]
        return self._distances[cell]

    def _reaches(self, target: int, cell: int) -> bool:
        row, col = divmod(cell, self._cols)
        target_row, target_col = divmod(self._targets[target], self._cols)
        return bool(abs(row - target_row) <= 1 and abs(col - target_col) <= 1)

    def in_reach(self, vehicle: int) -> bool:
        return self._reaches(self._chased[vehicle], self.cells[vehicle])

    def move_targets(self, step: int) -> None:
        """Targets walk; those that are captured jump. From time to time vehicles choose another."""
        for target in range(_TARGETS):
            if step % _WALK_STEPS == 0:
                self._targets[target] = self._chance.choice(self._beside(self._targets[target]))
            caught = any(self._chased[n] == target and self.in_reach(n) for n in range(len(self.cells)))
            if caught and step >= self._cool[target]:
                self._cool[target] = step + _COOL_STEPS
                self._targets[target] = self._chance.choice(self._home)
        if step % _ASSIGN_STEPS == 0:
            for vehicle, cell in enumerate(self.cells):
                best = min(range(_TARGETS), key=lambda target: self._distance(target)[cell])
                if self._distance(best)[cell] <= _WORTH * self._distance(self._chased[vehicle])[cell]:
                    self._chased[vehicle] = best

    def step(self, follow: bool) -> None:
        """All vehicles step at once; without `follow` only into cells that are empty before."""
        occupied, movers = set(self.cells), []
        for vehicle, cell in enumerate(self.cells):
            distance, beside = self._distance(self._chased[vehicle]), self._beside(cell)
            near = self.in_reach(vehicle)
            self._ages[vehicle] = 0 if near else self._ages[vehicle] + 1
            cost = {each: distance[each] + _OCCUPIED * (each in occupied) for each in beside}
            wants = sorted(beside, key=lambda each: (cost[each], self._chance.random()))
            better = 0 if near else sum(cost[each] < distance[cell] for each in wants)
            movers.append(Mover(str(vehicle), cell, wants, better, self._ages[vehicle]))
        round = Round(movers, lambda cell: False, lambda cell: True)
        for mover in sorted(movers, key=lambda each: -each.age):
            round.plan(mover)
        planned = [round.to[mover.id] for mover in movers]
        assert len(set(planned)) == len(planned)
        self.cells = [
            to if follow or to not in occupied else cell for to, cell in zip(planned, self.cells, strict=True)
        ]


def drive_ideal(pace: NDArray[np.float32], vehicles: int, seed: int, steps: int, follow: bool) -> dict[str, Any]:
    """Returns the flow, the longest wait in steps and the arrivals of an ideal crowd."""
    crowd = IdealCrowd(pace, vehicles, seed)
    driven = ticks = arrivals = 0
    waits, longest = [0] * vehicles, 0
    for step in range(steps):
        crowd.move_targets(step)
        before, near = crowd.cells, [crowd.in_reach(n) for n in range(vehicles)]
        crowd.step(follow)
        for n in range(vehicles):
            moved = crowd.cells[n] != before[n]
            ticks += not near[n]
            driven += moved and not near[n]
            waits[n] = 0 if moved or near[n] else waits[n] + 1
            longest = max(longest, waits[n])
            arrivals += crowd.in_reach(n) and not near[n]
    return {"cells_per_step": driven / max(ticks, 1), "longest_wait": longest, "arrivals": arrivals}
