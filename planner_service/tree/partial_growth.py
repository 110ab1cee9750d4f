"""A growth that goes only as far as its askers are, stops, and goes on."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import queue_dial
from planner_service.kernels.crops import stays_exact, walk_by_costs
from planner_service.kernels.layout import NONE, TOO_FINE, WALL
from planner_service.tree.cost_changes import Cells, Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.growth import NARROW
from shared_map.array_files import Floats

MOST_BUCKETS = 1 << 12
"""A growth can stop if its narrow buckets are at most this number: passing that many empty buckets costs less than
growing a whole map. With more, each growth is whole."""

_FEW = 4
"""If fewer than one cell in this number of a growth's rows has a cost, the column of each is computed. Otherwise
its rows are scanned, which takes a third as long a cell."""


class CutTree(NamedTuple):
    """The part of a root's tree that was grown: exact costs, on the map as it was.

    root    padded cell
    box     padded rows and columns (row0, col0, row1, col1), in which all cells with a cost lie
    cost    float32 (rows, cols), s; inf or less where a cell has none
    bound   s; no cell without a cost costs less. inf: it has no path
    width   s, of the buckets of the growth
    parent  uint8, padded, of a whole tree that costs alone do not tell; None of all others
    """

    root: int
    box: tuple[int, int, int, int]
    cost: Floats
    bound: float
    width: float
    parent: NDArray[np.uint8] | None = None

    @property
    def bytes(self) -> int:
        return self.cost.nbytes + (0 if self.parent is None else self.parent.nbytes)

    def at(self, cell: int, stride: int) -> float:
        """s, of a padded cell; inf where it has no cost."""
        row, col = divmod(cell, stride)
        row0, col0, row1, col1 = self.box
        if not (row0 <= row < row1 and col0 <= col < col1):
            return math.inf
        cost = float(self.cost[row - row0, col - col0])
        return cost if cost >= 0 else math.inf


class PartialGrowth:
    """One tree at a time over a `CostGrid`, which holds its arrays between trees: of one thread.

    It serves where entering a cell costs the same from everywhere and the costliest step takes at most
    `MOST_BUCKETS` buckets; `usable` tells. Elsewhere trees are grown whole: a directed growth settles a cell long
    after its first touch, and a wide bucket has no order within.
    """

    def __init__(self, cost_grid: CostGrid) -> None:
        self._grid = cost_grid
        self._width, self._circle = 0.0, 0
        self._scratch: queue_dial.Scratch | None = None
        self._state = np.zeros(4, np.int64)
        self._mark = np.zeros(cost_grid.size, np.uint8)
        self.cost: Floats = np.empty(0, np.float32)
        """float32, padded, s: of the tree in hand; inf where a cell has none, WALL where it is lethal."""
        self.root = -1
        """The padded root of the tree in hand; -1 if there is none."""
        self.bound = 0.0
        """s; every cell without a cost costs at least this; inf: it is unreachable."""

    @property
    def usable(self) -> bool:
        """Returns True if a growth over the map as it is now can stop."""
        return self._grid.climbs is None and self._needed(self._narrow) <= MOST_BUCKETS

    @property
    def reach(self) -> float:
        """Returns what no cost of the tree in hand exceeds, s."""
        return (int(self._state[0]) + 1) * self._width

    @property
    def _narrow(self) -> float:
        return float(np.float32(self._grid.lowest_cell_cost * NARROW))

    def _needed(self, width: float) -> float:
        return self._grid.highest_cell_cost * self._grid.dearest_step / width + 3

    @property
    def touched(self) -> int:
        """Returns how many cells of the tree in hand have a cost."""
        return int(self._state[3]) if self.root >= 0 else 0

    def begin(self, root: int) -> None:
        """Begins the tree of a padded, passable root."""
        self._clear()
        assert self._scratch is not None
        queue_dial.begin(self.cost, root, self._scratch, self._state)
        self.root, self.bound = root, 0.0

    def resume(self, tree: CutTree, level: float) -> None:
        """Takes up a tree that was cut out, of which all that costs less than `level` (s) is as it was."""
        self._clear()
        assert self._scratch is not None
        level = min(level, tree.bound)
        if level == tree.bound < math.inf and self._width == tree.width:
            first = round(level / self._width)
        else:  # a bucket less where the rounding of float32 might tell
            first = int(min(level / self._width * (1.0 - 1e-6), 1 << 30))
        if first < 1:
            self.begin(tree.root)
            return
        grid, buckets = self._grid.padded, (self._width, self._circle)
        queue_dial.resume(grid, self.cost, buckets, self._scratch, self._state, tree.box, tree.cost, first)
        self.root = tree.root
        self._find_bound()

    def go_on(self, askers: Cells, most: int) -> int:
        """Grows until these padded, passable cells have a cost, `most` more cells have one, or no cell is left.
        Returns how many more have one; -1 if costs became too large for float32: then a whole growth is left."""
        assert self._scratch is not None
        before, buckets = self.touched, (self._width, self._circle)
        last = queue_dial.grow_by_buckets(
            self._grid.padded, self.cost, buckets, self._scratch, self._state, askers, most
        )
        if last == TOO_FINE:
            return -1
        self._find_bound()
        return self.touched - before

    def _find_bound(self) -> None:
        self.bound = self.reach if self._state[1] else math.inf

    def cut(self) -> CutTree:
        """Returns the tree in hand, as an array of its own; then there is none in hand."""
        box = self.box()
        inner = self.inside(box)
        tree = CutTree(self.root, box, inner.copy(), self.bound, self._width)
        self._empty(inner)
        return tree

    def box(self) -> tuple[int, int, int, int]:
        """Returns the padded rows and columns in which all cells with a cost lie."""
        assert self._scratch is not None
        cells, stride = self._scratch[0][: self.touched], self._grid.stride
        row0, row1 = int(cells.min()) // stride, int(cells.max()) // stride + 1
        if cells.size < (row1 - row0) * stride // _FEW:
            cols = cells - cells // np.uint32(stride) * np.uint32(stride)
        else:
            cols = np.flatnonzero(np.isfinite(self.inside((row0, 0, row1, stride))).any(axis=0))
        return row0, int(cols.min()), row1, int(cols.max()) + 1

    def forget(self) -> None:
        """There is no tree in hand any more. The work follows the size of the tree."""
        if self.root >= 0:
            self._empty(self.inside(self.box()))

    def inside(self, box: tuple[int, int, int, int]) -> Floats:
        """Returns a view of the costs of a box of padded rows and columns."""
        row0, col0, row1, col1 = box
        inner: Floats = self.cost.reshape(-1, self._grid.stride)[row0:row1, col0:col1]
        return inner

    def _empty(self, inner: Floats) -> None:
        self.cost[self.root] = 1.0  # for 0 times inf is no number
        np.multiply(inner, np.float32(np.inf), out=inner)  # what is lethal stays WALL, which is -inf
        self.root = -1

    def learn(self, changes: Changes) -> None:
        """The map has changed: the tree in hand is forgotten."""
        if not changes.cells.size:
            return
        self.forget()
        if self.cost.size:
            self.cost[changes.cells] = np.where(changes.after < np.inf, np.float32(np.inf), WALL)

    def _clear(self) -> None:
        """No tree in hand, and room for one on the map as it is now."""
        self.forget()
        width = self._narrow
        if not self.cost.size:
            self.cost = np.where(self._grid.cell_cost < np.inf, np.float32(np.inf), WALL)
        if self._scratch is None or self._width > width or self._needed(self._width) > self._circle:
            self._width = width
            self._circle = 1 << max(2, math.ceil(math.log2(self._needed(width))))
            self._scratch = queue_dial.make_scratch(self._grid.size, self._grid.rule, self._circle)

    def stays(self, tree: CutTree, changes: Changes, route: Cells) -> tuple[float, bool]:
        """Returns what changes since a tree was cut out leave of it: below which cost (s) it is as it was, and
        whether a route, padded cells from a start to its root, is still one of the cheapest."""
        grid = self._grid
        at_start = tree.at(int(route[0]), grid.stride) if route.size else 0.0
        known = at_start, grid.lowest_cell_cost
        marks = changes.cells, changes.before, tree.bound, route, known, self._mark
        level, stands = stays_exact(grid.padded, tree.box, tree.cost, *marks)
        return float(level), bool(stands)


def route_of(cost_grid: CostGrid, tree: CutTree, start: int) -> NDArray[np.uint8]:
    """Returns the directions of a cheapest route from a padded cell that has a cost to the tree's root."""
    if tree.parent is None:
        directions = np.empty(tree.cost.size, np.uint8)
        steps = walk_by_costs(cost_grid.padded, tree.box, tree.cost, start, tree.root, directions)
        if steps < 0:
            raise AssertionError("a route does not end at the target: the tree is broken")
        return directions[:steps].copy()
    walked = cost_grid.walk(tree.parent, tree.root, np.array((start,)), 0, cost_grid.cell_cost)
    return walked.directions


def whole_tree(cost_grid: CostGrid, root: int) -> CutTree:
    """Returns the tree of a padded root, grown whole."""
    cost = np.empty(cost_grid.size, np.float32)
    parent = np.full(cost_grid.size, NONE, np.uint8)
    cost_grid.grow(root, cost, parent)
    box = 0, 0, cost_grid.size // cost_grid.stride, cost_grid.stride
    return CutTree(root, box, cost.reshape(box[2], box[3]), math.inf, 0.0, parent)
