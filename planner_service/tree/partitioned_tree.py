"""The exact tree of one target over a large map: it stays exact at every move, at a fraction of a growth.

`kernels.tile_pieces` says how it is laid out, `kernels.piece_totals` where it is checked after a change, and
`kernels.tile_search` why it ends, never has a cycle, and is optimal. A worker grows trees of either kind
(`GrownTree`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import piece_totals, tile_pieces, tile_search
from planner_service.kernels.layout import NONE, PaddedGrid
from planner_service.kernels.lower_bounds import WindowBound
from planner_service.kernels.tile_pieces import Tree
from planner_service.tree.cost_changes import Cells, Changes
from planner_service.tree.cost_grid import NO_COSTS, CostGrid
from planner_service.tree.cost_to_go import CostToGoTree, grow_window
from planner_service.tree.queue_choice import KeptScratch
from shared_map.array_files import Floats
from swarm.grid import Window

MOST_LOOKS = 3.0
"""A move or a repair gives way to a full search once it has checked this multiple of the map's tiles; a check that
ends in a repair counts as three (docs/design/incremental-trees.md)."""

MOST_KEPT = 1 << 9
"""Number of tiles for which the costs of their cells inside are kept: 17 MB. On 4096 x 4096 cells, a repair checks
200 tiles in the mean, and a move 170 to 260 (docs/design/incremental-trees.md)."""


class PartitionedTree:
    """The exact tree of one root on a `CostGrid` without climbs.

    cost_grid  the map that the tree lies on. A caller that changes it calls `repair`, or `take`
    parent     uint8, padded: direction of each cell's next cell; NONE at the root and where there is no path. Empty
               before the first `take`
    root       the target's cell, of the grid; -1 before the first `take`
    exact      whether all costs are the least there are. `grow`, `take` and `mend` set it, `move` to another root
               resets it, and so do `mend` and `repair` when they give way: the tree then still leads to its root,
               and states the cost driven
    window_bound  None: an exact tree bounds itself
    fine, precise  as of a `CostToGoTree`: true
    bound          as of a `CostToGoTree`: it is whole
    """

    fine = precise = True
    bound = math.inf

    def __init__(self, cost_grid: CostGrid) -> None:
        if cost_grid.climbs is not None:
            raise ValueError("a tree of pieces is for maps where a cell costs the same from everywhere")
        self.cost_grid = cost_grid
        self.parent: NDArray[np.uint8] = np.empty(0, np.uint8)
        self.root = -1
        self.exact = False
        self.window_bound: WindowBound | None = None
        self._across = -(-cost_grid.grid.cols // tile_pieces.SIDE)
        self._count = count = -(-cost_grid.grid.rows // tile_pieces.SIDE) * self._across
        self._piece = np.full(count * tile_pieces.CELLS, tile_pieces.NO_PIECE, np.uint8)
        self._rim = np.zeros(count * tile_pieces.PIECES, np.float64)
        self._totals = tile_pieces.make_totals(count)
        self._wanted = np.zeros(count, np.uint8)
        self._ends = np.zeros((2, count), np.float64)
        self._tiles = tile_pieces.Tiles(
            exits=np.zeros(count * tile_pieces.PIECES, np.uint8),
            many=np.zeros(count, np.int32),
            wanted=self._wanted,
            falls=np.zeros((3, count), np.float64),
            ends=self._ends,
            across=self._across,
        )
        self._scratch = tile_pieces.make_scratch(count, MOST_KEPT)
        self._now = 0
        self._stack = np.empty(count * tile_pieces.PIECES, np.int32)
        self._words = np.zeros((6, -(-count // 8)), np.int64)
        self._at_once = np.zeros(count)
        self._most = MOST_LOOKS * count + 64
        self._kept: KeptScratch = {}
        self.work = (0, 0, 0)
        """Tiles checked, tiles repaired and rounds of the last `mend`."""
        self._moved = False
        """The root has moved since totals were added up."""

    @property
    def _arrays(self) -> tuple[PaddedGrid, Tree]:
        """(map, tree) for kernels."""
        grid = self.cost_grid
        return grid.padded, Tree(self.parent, self._piece, self._rim, *self._totals, grid.pad(self.root))

    def grow(self, root: int) -> None:
        """Grows the whole tree of a cell, exactly. Raises OutsideGridError if it is none of the grid, ValueError if
        it is lethal."""
        self.cost_grid.check_root(root)
        parent = np.full(self.cost_grid.size, NONE, np.uint8)
        self.cost_grid.grow(self.cost_grid.pad(root), np.empty(self.cost_grid.size, np.float32), parent)
        self.take(root, parent)

    def take(self, root: int, parent: NDArray[np.uint8]) -> None:
        """Becomes a tree that was made elsewhere, on the current map, and makes it exact. The array is taken over.
        Raises as `grow`."""
        self.cost_grid.check_root(root)
        self.parent = parent
        self.root = root
        self._wanted[:] = tile_pieces.CHECK | tile_pieces.RELINK
        row, col = (at // tile_pieces.SIDE for at in self.cost_grid.grid.row_col(root))
        rows, cols = np.divmod(np.arange(self._count), self._across)
        self._ends[0] = np.maximum(np.abs(rows - row), np.abs(cols - col))
        self._relabel(np.full(self._count, tile_pieces.ALTERED))
        self._moved = True
        self._mend(math.inf, self._at_once)

    def move(self, root: int, window: Window) -> int:
        """Leads to a new root, by a window that holds it and the old one; `mend` makes the tree exact again.

        Returns cells grown, or 0 if nothing was done because the old root has no path to the new one inside the
        window. Raises as `grow`, and OutsideGridError on a window that is not inside the grid or does not hold both
        roots.
        """
        grid = self.cost_grid
        if self.root < 0:
            raise ValueError("the tree has no root: grow it first")
        grid.check_root(root)
        box, cost, parent, way = grow_window(grid, root, self.root, window, self._kept, True)
        if not way < math.inf:
            return 0
        if self._moved:
            self._add_up()
        old_root = grid.pad(self.root)
        self.root = root
        changed = np.zeros(self._count, np.uint8)
        tile_search.merge_parents(
            *self._arrays, self._tiles, self._scratch, (cost, parent, box, way), old_root, changed
        )
        self._relabel(changed)
        self._moved = True
        self.exact = False
        return window.cells

    def mend(self) -> int:
        """Makes the tree exact after any moves and repairs, or gives way to a growth: see `exact`. Returns the
        number of cells examined."""
        return self._mend(self._most, self._at_once)

    def repair(self, changes: Changes) -> int:
        """Brings the tree up to date after the map changed, and makes it exact, or gives way: `exact` tells.

        Returns the number of cells examined; -1 if it gave way and cells may lack a path that have one: then it
        must be grown before anything else.
        """
        if changes.cells.size == 0:
            return 0
        changed = np.zeros(self._count, np.uint8)
        tile_search.cut_parents(*self._arrays, self._across, changes.cells, changes.before, changed)
        turn = self._ends[0].copy()
        self._relabel(changed)
        looked = self._mend(self._most, turn)
        lost = np.flatnonzero(changed | (self._ends[1] == np.inf))
        tile_search.drop_cut_off(*self._arrays, self._tiles, lost)
        return looked if self.exact or not lost.size else -1

    def cost_at(self, cells: Cells) -> NDArray[np.float64]:
        """float64, s: what it costs to go from padded cells along the parents, length's price with it; inf where
        there is no path. Raises ValueError where one is no padded cell."""
        if self._moved:
            self._add_up()
        costs = np.empty(cells.size, np.float64)
        piece_totals.costs_at(*self._arrays, self._scratch, self._across, np.ascontiguousarray(cells), costs)
        return costs

    def time_at(self, cells: Cells) -> NDArray[np.float64]:
        """float64, s: how long it takes to drive from padded cells along the parents. Otherwise as `cost_at`."""
        grid = self.cost_grid
        if not grid.length_weight_s:
            return self.cost_at(cells)
        return grid.rests(self.parent, grid.pad(self.root), cells, grid.time_cost)

    @property
    def slack(self) -> tuple[float, float]:
        """Same as in `CostToGoTree`. Cell costs are float32, a few roundings; each step may leave `MOST_SLACK` of
        its cell's cost, and `Rounding` counts 2**24 for one."""
        return 2.0**-21, tile_pieces.MOST_SLACK * 2.0**24

    def tighten(self, cells: Cells) -> None:
        """Does nothing: costs are always those driven."""

    def _relabel(self, changed: NDArray[np.uint8]) -> None:
        """Labels again the changed tiles: uint8 (n,), `tile_pieces.COSTLIER` or more."""
        tile_pieces.relabel_tiles(*self._arrays, self._tiles, self._scratch, np.flatnonzero(changed), changed)

    def _schedule(self, turn: NDArray[np.float64]) -> tile_pieces.Schedule:
        """Returns the schedule for `improve_tiles`; totals are up to date after that call."""
        self._now += self._moved
        now = self._now if self._moved else 0
        self._moved = False
        order = np.argsort(self._ends[0])
        place = np.empty_like(order)
        place[order] = np.arange(order.size)
        return tile_pieces.Schedule(order, place, turn, now, self._stack, self._words.view(np.uint8), self._words)

    def _add_up(self) -> None:
        """Evaluates the totals."""
        piece_totals.add_up(*self._arrays, self._tiles, self._scratch, self._schedule(self._at_once))

    def _mend(self, most: float, turn: NDArray[np.float64]) -> int:
        """Checks tiles until the tree is exact, or as many as `most` have been."""
        looked, mended, rounds, left = tile_search.improve_tiles(
            *self._arrays, self._tiles, self._scratch, self._schedule(turn), most
        )
        self.exact = not left
        self.work = looked, mended, rounds
        return int(looked) * tile_pieces.CELLS


AnyTree = CostToGoTree | PartitionedTree


def in_pieces(tree: AnyTree) -> PartitionedTree:
    """The tree in pieces, which makes it exact; itself if it is."""
    if isinstance(tree, PartitionedTree):
        return tree
    pieces = PartitionedTree(tree.cost_grid)
    pieces.take(tree.root, tree.parent)
    return pieces


def in_cells(tree: AnyTree) -> CostToGoTree:
    """The tree with a cost in every cell; itself if it has them."""
    if isinstance(tree, CostToGoTree):
        return tree
    whole = CostToGoTree(tree.cost_grid)
    whole.take(tree.root, np.full(whole.cost_grid.size, np.inf, np.float32), tree.parent, 0.0)
    whole.mend()
    return whole


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
    pieces: PartitionedTree | None = None

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
    return 0 <= cell < cost_grid.grid.cells and bool(cost_grid.cell_cost[cost_grid.pad(cell)] < np.inf)


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
            cost = NO_COSTS  # given back before the pieces take as much
            pieces = PartitionedTree(cost_grid)
            pieces.take(target_cell, parent)
        heuristic = None if pieces is not None else cost.copy() if reach >= 0 else cost
        return GrownTree(
            *(target_cell, map_version, cost, heuristic, parent, cost_grid.cell_cost, reach, offered, pieces)
        )

    return job


def offered_gaps(cost_grid: CostGrid, grown: GrownTree, cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Driven cost over optimum of what the earlier tree offered cells of the grid, on the snapshot of `grown`.

    Cells without a path in either tree are left out. An offer may be better than the exact tree's by a difference
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
