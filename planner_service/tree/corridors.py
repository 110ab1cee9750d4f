"""The corridor graph of the coarse strategies: which cells carry how much traffic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import corridor_growth
from planner_service.kernels.layout import NONE
from planner_service.tree.cost_grid import Changes, CostGrid
from shared_map.arrays import CellsOf

LEAST = 64
"""The ways of so many cells make a cell part of a corridor."""
SAMPLES = 8
"""Trees that vote. Half as many take half the time to find, and are a third further from the optimum."""
INNER = 256
"""At most so many cells from the target all corridors take part; beyond, only those of more traffic."""
AROUND = 8
"""Cells around a change that all take part from then on, so that ways around it are found."""
EVERYWHERE = 255
STALE_SHARE = 16
"""Corridors are found anew when one cell in so many takes part because of changes."""


@dataclass(eq=False)
class CorridorGraph:
    """Far cells that carry traffic: what a coarse growth is restricted to.

    Advice, not knowledge: whatever it says, costs and passability are read from the map as it is now. So marks
    never make it wrong; they let more cells take part.
    """

    level: NDArray[np.uint8]
    """uint8, padded: 0 if a cell carries no traffic, 1 from `LEAST` cells on, one more for each four times that;
    EVERYWHERE around changes. `learn` only raises it."""
    stale_cells: int = 0
    """How many cells take part because the map changed around them. Only grows; a new graph begins with 0."""

    def learn(self, cost_grid: CostGrid, changes: Changes) -> bool:
        """Let all cells around a change take part. False once the corridors should be found anew."""
        level = self.level.reshape(-1, cost_grid.stride)
        rows, cols = np.divmod(changes.cells, cost_grid.stride)
        for row, col in np.unique(np.stack((rows // AROUND, cols // AROUND), axis=1), axis=0).tolist():
            part = np.s_[
                max(AROUND * (row - 1), 0) : AROUND * (row + 2), max(AROUND * (col - 1), 0) : AROUND * (col + 2)
            ]
            self.stale_cells += int(np.count_nonzero(level[part] != EVERYWHERE))
            level[part] = EVERYWHERE
        return self.stale_cells * STALE_SHARE <= cost_grid.size


class CorridorShelf(Protocol):
    """Where the planners of a machine leave the corridors of the map as it is before any mark, so that one of them
    finds these for all."""

    def load(self) -> NDArray[np.uint8] | None:
        """What one of them has left, as `CorridorGraph.level`; the caller may write to it."""
        ...

    def claim(self) -> bool:
        """Whether the caller is the one to find them: true again at its next call, until `leave` or its end."""
        ...

    def leave(self, level: NDArray[np.uint8]) -> None:
        """Leave what was found to all."""
        ...


class CorridorSearch:
    """Lets exact trees of cells all over the map vote: a cell's traffic is the most that passes it in any.

    A step grows one tree, so that a worker has time for other work between them. With a shelf, a step may do
    nothing while another process is finding the same.

    cost_grid  a snapshot
    level      as of a `CorridorGraph`; None until the search has ended
    """

    def __init__(self, cost_grid: CostGrid, shelf: CorridorShelf | None = None) -> None:
        self.cost_grid = cost_grid
        self.level: NDArray[np.uint8] | None = None
        self._shelf = shelf
        self._roots: list[int] | None = None
        self._votes: NDArray[np.uint8] = _NO_LEVEL

    def step(self) -> CorridorSearch:
        """Come a step nearer to `level`, which is None now. Returns itself."""
        if self._shelf is not None and self._roots is None:
            self.level = self._shelf.load()
            if self.level is not None or not self._shelf.claim():
                return self
        grid = self.cost_grid
        if self._roots is None:
            self._roots = _roots(grid)
            self._votes = np.zeros(grid.size, np.uint8)
        if self._roots:
            cost = np.empty(grid.size, np.float32)
            parent = np.full(grid.size, NONE, np.uint8)
            grid.grow(self._roots.pop(), cost, parent)
            del cost
            children, traffic = np.empty(grid.size, np.uint8), np.empty(grid.size, np.uint32)
            corridor_growth.mark_levels(parent, grid.padded[1], LEAST, self._votes, children, traffic)
        if not self._roots:
            self.level = self._votes
            if self._shelf is not None:
                self._shelf.leave(self.level)
        return self

    def run(self) -> CorridorSearch:
        """All steps at once; not for a search that may wait for another process."""
        while self.level is None:
            self.step()
        return self


class CorridorUpkeep:
    """The corridors of one tree, from search to search.

    graph   None until found, and again once too much has changed
    wanted  whether to begin a search
    """

    def __init__(self) -> None:
        self.graph: CorridorGraph | None = None
        self._searching = self._found_before = False

    @property
    def wanted(self) -> bool:
        return self.graph is None and not self._searching

    def search(self, cost_grid: CostGrid, shelf: CorridorShelf | None) -> CorridorSearch:
        """The first search is on the map as it was before any mark, if that is shared, so that all planners of a
        machine can take the same. Later ones, of corridors that have become stale, are on the map as it is."""
        self._searching = True
        shared = None if self._found_before else cost_grid.shared
        self._found_before = True
        return CorridorSearch(cost_grid.snapshot()) if shared is None else CorridorSearch(shared, shelf)

    def take(self, cost_grid: CostGrid, search: CorridorSearch) -> None:
        """Go by what was found, and let all cells around later changes take part."""
        assert search.level is not None
        self._searching = False
        self.graph = CorridorGraph(search.level)
        self.learn(cost_grid, cost_grid.changes_since(search.cost_grid.cell_cost))

    def learn(self, cost_grid: CostGrid, changes: Changes) -> None:
        """The map has changed."""
        if self.graph is not None and changes.cells.size and not self.graph.learn(cost_grid, changes):
            self.graph = None


def find_corridors(cost_grid: CostGrid) -> CorridorGraph:
    """The corridors of a map, at once."""
    level = CorridorSearch(cost_grid).run().level
    assert level is not None
    return CorridorGraph(level)


def _roots(cost_grid: CostGrid) -> list[int]:
    """Padded, passable cells, evenly spread by their number."""
    passable = CellsOf(cost_grid.cell_cost.reshape(-1, cost_grid.stride) < np.inf)
    if not len(passable):
        return []
    numbers = np.linspace(0, len(passable) - 1, SAMPLES + 2).astype(np.int64)[1:-1]
    return [passable.cell(number) for number in numbers.tolist()]


_NO_LEVEL: NDArray[np.uint8] = np.empty(0, np.uint8)
