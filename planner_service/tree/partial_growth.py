"""A growth that goes only as far as its askers are, stops, and goes on."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import dial_growth
from planner_service.kernels.layout import NONE, TOO_FINE, WALL
from planner_service.kernels.partial_growth_kernels import find_aim, stays_exact
from planner_service.kernels.route_kernels import point_routes
from planner_service.tree.cost_changes import Cells, Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.queue_choice import NARROW
from shared_map.array_files import Floats

MOST_BUCKETS = 1 << 12
"""A growth can stop if its narrow buckets are at most this number: passing that many empty buckets costs less than
growing a whole map. With more, each growth is whole."""


class CutTree(NamedTuple):
    """The part of a root's tree that was grown: exact costs, on the map as it was.

    root    padded cell
    box     padded rows and columns (row0, col0, row1, col1), around all cells with a cost and their neighbours
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
        """Returns its memory, with that of its objects."""
        return (1 << 10) + self.cost.nbytes + (0 if self.parent is None else self.parent.nbytes)

    def at(self, cell: int, stride: int) -> float:
        """s, of a padded cell; inf where it has no cost."""
        row, col = divmod(cell, stride)
        row0, col0, row1, col1 = self.box
        if not (row0 <= row < row1 and col0 <= col < col1):
            return math.inf
        cost = float(self.cost[row - row0, col - col0])
        return cost if cost >= 0 else math.inf


class Way(NamedTuple):
    """A route that was read off a tree.

    directions  uint8, one for each step to the root
    driven_s    what it takes, by the time of each step
    rest_s      what is left of that after the part that is given
    length_m    of that part
    """

    directions: NDArray[np.uint8]
    driven_s: float
    rest_s: float
    length_m: float


class PartialGrowth:
    """One tree at a time over a `CostGrid`, which holds its arrays between trees: of one thread.

    It serves where entering a cell costs the same from everywhere and the costliest step takes at most
    `MOST_BUCKETS` buckets; `usable` tells. Elsewhere trees are grown whole: a directed growth settles a cell long
    after its first touch, and a wide bucket has no order within.
    """

    def __init__(self, cost_grid: CostGrid) -> None:
        self._grid = cost_grid
        self._width, self._circle = 0.0, 0
        self._scratch: dial_growth.Scratch | None = None
        self._state = np.zeros(5, np.int64)
        self._mark = np.zeros(cost_grid.size, np.uint8)
        self.cost: Floats = np.empty(0, np.float32)
        """float32, padded, s: of the tree in hand; inf where a cell has none, WALL where it is lethal."""
        self.root = -1
        """The padded root of the tree in hand; -1 if there is none."""
        self.bound = 0.0
        """s; every cell without a cost costs at least this; inf: it is unreachable. 0 where cells were left out,
        and less once the map has changed: the tree in hand knows nothing of that."""

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
        touched, *_ = self._room()
        dial_growth.begin(self.cost, touched, self._state, root)
        self.root, self.bound = root, 0.0

    def resume(self, tree: CutTree, level: float) -> None:
        """Takes up a tree that was cut out, of which all that costs less than `level` (s) is as it was."""
        self.forget()
        touched, *_ = self._room()
        level = min(level, tree.bound)
        if level == tree.bound < math.inf and self._width == tree.width:
            first = round(level / self._width)
        else:  # a bucket less where the rounding of float32 might tell
            first = int(min(level / self._width * (1.0 - 1e-6), 1 << 30))
        if first < 1:
            self.begin(tree.root)
            return
        (row0, col0, row1, col1), stride = tree.box, self._grid.stride
        inverse, end = np.float32(1.0) / np.float32(self._width), np.float32(first)
        own = self._grid.cell_cost.reshape(-1, stride)[row0:row1, col0:col1]
        rows, cols = kept = np.nonzero((tree.cost >= 0) & (tree.cost * inverse < end) & (own < np.inf))
        cells, costs = (rows + row0) * stride + cols + col0, tree.cost[kept]
        self.cost[cells] = costs
        inner = (costs + own[kept] * np.float32(self._grid.diagonal)) * inverse < end
        touched[: cells.size] = np.concatenate((cells[inner], cells[~inner]))
        self._state[:] = first - 1, 0, np.count_nonzero(inner), cells.size, 0
        self.root, self.bound = tree.root, self.reach

    def aim_at(self, askers: Cells, root: int, parent: NDArray[np.uint8]) -> dial_growth.Aim:
        """Returns the aim of the next growth, from a padded, passable root to such cells, which it sorts. None
        costs more than along the parents to a cell beside that root, or over the tree in hand and its root. Where
        neither is known, no cells are left out."""
        grid, between = self._grid, math.inf
        if not askers.size:
            return dial_growth.NO_AIM
        if self.root >= 0 and self.bound >= 0:
            back = float(grid.cell_cost[root] + self.cost[root] - grid.cell_cost[self.root])
            between = back * grid.dearest_step
        cost = self.cost if self.root >= 0 else grid.cell_cost
        known, boxes = (between, grid.lowest_cell_cost), np.empty((askers.size, 5), np.float32)
        most = find_aim(grid.padded, cost, parent, askers, root, known, boxes)
        return grid.lowest_cell_cost, most, boxes

    def go_on(self, askers: Cells, most: int, aim: dial_growth.Aim = dial_growth.NO_AIM) -> int:
        """Grows until these padded, passable cells have a cost, `most` more cells have one, or no cell is left.
        Returns how many more have one; -1 if costs became too large for float32: then a whole growth is left.

        aim  which cells are left out. After a growth that left out some, one that goes on begins again
        """
        if self._state[4]:
            self.begin(self.root)
        assert self._scratch is not None
        before, buckets = self.touched, (self._width, self._circle)
        grown = self._grid.padded, self.cost, buckets, self._scratch, self._state
        last = dial_growth.grow_by_buckets(*grown, askers, most, aim)
        if last == TOO_FINE:
            return -1
        self._find_bound()
        return self.touched - before

    def _find_bound(self) -> None:
        self.bound = 0.0 if self._state[4] else self.reach if self._state[1] else math.inf

    def cut(self) -> CutTree:
        """Returns the tree in hand, as an array of its own with a rim of cells without a cost. Then none is
        in hand."""
        assert self._scratch is not None
        held = self._grid.window_of(self._scratch[0][: self.touched])
        box = held.row0, held.col0, held.row1 + 2, held.col1 + 2  # with one cell around, and padded
        inner = self.cost.reshape(-1, self._grid.stride)[box[0] : box[2], box[1] : box[3]]
        tree = CutTree(self.root, box, inner.copy(), self.bound, self._width)
        self.forget()
        return tree

    def forget(self) -> None:
        """There is no tree in hand any more. The work follows the size of the tree."""
        if self._scratch is not None:
            dial_growth.begin(self.cost, self._scratch[0], self._state, -1)
        self.root = -1

    def learn(self, changes: Changes) -> None:
        """The map has changed: the tree in hand is that of the map as it was, and cannot go on."""
        if self.cost.size and changes.cells.size:
            self.bound = -1.0
            self.cost[changes.cells] = np.where(changes.after < np.inf, np.float32(np.inf), WALL)

    def _room(self) -> dial_growth.Scratch:
        """Returns room for a tree on the map as it is now."""
        width = self._narrow
        if not self.cost.size:
            self.cost = np.where(self._grid.cell_cost < np.inf, np.float32(np.inf), WALL)
        if self._scratch is None or self._width > width or self._needed(self._width) > self._circle:
            self._width = width
            self._circle = 1 << max(2, math.ceil(math.log2(self._needed(width))))
            self.forget()
            self._scratch = dial_growth.make_scratch(self._grid.size, self._grid.rule, self._circle)
        return self._scratch

    def stays(self, tree: CutTree, changes: Changes, route: Cells) -> tuple[float, bool]:
        """Returns what changes since a tree was cut out leave of it: below which cost (s) it is as it was, and
        whether a route, padded cells from a start to its root, is still one of the cheapest."""
        grid = self._grid
        at_start = tree.at(int(route[0]), grid.stride) if route.size else 0.0
        known = at_start, grid.lowest_cell_cost
        marks = changes.cells, changes.before, tree.bound, route, known, self._mark
        level, stands = stays_exact(grid.padded, tree.box, tree.cost, *marks)
        return float(level), bool(stands)


Pointed = tuple[NDArray[np.uint8], NDArray[np.uint32]]
"""Scratch of `way_of`: uint8 (size,), NONE; and room for the padded cells of a route."""


def way_of(costs: CostGrid, tree: CutTree, start: int, part: int, pointed: Pointed) -> Way:
    """Returns a cheapest route from a padded cell that has a cost to the tree's root.

    part  steps of the part that is measured; 0 is the whole route
    """
    at, (parent, cells) = np.array((start,)), pointed
    if tree.parent is not None:
        parent, many = tree.parent, 0
    else:
        many = point_routes(costs.padded, tree.box, tree.cost.reshape(-1), tree.root, at, parent, cells, 0)
    whole, first = (costs.walk(parent, tree.root, at, most, costs.time_cost) for most in (0, part))
    parent[cells[:many]] = NONE
    if whole.ends[0] < 0:
        raise AssertionError("a route does not end at the target: the tree is broken")
    driven = float(whole.driven[0])
    return Way(whole.directions, driven, driven - float(first.driven[0]), float(first.length[0]))


def whole_tree(cost_grid: CostGrid, root: int) -> CutTree:
    """Returns the tree of a padded root, grown whole."""
    cost = np.empty(cost_grid.size, np.float32)
    parent = np.full(cost_grid.size, NONE, np.uint8)
    cost_grid.grow(root, cost, parent)
    return CutTree(root, cost_grid.padded_box, cost.reshape(-1, cost_grid.stride), math.inf, 0.0, parent)
