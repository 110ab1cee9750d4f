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
from typing import NamedTuple

import numpy as np

from planner_service.kernels.layout import NONE, step_offsets
from planner_service.tree.cost_changes import NO_CHANGES, Cells, Changes, joined
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.partial_growth import CutTree, PartialGrowth, Way, way_of, whole_tree
from swarm.wire.route_columns import Route, RouteStatus

MOST_CHANGES = 500
"""Changes near a tree beyond which it is dropped: another growth costs less than to look at them."""
_MOST_ENTRIES = 2000
"""Changes of the map since a tree was looked at, beyond which it is dropped: to sort them out takes 30 ms."""
_LONGEST_LOG = 1 << 16
"""Cells in the log of changes: a tree that would need older ones is dropped."""
_NO_CELLS: Cells = np.empty(0, np.int64)


class GoalAnswer(NamedTuple):
    """A route from a start to a goal, or why there is none.

    route        NO_TARGET while it is not known yet: ask again to continue. Until then its lower bound is the
                 frontier's cost
    lethal_goal  the goal itself is on a lethal cell; the status is UNREACHABLE then
    grown_cells  cells that this ask has grown: 0 if a tree that was kept answered as it was
    """

    route: Route
    lethal_goal: bool = False
    grown_cells: int = 0

    @property
    def grows(self) -> bool:
        """True if the route is not known yet: ask again to continue the search."""
        return self.route.status is RouteStatus.NO_TARGET


_Found = tuple[CutTree, Way | None]
"""A tree, and a route of it; None if it has none from the start, or does not know it yet."""


@dataclass(slots=True)
class _Kept:
    """A tree in the cache.

    tree     as it was cut out; None while it is being grown
    seen     changes of the map that were looked at, in a count of all
    changes  those of them that lie near the tree
    """

    tree: CutTree | None
    seen: int
    changes: Changes = field(default=NO_CHANGES)


class GoalTrees:
    """Trees of goals on the cost map of one vehicle class; used only by the thread that changes the map.

    Parameters
    ----------
    costs : CostGrid
        Its owner calls `changed` after each `apply`.
    budget_bytes : int
        Memory for the kept trees. One more tree is in use, with 20 bytes for each cell that it has grown.
    """

    def __init__(self, costs: CostGrid, budget_bytes: int) -> None:
        self.costs = costs
        self._budget = budget_bytes
        self._growth = PartialGrowth(costs)
        self._offsets = step_offsets(costs.stride).astype(np.int64)
        self._pointed = np.full(costs.size, NONE, np.uint8), np.empty(costs.size, np.uint32)
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
        """Notes changes of the cost map, as `CostGrid.apply` returned them."""
        if not changes.cells.size:
            return
        self._put_down()
        self._growth.learn(changes)
        self._log.append(changes)
        self._logged += changes.cells.size
        while self._logged > _LONGEST_LOG and self._log:
            self._logged -= self._log.pop(0).cells.size
            self._forgotten += 1

    # --- answers ------------------------------------------------------------------------------------------------

    def ask(self, goal: int, start: int, most_cells: int, most_steps: int = 0) -> GoalAnswer:
        """The cheapest route between two cells of the grid. Grows about `most_cells` at most; where growths cannot
        stop (see `PartialGrowth`), a whole tree.

        most_steps  of the route that is given; 0 is the whole route
        """
        grid = self.costs.grid
        if not (0 <= goal < grid.cells and 0 <= start < grid.cells):
            return GoalAnswer(Route(status=RouteStatus.OUTSIDE, start=start))
        root, at = self.costs.pad(goal), self.costs.pad(start)
        if not self.costs.cell_cost[root] < np.inf:
            self._drop(goal)
            return GoalAnswer(Route(status=RouteStatus.UNREACHABLE, start=start), lethal_goal=True)
        if not self.costs.cell_cost[at] < np.inf:
            return GoalAnswer(Route(status=RouteStatus.LETHAL_START, start=start))
        kept = self._up_to_date(goal)
        known: _Found | None = None
        if kept is not None:
            self._kept.move_to_end(goal)
            known = self._known(kept, at, most_steps)
        grown = 0
        if known is None:
            tree, grown = self._grown(goal, kept, root, at, max(most_cells, 1))
            known = self._found(tree, at, most_steps)
        tree, way = known
        if way is not None:
            return GoalAnswer(self._route(tree.at(at, self.costs.stride), start, way, most_steps), False, grown)
        if tree.bound == math.inf:
            return GoalAnswer(Route(status=RouteStatus.UNREACHABLE, start=start), grown_cells=grown)
        frontier_s = tree.bound * (1.0 - 1e-6) * self.costs.time_share
        return GoalAnswer(
            Route(status=RouteStatus.NO_TARGET, start=start, lower_bound_s=frontier_s), grown_cells=grown
        )

    def still_cheapest(self, goal: int, start: int) -> bool:
        """Returns True if the cheapest routes between two cells are known to cost what they did before the last
        changes. Nothing is grown, and the cache keeps its order."""
        kept = self._up_to_date(goal)
        return kept is not None and self._known(kept, self.costs.pad(start), 0) is not None

    def _up_to_date(self, goal: int) -> _Kept | None:
        """The tree of a goal with the changes near it since it was asked last; None, and dropped, if those are too
        many."""
        kept = self._kept.get(goal)
        if kept is None:
            return None
        first = kept.seen - self._forgotten
        kept.seen = self._forgotten + len(self._log)
        known = first >= 0 and len(self._log) - first <= _MOST_ENTRIES
        if known and kept.tree is not None and first < len(self._log):
            near = [_near(each, kept.tree.box, self.costs.stride) for each in self._log[first:]]
            kept.changes = joined([kept.changes, *near])
        if not known or kept.changes.cells.size > MOST_CHANGES:
            self._drop(goal)
            return None
        return kept

    def _known(self, kept: _Kept, start: int, most: int) -> _Found | None:
        """The answer of a tree as it is; None if it must grow for that."""
        tree = self._held if kept.tree is None else kept.tree
        cost = tree.at(start, self.costs.stride)
        if not kept.changes.cells.size:
            return self._found(tree, start, most) if cost < math.inf or tree.bound == math.inf else None
        if cost == math.inf:
            return None
        way = self._as_it_was(kept.changes, tree, start, most)
        level, stands = self._growth.stays(tree, kept.changes, self._cells(start, way))
        return (tree, way) if stands or cost < level * (1.0 - 1e-6) else None

    def _found(self, tree: CutTree, start: int, most: int) -> _Found:
        """The answer of a tree of the present map."""
        has_way = tree.at(start, self.costs.stride) < math.inf
        return tree, way_of(self.costs, tree, start, most, self._pointed) if has_way else None

    @property
    def _held(self) -> CutTree:
        """The tree that is being grown, as a view of it."""
        growth, costs = self._growth, self.costs
        whole = growth.cost.reshape(-1, costs.stride)
        return CutTree(growth.root, costs.padded_box, whole, growth.bound, 0.0)

    def _as_it_was(self, changes: Changes, tree: CutTree, start: int, most: int) -> Way:
        """A route on the map on which the tree was grown."""
        costs, cells = self.costs.cell_cost, changes.cells
        now = costs[cells]
        costs[cells[::-1]] = changes.before[::-1]  # of a cell that changed twice, its first cost stays
        try:
            return way_of(self.costs, tree, start, most, self._pointed)
        finally:
            costs[cells] = now

    def _grown(self, goal: int, kept: _Kept | None, root: int, start: int, most: int) -> tuple[CutTree, int]:
        """Grows the tree until it has a cost for the start. Returns the cells grown, too."""
        growth = self._growth
        if not growth.usable:
            return self._grown_whole(goal, root)
        if kept is None or (kept.tree is not None and kept.tree.parent is not None):
            self._drop(goal)
            self._put_down()
            growth.begin(root)
            kept = self._kept[goal] = _Kept(None, self._forgotten + len(self._log))
        elif kept.tree is not None:
            tree, changes, level = kept.tree, kept.changes, math.inf
            self.bytes -= tree.bytes
            kept.tree, kept.changes = None, NO_CHANGES
            self._put_down()
            if changes.cells.size:
                level, _ = growth.stays(tree, changes, _NO_CELLS)
            growth.resume(tree, level)
        self._in_hand = kept
        cells = growth.go_on(np.array((start,)), most)
        if cells < 0:
            return self._grown_whole(goal, root)
        return self._held, cells

    def _grown_whole(self, goal: int, root: int) -> tuple[CutTree, int]:
        self._drop(goal)
        tree = whole_tree(self.costs, root)
        self._kept[goal] = _Kept(tree, self._forgotten + len(self._log))
        self.bytes += tree.bytes
        self._evict()
        return tree, self.costs.grid.cells

    def _route(self, cost: float, start: int, way: Way, most: int) -> Route:
        costs = self.costs
        bound = cost * (1.0 - 2.0 * float(costs.rounding.at(np.float64(cost)))) * costs.time_share
        return Route(
            status=RouteStatus.OK,
            start=start,
            directions=way.directions[: most or way.directions.size].tobytes(),
            cost_s=way.driven_s,
            lower_bound_s=min(max(bound, 0.0), way.driven_s),
            length_m=way.length_m,
            remaining_s=way.rest_s,
        )

    def _cells(self, start: int, way: Way) -> Cells:
        """The padded cells passed from a start along a route."""
        cells = np.empty(way.directions.size + 1, np.int64)
        cells[0] = start
        np.cumsum(self._offsets[way.directions], out=cells[1:])
        cells[1:] += start
        return cells

    # --- the cache ----------------------------------------------------------------------------------------------

    def _put_down(self) -> None:
        """The tree in hand becomes one of those that are kept."""
        kept, self._in_hand = self._in_hand, None
        if kept is not None and self._growth.root >= 0:
            kept.tree = self._growth.cut()
            self.bytes += kept.tree.bytes
            self._evict()

    def _drop(self, goal: int) -> None:
        kept = self._kept.pop(goal, None)
        if kept is None:
            return
        if kept is self._in_hand:
            self._in_hand = None
            self._growth.forget()
        if kept.tree is not None:
            self.bytes -= kept.tree.bytes

    def _evict(self) -> None:
        """Drops trees, the one with the oldest ask first, until the budget holds."""
        while self.bytes > self._budget:
            self._drop(next(goal for goal, kept in self._kept.items() if kept.tree is not None))


def _near(changes: Changes, box: tuple[int, int, int, int], stride: int) -> Changes:
    """Those of the changes that lie in a box of padded cells."""
    rows, cols = np.divmod(changes.cells, stride)
    row0, col0, row1, col1 = box
    near = (rows >= row0) & (rows < row1) & (cols >= col0) & (cols < col1)
    return Changes(changes.cells[near], changes.before[near], changes.after[near])
