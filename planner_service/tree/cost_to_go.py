"""The cost-to-go tree of one target over one map: grown, moved by windows, repaired after changes.

`Ground` holds the padded weights of the map, `CostToGoTree` the labels of one root on it. Costs are seconds.
float32 labels: a full growth over a route of n steps is within n * 2**-24 of the exact cost, relatively.

The one invariant that everything rests on: a cell's stored cost is at least what its parent offers. Costs then grow
strictly along every way to the root, so no tree, however it was composed, has a cycle; and every cost plus the
tree's offset is an upper bound of what is driven along the parents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import corridor_growth, route_walk
from planner_service.kernels.bucket_queue import point_to_parents
from planner_service.kernels.cell_costs import cut_window, find_rim, merge_window
from planner_service.kernels.layout import NONE
from planner_service.kernels.repair import repair
from planner_service.tree.corridors import INNER, Skeleton
from planner_service.tree.cost_grid import Cells, Changes, Ground
from planner_service.tree.growth import FINE, flood
from shared_map.arrays import Floats
from swarm.grid import Window


@dataclass(frozen=True, eq=False)
class Surrounding:
    """What a window around the root cost on its own: a lower bound on every way that stays inside.

    cost      float32  s, of the window as a padded grid of its own; exact inside it
    box       (row0, col0, row1, col1) of the window
    rim       int64    padded cells of the window from which a step leads out of it; rim_cost: float64, s
    """

    cost: Floats
    box: tuple[int, int, int, int]
    rim: Cells
    rim_cost: NDArray[np.float64]


NOWHERE = Surrounding(np.empty(0, np.float32), (0, 0, 0, 0), np.empty(0, np.int64), np.empty(0, np.float64))


class CostToGoTree:
    """The tree of one root on a `Ground`.

    root    the target's cell
    offset  s; a cell's cost-to-go is at most its stored cost plus this
    near    of the last window, as long as it is where the root is; None otherwise
    exact   whether cost-to-go is exact on the ground as it is now (then offset is 0)
    reach   s; no stored cost exceeds it
    """

    def __init__(self, ground: Ground) -> None:
        self.ground = ground
        self.cost: Floats = np.full(ground.size, np.inf, np.float32)
        self.parent: NDArray[np.uint8] = np.full(ground.size, NONE, np.uint8)
        self.root = -1
        self.offset = 0.0
        self.exact = False
        self.reach = 0.0
        self.near: Surrounding | None = None
        self._stamps: NDArray[np.uint8] | None = None
        self._now = 2

    def grow(self, root: int) -> None:
        """Grow the whole tree of a passable cell, exactly."""
        self.reach = self.ground.grow(self.ground.pad(root), self.cost, self.parent)
        self.root = root
        self.offset = 0.0
        self.near = None
        self.exact = True

    def take(self, root: int, cost: Floats, parent: NDArray[np.uint8], reach: float) -> None:
        """Become a tree that somebody else grew, exactly, on the ground as it is now."""
        self.cost = cost
        self.parent = parent
        self.root = root
        self.offset = 0.0
        self.near = None
        self.exact = True
        self.reach = reach

    def grow_rings(self, window: Window, skeleton: Skeleton) -> int:
        """After a window around the root was grown: renew what lies beyond, on the cells of a skeleton only, ring
        by ring of doubling width and four times the traffic. All others keep their parents. Returns cells visited.
        """
        ground = self.ground
        self.exact = False
        found = int(
            corridor_growth.spread(
                ground.weight,
                self.cost,
                self.parent,
                self._stamps_now(),
                self._now,
                skeleton.level,
                ground.stride,
                ground.rule,
                ground.corners,
                ground.pad(self.root),
                (window.row0, window.col0, window.row1, window.col1),
                min(max(window.row1 - window.row0, window.col1 - window.col0), INNER),
            )
        )
        self._stamp()
        return found

    def move(self, root: int, window: Window) -> int:
        """Lead to a new root, by growing only a window that holds it and the old root.

        Returns cells grown, or 0 if nothing was done because the old root has no way to the new one inside the
        window.
        """
        ground = self.ground
        row0, col0, row1, col1 = box = (window.row0, window.col0, window.row1, window.col1)
        width = col1 - col0 + 2
        part = np.empty((row1 - row0 + 2) * width, np.float32)
        low, high = cut_window(ground.weight, ground.stride, box, part)
        cost = np.empty_like(part)
        row, col = ground.grid.row_col(root)
        start = (row - row0 + 1) * width + col - col0 + 1
        flood(part, float(low), float(high), width, start, ground.rule, ground.corners, cost, None)
        row, col = ground.grid.row_col(self.root)
        way = float(cost[(row - row0 + 1) * width + col - col0 + 1])
        if not way < math.inf:
            return 0
        self.offset += way
        merge_window(cost, box, np.float32(self.offset), ground.pad(self.root), self.cost, ground.stride)
        rows, cols = ground.grid.rows, ground.grid.cols
        # A neighbour of a cell that got cheaper may lead there now.
        grown = (max(row0 - 1, 0), max(col0 - 1, 0), min(row1 + 1, rows), min(col1 + 1, cols))
        new_root = ground.pad(root)
        point_to_parents(
            ground.weight, self.cost, ground.stride, ground.rule, ground.corners, new_root, grown, self.parent
        )
        self.exact = self.exact and root == self.root
        self.root = root
        self._stamp()
        rim = np.empty(2 * (row1 - row0 + col1 - col0), np.int64)
        rim_cost = np.empty(rim.size, np.float64)
        many = find_rim(cost, box, rows, ground.stride, rim, rim_cost)
        self.near = Surrounding(cost, box, rim[:many], rim_cost[:many])
        return window.cells

    def repair(self, changes: Changes) -> int:
        """Bring the tree up to date after the ground changed. Returns cells visited, or -1 if so many are concerned
        that a growth costs less: then it must be grown before anything else."""
        if changes.cells.size == 0:
            return 0
        if self.ground.directed:
            return -1
        ground = self.ground
        visited, highest = repair(
            ground.weight,
            self.cost,
            self.parent,
            ground.stride,
            ground.rule,
            ground.corners,
            ground.pad(self.root),
            changes.cells,
            changes.before,
            *ground.buckets,
            _most_repaired(ground.grid.cells),
        )
        self.reach = max(self.reach, float(highest))
        self._stamp()
        return int(visited)

    def tighten(self, cells: Cells) -> None:
        """Make the costs of padded cells, and of all on their ways, what is really driven. A window raises the
        costs beyond it by the most that may be, move after move, until a growth comes by or somebody asks."""
        if self.exact:
            return
        ground = self.ground
        corridor_growth.tighten(
            ground.weight,
            self.cost,
            self.parent,
            self._stamps_now(),
            self._now,
            ground.stride,
            ground.rule,
            ground.pad(self.root),
            cells,
        )

    def _stamps_now(self) -> NDArray[np.uint8]:
        """`_now` or one more where a cost was tightened since ways changed last."""
        if self._stamps is None:
            self._stamps = np.zeros(self.ground.size, np.uint8)
        return self._stamps

    def _stamp(self) -> None:
        """Ways have changed: what was tightened before need not be right any more."""
        self._now += 2
        if self._now > 254:
            self._now = 2
            self._stamps = None

    def relabel(self) -> None:
        """Make every cost what is really driven along the parents."""
        ground = self.ground
        route_walk.relabel(ground.weight, self.parent, ground.stride, ground.rule, ground.pad(self.root), self.cost)
        self.offset = 0.0

    @property
    def fine(self) -> bool:
        """Whether float32 tells every cost from its parent's. If not, only whole growths keep the tree right."""
        return self.reach <= FINE * self.ground.low

    @property
    def precise(self) -> bool:
        """Whether one more window can be merged without losing a cell's cost in the rounding of the offset."""
        return self.fine and self.offset <= FINE / 8 * self.ground.low

    def inner(self, padded: NDArray[np.generic]) -> NDArray[np.generic]:
        """The (rows, cols) view of a padded array."""
        grid = self.ground.grid
        view: NDArray[np.generic] = padded.reshape(grid.rows + 2, self.ground.stride)[1:-1, 1:-1]
        return view


def _most_repaired(cells: int) -> tuple[int, int, int]:
    """How much a repair may do before it gives way to a growth.

    That a cell has lost its way is found in a tenth of the time that mending it takes, which is six times that of
    growing it. So up to an eighth of the map may; and as nobody knows beforehand how far cheaper ways spread, a
    repair that gives up has then cost a fifth of a growth at most.
    """
    return cells // 8 + 64, cells // 24 + 64, cells // 20 + 64
