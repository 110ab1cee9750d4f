"""Routes of any start to any goal, from trees that grow as far as the farthest asker and are kept for the next.

A tree is kept by its goal. A change of the map is only logged: the next ask looks at the changes near its tree
(docs/design/incremental-trees.md). If they leave its own route as it was, it is answered without a growth. If not,
the tree is cut back to the costs that are still right, and goes on from there.

No clock decides here: growths and the cache are bounded by cells and bytes, and a simulation replays them.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from planner_service.tree.cost_changes import NO_CHANGES, Cells, Changes, joined
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.partial_growth import CutTree, PartialGrowth, route_of, whole_tree
from swarm.grid import STEP_COL, STEP_ROW

GoalStatus = Literal["ok", "unreachable", "lethal_goal", "lethal_start", "outside", "growing"]

MOST_CHANGES = 500
"""Changes near a tree beyond which it is dropped: another growth costs less than to look at them."""
_MOST_ENTRIES = 2000
"""Changes of the map since a tree was looked at, beyond which it is dropped: to sort them out takes 30 ms."""
_LONGEST_LOG = 1 << 16
"""Cells in the log of changes: a tree that would need older ones is dropped."""
_OBJECTS_BYTES = 1 << 10
"""Memory of a tree beside its costs."""
_NO_CELLS: Cells = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class GoalAnswer:
    """A route from a start to a goal, or why there is none.

    status         "ok"; "growing": not known yet, asking again goes on; "unreachable", "lethal_goal",
                   "lethal_start", "outside"
    cells          int64 (steps + 1,), cells of the grid from the start to the goal; the start alone without a route
    cost_s         s, what driving it takes; inf without a route
    lower_bound_s  s, proven: no route takes less; inf where there is none. While it grows, the frontier
    grown_cells    cells that this ask has grown
    from_cache     whether a tree that was kept answered as it was
    """

    status: GoalStatus
    cells: Cells
    cost_s: float
    lower_bound_s: float
    grown_cells: int = 0
    from_cache: bool = False


@dataclass(slots=True)
class _Kept:
    """A tree in the cache.

    tree     as it was cut out; None while it is in hand
    seen     changes of the map that were looked at, in a count of all
    changes  those of them that lie near the tree
    """

    tree: CutTree | None
    seen: int
    changes: Changes = field(default=NO_CHANGES)


class GoalTrees:
    """Trees of goals on the cost map of one vehicle class; of the thread that changes the map.

    Parameters
    ----------
    costs : CostGrid
        Its owner calls `changed` after each `apply`, and `forget_all` after any other change.
    budget_bytes : int
        What the trees that are kept may take. Beside them one is in hand, with 20 bytes for each cell it has grown.
    """

    def __init__(self, costs: CostGrid, budget_bytes: int) -> None:
        self.costs = costs
        self._budget = budget_bytes
        self._growth = PartialGrowth(costs)
        self._in_hand: _Kept | None = None
        # By goal, in the order of their last asks.
        self._kept: OrderedDict[int, _Kept] = OrderedDict()
        self.bytes = 0
        """Bytes of all trees that are kept, without the one in hand."""
        self._log: list[Changes] = []
        self._forgotten = 0
        self._logged = 0

    @property
    def trees(self) -> int:
        """Returns how many goals have a tree."""
        return len(self._kept)

    # --- changes of the map -------------------------------------------------------------------------------------

    def changed(self, changes: Changes) -> None:
        """The cost map has changed, by `CostGrid.apply`, which returned this."""
        if not changes.cells.size:
            return
        self._put_down()
        self._growth.learn(changes)
        self._log.append(changes)
        self._logged += changes.cells.size
        while self._logged > _LONGEST_LOG and self._log:
            self._logged -= self._log.pop(0).cells.size
            self._forgotten += 1

    def forget_all(self) -> None:
        """Every cell cost may be another: all trees are dropped."""
        self._in_hand = None
        self._kept.clear()
        self.bytes = 0
        self._growth = PartialGrowth(self.costs)
        self._forgotten += len(self._log)
        self._log, self._logged = [], 0

    # --- answers ------------------------------------------------------------------------------------------------

    def ask(self, goal: int, start: int, most_cells: int) -> GoalAnswer:
        """The cheapest route between two cells of the grid. Grows about `most_cells` at most; where growths cannot
        stop (see `PartialGrowth`), a whole tree."""
        grid = self.costs.grid
        alone = np.array((start,), np.int64)
        if not (0 <= goal < grid.cells and 0 <= start < grid.cells):
            return GoalAnswer("outside", alone, math.inf, math.inf)
        root, at = self.costs.pad(goal), self.costs.pad(start)
        if not self.costs.cell_cost[root] < np.inf:
            self._drop(goal)
            return GoalAnswer("lethal_goal", alone, math.inf, math.inf)
        if not self.costs.cell_cost[at] < np.inf:
            return GoalAnswer("lethal_start", alone, math.inf, math.inf)
        kept = self._kept.get(goal)
        if kept is not None and not self._look(kept):
            self._drop(goal)
            kept = None
        if kept is not None:
            self._kept.move_to_end(goal)
            known = self._known(kept, at)
            if known is not None:
                return known
        return self._grown(goal, kept, root, at, max(most_cells, 1))

    def _look(self, kept: _Kept) -> bool:
        """Collects the changes near a tree since it was looked at last. Returns False if they are too many."""
        if kept.seen < self._forgotten:
            return False
        fresh = self._log[kept.seen - self._forgotten :]
        if len(fresh) > _MOST_ENTRIES:
            return False
        kept.seen = self._forgotten + len(self._log)
        if kept.tree is not None and fresh:
            near = [_near(each, kept.tree.box, self.costs.stride) for each in fresh]
            kept.changes = joined([kept.changes, *near])
        return kept.changes.cells.size <= MOST_CHANGES

    def _known(self, kept: _Kept, start: int) -> GoalAnswer | None:
        """The answer of a tree as it is; None if it must grow for that."""
        tree = kept.tree
        if tree is None:
            tree = self._held
        cost = tree.at(start, self.costs.stride)
        if not kept.changes.cells.size:
            if cost < math.inf:
                return self._ok(tree, start, route_of(self.costs, tree, start), 0)
            return self._none(start, 0) if tree.bound == math.inf else None
        if cost == math.inf:
            return None
        route = self._as_it_was(kept.changes, tree, start)
        cells = self._padded(start, route, self.costs.stride)
        level, stands = self._growth.stays(tree, kept.changes, cells)
        return self._ok(tree, start, route, 0) if stands or cost < level * (1.0 - 1e-6) else None

    @property
    def _held(self) -> CutTree:
        """The tree in hand, as a view of it."""
        growth, stride = self._growth, self.costs.stride
        whole = growth.cost.reshape(-1, stride)
        return CutTree(growth.root, (0, 0, *whole.shape), whole, growth.bound, 0.0)

    def _as_it_was(self, changes: Changes, tree: CutTree, start: int) -> NDArray[np.uint8]:
        """The directions of a route on the map on which the tree was grown."""
        costs, cells = self.costs.cell_cost, changes.cells
        now = costs[cells]
        costs[cells[::-1]] = changes.before[::-1]  # of a cell that changed twice, its first cost stays
        try:
            return route_of(self.costs, tree, start)
        finally:
            costs[cells] = now

    def _grown(self, goal: int, kept: _Kept | None, root: int, start: int, most: int) -> GoalAnswer:
        """Grows the tree until it has a cost for the start."""
        growth = self._growth
        if not growth.usable:
            return self._grown_whole(goal, root, start)
        if kept is None or (kept.tree is not None and kept.tree.parent is not None):
            self._drop(goal)
            self._put_down()
            growth.begin(root)
            kept = self._kept[goal] = _Kept(None, self._forgotten + len(self._log))
        elif kept.tree is not None:
            tree, changes, level = kept.tree, kept.changes, math.inf
            self.bytes -= _bytes(tree)
            kept.tree, kept.changes = None, NO_CHANGES
            self._put_down()
            if changes.cells.size:
                level, _ = growth.stays(tree, changes, _NO_CELLS)
            growth.resume(tree, level)
        self._in_hand = kept
        cells = growth.go_on(np.array((start,)), most)
        if cells < 0:
            return self._grown_whole(goal, root, start)
        if growth.cost[start] < np.inf:
            tree = self._held
            return self._ok(tree, start, route_of(self.costs, tree, start), cells)
        return self._none(start, cells) if growth.bound == math.inf else self._none(start, cells, growth.bound)

    def _grown_whole(self, goal: int, root: int, start: int) -> GoalAnswer:
        self._drop(goal)
        tree = whole_tree(self.costs, root)
        self._kept[goal] = _Kept(tree, self._forgotten + len(self._log))
        self.bytes += _bytes(tree)
        self._evict()
        cells = self.costs.grid.cells
        if tree.at(start, self.costs.stride) == math.inf:
            return self._none(start, cells)
        return self._ok(tree, start, route_of(self.costs, tree, start), cells)

    def _ok(self, tree: CutTree, start: int, route: NDArray[np.uint8], grown: int) -> GoalAnswer:
        grid = self.costs
        cells = self._padded(start, route, grid.stride)
        cost = tree.at(start, grid.stride)
        bound = cost * (1.0 - 2.0 * float(grid.rounding.at(np.float64(cost)))) * grid.time_share
        if grid.climbs is None:
            lengths = np.where(route & 1, grid.diagonal, 1.0)
            driven = float(grid.time_cost[cells[1:]] @ lengths)
        else:
            assert tree.parent is not None
            driven = float(grid.walk(tree.parent, tree.root, cells[:1].copy(), 0, grid.time_cost).driven[0])
        here = self._padded(self._unpad(start), route, grid.grid.cols)
        return GoalAnswer("ok", here, driven, min(max(bound, 0.0), driven), grown, grown == 0)

    def _none(self, start: int, grown: int, bound: float = math.inf) -> GoalAnswer:
        alone = np.array((self._unpad(start),))
        if bound == math.inf:
            return GoalAnswer("unreachable", alone, math.inf, math.inf, grown, grown == 0)
        return GoalAnswer("growing", alone, math.inf, bound * (1.0 - 1e-6) * self.costs.time_share, grown)

    def _unpad(self, cell: int) -> int:
        row, col = divmod(cell, self.costs.stride)
        return (row - 1) * self.costs.grid.cols + col - 1

    @staticmethod
    def _padded(start: int, route: NDArray[np.uint8], stride: int) -> Cells:
        """The cells that directions lead through, on rows of this many cells."""
        steps = _ROWS * stride + _COLS
        cells = np.empty(route.size + 1, np.int64)
        cells[0] = start
        np.cumsum(steps[route], out=cells[1:])
        cells[1:] += start
        return cells

    # --- the cache ----------------------------------------------------------------------------------------------

    def _put_down(self) -> None:
        """The tree in hand becomes one of those that are kept."""
        kept, self._in_hand = self._in_hand, None
        if kept is not None and self._growth.root >= 0:
            kept.tree = self._growth.cut()
            self.bytes += _bytes(kept.tree)
            self._evict()

    def _drop(self, goal: int) -> None:
        kept = self._kept.pop(goal, None)
        if kept is None:
            return
        if kept is self._in_hand:
            self._in_hand = None
            self._growth.forget()
        if kept.tree is not None:
            self.bytes -= _bytes(kept.tree)

    def _evict(self) -> None:
        """Drops trees, the one with the oldest ask first, until the budget holds."""
        for goal in [goal for goal, kept in self._kept.items() if kept.tree is not None]:
            if self.bytes <= self._budget:
                return
            self._drop(goal)


_ROWS, _COLS = np.array(STEP_ROW, np.int64), np.array(STEP_COL, np.int64)


def _bytes(tree: CutTree) -> int:
    return _OBJECTS_BYTES + tree.bytes


def _near(changes: Changes, box: tuple[int, int, int, int], stride: int) -> Changes:
    """Those of the changes that lie in a box of padded cells, or beside it."""
    rows, cols = np.divmod(changes.cells, stride)
    row0, col0, row1, col1 = box
    near = (rows >= row0 - 1) & (rows <= row1) & (cols >= col0 - 1) & (cols <= col1)
    return Changes(changes.cells[near], changes.before[near], changes.after[near])
