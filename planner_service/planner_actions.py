"""Actions of a planner for the process around it, and the full search that a worker brings back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.layout import NONE
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.partitioned_tree import AnyTree, PieceTree, in_cells
from planner_service.tree.strides import StrideNetwork
from shared_map.array_files import Floats
from swarm.wire.messages.planning import Believed, PlannerStatus, PushedRoute

_NONE: Floats = np.empty(0, np.float32)


@dataclass(frozen=True, eq=False)
class GrownTree:
    """An exact tree, grown by a worker on a snapshot of the map. Arrays are padded, as `kernels.layout` says.

    target_cell  the root, wherever the target was
    map_version  of the snapshot
    cost         float32, s, cost-to-go of each cell; of no meaning where nothing was grown, empty beside `pieces`
    heuristic    a copy of it; None beside `pieces`, whose exact costs bound themselves
    parent       uint8, direction of the next cell
    cell_cost    float32, s, the cell costs of the snapshot
    reach        s; no cost exceeds it. Negative where nothing was grown, as no tree can lead there
    offered      parents of the tree that was served when the snapshot was taken; None where none led there
    pieces       the same tree in pieces, on the snapshot, over the same parents; None where that was not asked for
    """

    target_cell: int
    map_version: int
    cost: Floats
    heuristic: Floats | None
    parent: NDArray[np.uint8]
    cell_cost: Floats
    reach: float
    offered: NDArray[np.uint8] | None
    pieces: PieceTree | None = None

    def tree_on(self, cost_grid: CostGrid, in_pieces: bool) -> AnyTree:
        """Returns the tree on the current map: to be repaired by the changes since the snapshot."""
        if self.pieces is not None:
            same = self.pieces if in_pieces else in_cells(self.pieces)
            same.cost_grid = cost_grid
            return same
        tree = CostToGoTree(cost_grid)
        tree.take(self.target_cell, self.cost, self.parent, self.reach)
        return tree


def can_be_root(cost_grid: CostGrid, cell: int) -> bool:
    """Returns True if a tree can lead to a cell: it is one of the grid, and not lethal."""
    return cost_grid.grid.inside(*divmod(cell, cost_grid.grid.cols)) and cost_grid.passable(cell)


def growth_job(
    cost_grid: CostGrid,
    target_cell: int,
    map_version: int,
    offered: NDArray[np.uint8] | None,
    in_pieces: bool = False,
) -> Callable[[], GrownTree]:
    """A pure full growth that releases the interpreter lock. `cost_grid` is a snapshot."""

    def job() -> GrownTree:
        cost = np.empty(cost_grid.size, np.float32)
        parent = np.full(cost_grid.size, NONE, np.uint8)
        reach = -1.0
        if can_be_root(cost_grid, target_cell):
            reach = cost_grid.grow(cost_grid.pad(target_cell), cost, parent)
        pieces = None
        if in_pieces and reach >= 0:
            cost = _NONE  # given back before the pieces take as much
            pieces = PieceTree(cost_grid)
            pieces.take(target_cell, parent)
        heuristic = None if pieces is not None else cost.copy() if reach >= 0 else cost
        return GrownTree(
            *(target_cell, map_version, cost, heuristic, parent, cost_grid.cell_cost, reach, offered, pieces)
        )

    return job


def offered_gaps(cost_grid: CostGrid, grown: GrownTree, cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Driven cost over optimum of what the earlier tree offered cells of the grid, on the snapshot of `grown`.

    Cells without a way in either tree are left out. An offer may be better than the exact tree's by a difference
    that float32 takes for equal, and is then 1; a value below 1 contradicts the exact tree: a bug.
    """
    offered = grown.offered
    assert offered is not None
    starts = cost_grid.pad_all(cells)
    root = cost_grid.pad(grown.target_cell)
    starts = starts[(grown.parent[starts] != NONE) & (offered[starts] != NONE)]
    walks = cost_grid.walk(offered, root, starts, 0, grown.cell_cost)
    whole = walks.ends >= 0
    best = cost_grid.rests(grown.parent, root, starts[whole], grown.cell_cost)
    driven = walks.driven[whole]
    gaps: NDArray[np.float64] = driven / best
    return np.where((gaps < 1.0) & (driven >= best * (1.0 - 2.0 * cost_grid.rounding.at(best))), 1.0, gaps)


@dataclass(frozen=True, slots=True)
class Refusal:
    """A request that is not answered, and why."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class GrowTree:
    """Run `job` on a worker and bring what it returns to `Planner.adopt`."""

    job: Callable[[], GrownTree]


@dataclass(frozen=True, slots=True, eq=False)
class FindStrides:
    """Run `job` on a worker and bring what it returns to `Planner.adopt_strides`."""

    job: Callable[[], StrideNetwork]


Action = GrowTree | FindStrides | PushedRoute | PlannerStatus | Believed
"""Action of a planner: a search to run, networks of strides found, a message to publish."""
