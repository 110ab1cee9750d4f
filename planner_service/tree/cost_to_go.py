"""The cost-to-go tree of one target over one map: grown, moved by windows, repaired after changes.

`CostGrid` holds the padded cell costs of the map, `CostToGoTree` the labels of one root on it. Costs are seconds.
float32 labels: a full growth over a route of n steps is within n * 2**-24 of the exact cost, relatively.

The one invariant that everything rests on: a cell's stored cost is at least what its parent offers. Costs then grow
strictly along every path to the root, so no tree, however it was composed, has a cycle; and every cost plus the
tree's offset is an upper bound of the cost driven along the parents.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import stride_networks
from planner_service.kernels.cell_costs import cut_window, find_rim, merge_window
from planner_service.kernels.climbs import climbs_in
from planner_service.kernels.layout import NONE, Labels, PaddedGrid, step_offsets
from planner_service.kernels.lower_bounds import WindowBound
from planner_service.kernels.parents_from_costs import point_to_parents
from planner_service.kernels.policy_iteration import Walk, make_walk, mend
from planner_service.kernels.repair import repair
from planner_service.kernels.route_kernels import point_routes
from planner_service.kernels.stride_networks import StrideNetwork
from planner_service.tree.cost_changes import Cells, Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.partial_growth import PartialGrowth
from planner_service.tree.queue_choice import FINE, KeptScratch, grow_tree
from shared_map.array_files import Floats
from swarm.errors import OutsideGridError
from swarm.grid import Window

NO_WINDOW: WindowBound = (np.empty(0, np.float32), (0, 0, 0, 0), np.empty(0, np.int64), np.empty(0, np.float64))

MOST_SPREAD_SHARE = 48
"""In a repair, a fall in cost spreads over at most 1/48 of the cells: a spread costs ten times an evaluation. If
more cells change, whole branches have moved, and their trees are evaluated first."""


class CostToGoTree:
    """The tree of one root on a `CostGrid`."""

    def __init__(self, cost_grid: CostGrid) -> None:
        self.cost_grid = cost_grid
        """The map that the tree lies on. A caller that changes it calls `repair`, or rebuilds the tree."""
        self.cost: Floats = np.empty(0, np.float32)
        """float32, padded, s: a cell's cost-to-go is at most this plus `offset`; inf where there is no path. In a
        tree that is not whole, WALL where a cell is lethal. Empty before the first growth. `grow` and `take` set
        it, `move`, `mend`, `grow_strides`, `tighten` and `repair` change it."""
        self.parent: NDArray[np.uint8] = np.empty(0, np.uint8)
        """uint8, padded: direction of each cell's next cell; NONE at the root and where there is no path."""
        self.root = -1
        """The target's cell, of the grid; -1 before the first growth. `grow`, `take` and `move` set it."""
        self.offset = 0.0
        """s; how much the stored costs lack at most. `move` adds the cost from the old root to the new one; `grow`,
        `take` and `mend` reset it."""
        self.exact = False
        """True if cost-to-go is exact on the current map (then the offset is 0). `grow`, `take` and `mend` set it,
        `move` to another root and `grow_strides` reset it, `repair` keeps it."""
        self.reach = 0.0
        """s; no stored cost exceeds it. A growth sets it, a repair may raise it."""
        self.bound = math.inf
        """s; a cell without a cost has no path, or costs at least this. inf for a whole tree: then it has no path.
        Only `take_grown` makes a tree that is not whole, which is exact; it can be read where `point` was called,
        and be grown again."""
        self._pointed, self._parents = np.empty(0, np.uint32), 0
        """Scratch: the padded cells which `point` gave a parent, and how many."""
        self.window_bound: WindowBound | None = None
        """Bound proven by the last window, as long as its root is the tree's. `move` sets it, a growth resets it,
        and so does the owner (to None) when a cell gets cheaper, as it is a lower bound."""
        self._kept: KeptScratch = {}
        """Scratch of the last small window."""
        self._walk: Walk | None = None
        """Scratch of `mend`. None until needed."""
        self._stamps: NDArray[np.uint8] | None = None
        """uint8, padded: `_now` where a cost was recomputed since paths changed last. None until
        needed."""
        self._now = 1
        """Raised whenever paths change, so that all stamps are old; starts again with new stamps at 255."""

    def grow(self, root: int) -> None:
        """Grows the whole tree of a cell, exactly. Raises OutsideGridError if it is none of the grid, ValueError if
        it is lethal."""
        self.cost_grid.check_root(root)
        if not self.cost.size or self.bound < math.inf:
            self.cost = np.empty(self.cost_grid.size, np.float32)
            self.parent = np.full(self.cost_grid.size, NONE, np.uint8)
        self.reach = self.cost_grid.grow(self.cost_grid.pad(root), self.cost, self.parent)
        self._become_exact(root)

    def take(self, root: int, cost: Floats, parent: NDArray[np.uint8], reach: float) -> None:
        """Becomes a tree that was searched elsewhere, exactly, on the map as it was or is now. Raises as `grow`,
        except that the root may have become lethal since."""
        self.cost_grid.grid.row_col(root)
        self.cost = cost
        self.parent = parent
        self.reach = reach
        self._become_exact(root)

    def take_grown(self, root: int, growth: PartialGrowth) -> None:
        """Becomes the tree in hand of a growth that has stopped, exact as far as that went: its costs are a view of
        the growth's, and its parents are left to `point`, unless it is whole."""
        grid = self.cost_grid
        if not self.parent.size or self.bound == math.inf:
            self.parent = np.full(grid.size, NONE, np.uint8)
            self._pointed = np.empty(grid.size, np.uint32)
        else:
            self.parent[self._pointed[: self._parents]] = NONE
        self.cost, self._parents = growth.cost, 0
        if growth.bound == math.inf:
            self.cost, whole = np.abs(growth.cost), (0, 0, grid.grid.rows, grid.grid.cols)
            point_to_parents(grid.padded, grid.climbs, self.cost, growth.root, whole, self.parent)
        self.reach = growth.reach
        self._ways_changed()
        self._become_exact(root)
        self.bound = growth.bound

    def point(self, starts: Cells) -> None:
        """Finds the parents along the routes from padded, passable cells of a tree that is not whole: from those
        which have a cost. The work follows the length of the routes, not the size of the tree."""
        grid, pointed = self.cost_grid, (self._pointed, self._parents)
        labels = self.cost, grid.pad(self.root), starts, self.parent
        self._parents = point_routes(grid.padded, grid.padded_box, *labels, *pointed)

    def merge_grown(self, growth: PartialGrowth) -> Window:
        """Lowers the costs to those of a growth from the same root that has stopped, whose cells become exact.
        Returns the window that holds them. Raises ValueError unless the tree is `precise`."""
        if not self.precise:
            raise ValueError("costs are too large for float32 to tell parents by: grow the tree")
        grid, grown = self.cost_grid, growth.cut()
        row0, col0, row1, col1 = grown.box
        part, box = np.abs(grown.cost).reshape(-1), (row0, col0, row1 - 2, col1 - 2)
        merge_window(part, box, self.offset, grown.root, self.cost, grid.stride)
        around = (max(row0 - 1, 0), max(col0 - 1, 0), min(row1 - 1, grid.grid.rows), min(col1 - 1, grid.grid.cols))
        point_to_parents(grid.padded, grid.climbs, self.cost, grown.root, around, self.parent)
        self._ways_changed()
        # No cell beyond costs less than the growth's bound. The border, of which a heuristic knows nothing, is the
        # rim by which all of them come in.
        rim = growth.bound if growth.bound < math.inf else self.reach + self.offset
        self.window_bound = (part, box, np.zeros(1, np.int64), np.array((rim,)))
        return Window(*box)

    def _become_exact(self, root: int) -> None:
        self.root = root
        self.bound = math.inf
        self.offset = 0.0
        self.window_bound = None
        self.exact = True

    @property
    def _labels(self) -> Labels:
        """For kernels. Raises ValueError where there is no tree yet."""
        if self.root < 0:
            raise ValueError("the tree has no root: grow it first")
        return self.cost, self.parent, self.cost_grid.pad(self.root)

    def grow_strides(self, window: Window, network: StrideNetwork, far: int) -> int:
        """Renews the costs beyond a window that was grown around the root, on the paths of ever wider strides only.
        All other cells keep their parents.

        far  cells; how far from the root
        The least stride is for distances up to twice as far as the window reaches, the next for twice that, and so
        on. Returns cells visited. Raises OutsideGridError on a window that is not inside the grid.
        """
        grid = self.cost_grid
        box = box_of(grid, window)
        row, col = divmod(self.root, grid.grid.cols)
        half = max(row - box[0], col - box[1], box[2] - 1 - row, box[3] - 1 - col)
        scratch = stride_networks.make_scratch(network.centre.size, grid.size)
        stamps = self._stamps_now(), self._now
        visited: int = stride_networks.grow_strides(
            *(grid.padded, grid.climbs, self._labels, tuple(network), stamps, box, (2 * half, far), scratch)
        )
        self.exact = False
        self._ways_changed()
        return visited

    def move(self, root: int, window: Window) -> int:
        """Leads to a new root, by growing only a window that holds it and the old root.

        Costs outside become upper bounds: the old ones plus the cost from the old root to the new. Returns cells
        grown, or 0 if nothing was done because the old root has no path to the new one inside the window. Raises as
        `grow`, and OutsideGridError on a window that is not inside the grid or does not hold both roots.
        """
        grid = self.cost_grid
        if self.root < 0:
            raise ValueError("the tree has no root: grow it first")
        grid.check_root(root)
        if not self.cost[grid.pad(root)] < math.inf:
            # A step that is too steep may be one-way: a cell with a path to the new root may have none to the old
            # one, and be left without.
            return 0
        box, cost, _, way = grow_window(grid, root, self.root, window, self._kept, False)
        if not (way < math.inf and self.offset + way <= FINE * grid.lowest_cell_cost):
            return 0
        self.offset += way
        merge_window(cost, box, self.offset, grid.pad(self.root), self.cost, grid.stride)
        rows, cols = grid.grid.rows, grid.grid.cols
        row0, col0, row1, col1 = box
        # A neighbour of a cell that got cheaper may lead there now.
        around = (max(row0 - 1, 0), max(col0 - 1, 0), min(row1 + 1, rows), min(col1 + 1, cols))
        new_root = grid.pad(root)
        point_to_parents(grid.padded, grid.climbs, self.cost, new_root, around, self.parent)
        self.exact = self.exact and root == self.root
        self.root = root
        self._ways_changed()
        rim = np.empty(2 * (row1 - row0 + col1 - col0), np.int64)
        rim_cost = np.empty(rim.size, np.float64)
        many = find_rim(cost, box, rows, grid.stride, rim, rim_cost)
        self.window_bound = (cost, box, rim[:many], rim_cost[:many])
        return window.cells

    def repair(self, changes: Changes) -> int:
        """Brings the tree up to date after the map changed. Returns cells visited, or -1 if the change is so large
        that a full search costs less: then it must be searched before any other use."""
        if changes.cells.size == 0:
            return 0
        grid = self.cost_grid
        most = _most_repaired(grid.grid.cells)
        visited, highest = repair(
            *(grid.padded, grid.climbs, self._labels, changes.cells, changes.before),
            *(grid.buckets, most, grid.repair_scratch),
        )
        self.reach = max(self.reach, float(highest))
        self._ways_changed()
        return int(visited)

    def mend(self) -> int:
        """Makes the tree exact by the parents that it has, after whatever windows, moves and repairs.

        It equals one grown from scratch then, in costs and parents, bit for bit. Returns cells visited. `exact`
        tells whether it worked: if not, to grow the tree takes less time. Either way the offset is 0. Raises
        ValueError unless the tree is `fine`.
        """
        labels = self._labels
        if not self.fine:
            raise ValueError("costs are too large for float32 to tell parents by: grow the tree")
        grid = self.cost_grid
        if self._walk is None:
            self._walk = make_walk(grid.size, grid.stride, grid.rule)
        farthest, most = FINE * grid.lowest_cell_cost, grid.grid.cells // MOST_SPREAD_SHARE + 64
        visited, highest, exact = mend(
            *(grid.padded, grid.climbs, labels, grid.buckets),
            *(farthest, most, grid.repair_scratch, self._walk),
        )
        self.reach = float(highest)
        self._ways_changed()
        self._become_exact(self.root)
        self.exact = bool(exact)
        return int(visited)

    def cost_at(self, cells: Cells) -> NDArray[np.float64]:
        """float64, s: what it costs to go from padded cells along the parents, length's price with it; inf where
        there is no path. Raises ValueError where one is no padded cell.

        With `time_at` the one way to ask a tree what a cell costs: labels are upper bounds, rounded to float32.
        """
        return self._driven(cells, self.cost_grid.cell_cost)

    def time_at(self, cells: Cells) -> NDArray[np.float64]:
        """float64, s: how long it takes to drive from padded cells along the parents. Otherwise as `cost_at`."""
        return self._driven(cells, self.cost_grid.time_cost)

    def _driven(self, cells: Cells, cell_cost: Floats) -> NDArray[np.float64]:
        _, parent, root = self._labels
        return self.cost_grid.rests(parent, root, cells, cell_cost)

    @property
    def slack(self) -> tuple[float, float]:
        """Returns the bound on the relative excess of a driven cost in an exact tree over the optimum: a constant,
        and a factor on the cost grid's `Rounding`; together at most 1."""
        return 0.0, 2.0

    def tighten(self, cells: Cells) -> None:
        """Lowers the costs of padded cells, and of all on their paths, to those driven along the parents.

        A window raises the costs beyond it by the largest possible amount, move after move, until a full search or
        this call: later windows then leave good cells alone. Raises ValueError where one is no padded cell.
        """
        if not self.exact:
            grid = self.cost_grid
            stamps = self._stamps_now()
            ways = grid.padded, grid.climbs, self._labels
            trail = np.empty(grid.size, np.uint32)  # which holds the longest way
            stride_networks.tighten(*ways, stamps, self._now, cells, trail)

    def _stamps_now(self) -> NDArray[np.uint8]:
        if self._stamps is None:
            self._stamps = np.zeros(self.cost_grid.size, np.uint8)
        return self._stamps

    def _ways_changed(self) -> None:
        """Tightened costs may be wrong from now on."""
        self._now += 2
        if self._now > 254:
            self._now = 1
            self._stamps = None

    @property
    def fine(self) -> bool:
        """True if float32 distinguishes every cost from its parent's. If not, only whole growths keep the tree
        right."""
        return self.reach <= FINE * self.cost_grid.lowest_cell_cost

    @property
    def precise(self) -> bool:
        """True if one more window can be merged without losing a cell's cost in the rounding of the offset."""
        return self.fine and self.offset <= FINE / 8 * self.cost_grid.lowest_cell_cost


def _most_repaired(cells: int) -> tuple[int, int, int]:
    """Returns the largest extent of a repair before it gives way to a full search.

    Detecting that a cell has lost its path takes a tenth of the time of repairing it, which is six times that of
    searching it. Up to an eighth of the map may therefore be repaired; the spread of lower-cost paths is unknown
    beforehand, so a repair that gives up has then cost a fifth of a full search at most.
    """
    return cells // 8 + 64, cells // 24 + 64, cells // 20 + 64


Box = tuple[int, int, int, int]

_SMALL = 1 << 16
"""Padded cells of a small window, whose scratch is worth keeping."""


def grow_window(
    grid: CostGrid, root: int, old: int, window: Window, kept: KeptScratch, with_parents: bool
) -> tuple[Box, Floats, NDArray[np.uint8] | None, float]:
    """Grows a window that holds the new root and the old one. Raises OutsideGridError where it is not inside the
    grid or does not hold both.

    kept  scratch of the last window of one tree
    Returns its box; costs (s) and parents, as a padded grid of its own; and the cost, s, from the old root to the
    new one inside it, inf if no path exists.
    """
    row0, col0, row1, col1 = box = box_of(grid, window)
    width = col1 - col0 + 2
    start, end = _in_window(grid, root, window), _in_window(grid, old, window)
    part = np.empty((row1 - row0 + 2) * width, np.float32)
    bits = cut_window(grid.cell_cost.view(np.int32), grid.stride, box, part.view(np.int32))
    lowest, highest = np.array(bits, np.int32).view(np.float32).tolist()
    cost = np.empty_like(part)
    parent = np.full(part.size, NONE, np.uint8) if with_parents else None
    padded: PaddedGrid = part, step_offsets(width), width, grid.rule, grid.corners
    climbs = None if grid.climbs is None else climbs_in(grid.climbs, grid.stride, box)
    scratch = kept if part.size <= _SMALL else None
    grow_tree(padded, climbs, (lowest, highest, grid.dearest_step), start, cost, parent, scratch)
    return box, cost, parent, float(cost[end])


def box_of(grid: CostGrid, window: Window) -> Box:
    """For kernels. Raises OutsideGridError on a window that is not inside the grid."""
    row0, col0, row1, col1 = window.row0, window.col0, window.row1, window.col1
    if not (0 <= row0 < row1 <= grid.grid.rows and 0 <= col0 < col1 <= grid.grid.cols):
        raise OutsideGridError(f"{window} is not inside the grid")
    return row0, col0, row1, col1


def _in_window(grid: CostGrid, cell: int, window: Window) -> int:
    """A cell's index in the window as a padded grid of its own. Raises OutsideGridError if it lies outside."""
    row, col = grid.grid.row_col(cell)
    if not window.contains(row, col):
        raise OutsideGridError(f"cell {cell} is not in {window}")
    return (row - window.row0 + 1) * (window.col1 - window.col0 + 2) + col - window.col0 + 1
