"""The cost-to-go tree of one target over one map: grown, moved by windows, repaired after changes.

`Ground` holds the padded weights of the map, `CostToGoTree` the labels of one root on it. Costs are seconds.
float32 labels: a full growth over a route of n steps is within n * 2**-24 of the exact cost, relatively.

The one invariant that everything rests on: a cell's stored cost is at least what its parent offers. Costs then grow
strictly along every way to the root, so no tree, however it was composed, has a cycle; and every cost plus the
tree's offset is an upper bound of what is driven along the parents.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service import coarse_kernels, kernels
from swarm.config import PlannerConfig
from swarm.grid import GridSpec, Window

Floats = NDArray[np.float32]
Cells = NDArray[np.int64]

MAX_RATIO = 1 << 14
"""Between dearest and cheapest step: beyond it buckets as wide as the cheapest give way to a heap."""
FINE = float(1 << 20)
"""While no cost exceeds so many smallest weights, float32 tells any cell's cost from its parent's."""


@dataclass(frozen=True, eq=False)
class Changes:
    """Cells whose weight changed (padded, no repetition) and what it was before."""

    cells: Cells
    before: Floats
    weight_now: Floats

    @property
    def any_lower(self) -> bool:
        return bool((self.weight_now < self.before).any())


NO_CHANGES = Changes(np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32))


ALL_CELLS = np.empty(0, np.uint8)


def rule_of(config: PlannerConfig) -> int:
    if config.neighbours == 4:
        return kernels.RULE_FOUR
    return kernels.RULE_OCTILE if config.edge == "octile" else kernels.RULE_PAPER


def check_pace(grid: GridSpec, pace: NDArray[np.float32]) -> None:
    """Raises ValueError unless the array is what kernels may be handed. Values are checked as they are read."""
    if not isinstance(pace, np.ndarray) or pace.dtype != np.float32:
        raise ValueError(f"pace must be a float32 array, not {getattr(pace, 'dtype', type(pace).__name__)}")
    if pace.shape != (grid.rows, grid.cols):
        raise ValueError(f"pace has shape {pace.shape}, the grid is {grid.rows} x {grid.cols}")
    if not pace.flags.c_contiguous:
        raise ValueError("pace must be C-contiguous")


class Ground:
    """The weights of a map: what entering each cell costs, s, padded with a lethal border.

    low, high  bounds of the finite weights, not necessarily reached; (inf, 0) if all is lethal
    """

    def __init__(self, grid: GridSpec, config: PlannerConfig) -> None:
        self.grid = grid
        self.config = config
        self.rule = rule_of(config)
        self.corners = config.corner_cutting
        self.stride = grid.cols + 2
        self.size = (grid.rows + 2) * self.stride
        self.diagonal = kernels.SQRT2_EXACT if self.rule == kernels.RULE_OCTILE else 1.0
        self.length_weight_s = config.length_weight * grid.resolution_m
        self.weight: Floats = np.full(self.size, np.inf, np.float32)
        self.low = math.inf
        self.high = 0.0

    def pad(self, cell: int) -> int:
        row, col = divmod(cell, self.grid.cols)
        return (row + 1) * self.stride + col + 1

    def pad_all(self, cells: Cells) -> Cells:
        rows, cols = np.divmod(cells, self.grid.cols)
        padded: Cells = (rows + 1) * self.stride + cols + 1
        return padded

    def unpad(self, padded: int) -> int:
        row, col = divmod(padded, self.stride)
        return (row - 1) * self.grid.cols + col - 1

    def load(self, pace: Floats) -> None:
        """Take the whole map. Raises ValueError on a pace that is NaN, zero or negative."""
        check_pace(self.grid, pace)
        bad = kernels.pad_weights(
            pace,
            np.float32(self.grid.resolution_m),
            np.float32(self.length_weight_s),
            self.stride,
            self.weight,
        )
        if bad:
            raise ValueError(f"{bad} cells have a pace that is NaN, zero or negative; lethal is inf")
        low, high = kernels.weight_range(self.weight)
        self.low, self.high = float(low), float(high)

    def apply(self, pace: Floats, dirty: Sequence[Window]) -> Changes:
        """Take what changed inside the dirty windows. Raises ValueError on a pace that is NaN, zero or negative."""
        check_pace(self.grid, pace)
        found: list[Changes] = []
        for window in dirty:
            row0, col0 = max(window.row0, 0), max(window.col0, 0)
            row1, col1 = min(window.row1, self.grid.rows), min(window.col1, self.grid.cols)
            if row1 <= row0 or col1 <= col0:
                continue
            room = (row1 - row0) * (col1 - col0)
            cells = np.empty(room, np.int64)
            before = np.empty(room, np.float32)
            count, bad = kernels.changed_cells(
                pace,
                np.float32(self.grid.resolution_m),
                np.float32(self.length_weight_s),
                (row0, col0, row1, col1),
                self.stride,
                self.weight,
                cells,
                before,
            )
            if bad:
                raise ValueError(f"{bad} cells have a pace that is NaN, zero or negative; lethal is inf")
            if count:
                found.append(Changes(cells[:count], before[:count], self.weight[cells[:count]]))
        if not found:
            return NO_CHANGES
        changes = found[0]
        if len(found) > 1:
            # A cell in two overlapping windows changes in the first only, so there is no repetition.
            changes = Changes(
                np.concatenate([part.cells for part in found]),
                np.concatenate([part.before for part in found]),
                np.concatenate([part.weight_now for part in found]),
            )
        finite = changes.weight_now[np.isfinite(changes.weight_now)]
        if finite.size:
            self.low = min(self.low, float(finite.min()))
            self.high = max(self.high, float(finite.max()))
        return changes

    def difference(self, older: Floats, dirty: Sequence[Window]) -> Changes:
        """What changed inside the dirty windows since `older` weights."""
        parts: list[Cells] = []
        for window in dirty:
            row0, col0 = max(window.row0, 0), max(window.col0, 0)
            row1, col1 = min(window.row1, self.grid.rows), min(window.col1, self.grid.cols)
            if row1 <= row0 or col1 <= col0:
                continue
            shape = (self.grid.rows + 2, self.stride)
            box = (slice(row0 + 1, row1 + 1), slice(col0 + 1, col1 + 1))
            rows, cols = np.nonzero(self.weight.reshape(shape)[box] != older.reshape(shape)[box])
            parts.append((rows + row0 + 1) * self.stride + cols + col0 + 1)
        if not parts:
            return NO_CHANGES
        cells = np.unique(np.concatenate(parts))
        return Changes(cells, older[cells], self.weight[cells])

    def passable(self, cell: int) -> bool:
        return bool(self.weight[self.pad(cell)] < np.inf)

    def is_step(self, a: int, b: int) -> bool:
        """Whether a vehicle may go from padded cell a to its neighbour b."""
        gap = b - a
        row_step = round(gap / self.stride)
        col_step = gap - row_step * self.stride
        if max(abs(row_step), abs(col_step)) != 1 or not self.weight[a] < np.inf or not self.weight[b] < np.inf:
            return False
        if row_step == 0 or col_step == 0:
            return True
        if self.rule == kernels.RULE_FOUR:
            return False
        corners = self.weight[a + row_step * self.stride], self.weight[a + col_step]
        return self.corners or bool(max(corners) < np.inf)


def flood(
    weight: Floats,
    low: float,
    high: float,
    stride: int,
    root: int,
    rule: int,
    corners: bool,
    cost: Floats,
    parent: NDArray[np.uint8] | None,
    active: NDArray[np.uint8] = ALL_CELLS,
) -> float:
    """Grow the exact tree of a padded root. Returns a bound that no cost exceeds.

    active  cells that take part; the cost of others is without meaning, and so are all parents. inf is returned,
    and
            nothing done, where the weights' ratio is too large for that
    """
    longest = high * (kernels.SQRT2_EXACT if rule == kernels.RULE_OCTILE else 1.0)
    if longest <= min(MAX_RATIO, max(512, weight.size // 16)) * low:
        width = np.float32(low * 0.98)
        ring = 1 << max(2, math.ceil(math.log2(longest / float(width) + 3)))
        shift = 6 if ring <= 64 else 4
        if rule == kernels.RULE_OCTILE:
            last = kernels.flood_octile(weight, active, cost, stride, root, corners, width, ring, shift)
        else:
            diagonals = rule == kernels.RULE_PAPER
            last = kernels.flood_single(weight, active, cost, stride, root, diagonals, corners, width, ring, shift)
        if last != kernels.TOO_FINE:
            if parent is not None:
                rows = weight.size // stride - 2
                kernels.point_to_parents(
                    weight, cost, stride, rule, corners, root, (0, 0, rows, stride - 2), parent
                )
            return float((last + 1) * width)
    if active.size:
        return math.inf
    touched = np.empty(weight.size, np.uint8) if parent is None else parent
    reach = float(kernels.flood_wide(weight, cost, stride, root, rule, corners, touched))
    if parent is not None and reach <= FINE * low:
        box = (0, 0, weight.size // stride - 2, stride - 2)
        kernels.point_to_parents(weight, cost, stride, rule, corners, root, box, parent)
    return reach


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The cells that carry the traffic, connected, and how all others reach them. Padded arrays.

    cells   uint8    1 on the skeleton
    attach  float32  s; what the way to the skeleton costs; inf where there is none
    parent  uint8    direction of that way; 255 on the skeleton
    anchor  uint32   the skeleton cell it leads to
    reach   s; no way there costs more
    """

    cells: NDArray[np.uint8]
    attach: Floats
    parent: NDArray[np.uint8]
    anchor: NDArray[np.uint32]
    reach: float


def find_skeleton(ground: Ground, samples: int = 8) -> Skeleton:
    """Let exact trees of cells all over the ground vote: where many ways pass in one of them is skeleton."""
    grid = ground.grid
    rule, corners, stride = ground.rule, ground.corners, ground.stride
    passable = np.flatnonzero(ground.weight < np.inf)
    roots = passable[np.linspace(0, passable.size - 1, samples).astype(np.int64)]
    roots = np.concatenate((passable[passable.size // 2 :][:1], roots))
    cells = np.zeros(ground.size, np.uint8)
    cost = np.empty(ground.size, np.float32)
    parent = np.full(ground.size, kernels.NONE, np.uint8)
    least = max(16, max(grid.rows, grid.cols) // 8)
    first = int(roots[0])
    flood(ground.weight, ground.low, ground.high, stride, first, rule, corners, cost, parent)
    connected = [int(root) for root in roots[1:] if cost[root] < np.inf]
    cells[first] = 1
    coarse_kernels.mark_traffic(parent, stride, least, cells)
    for root in connected:
        # The way between two roots joins what their trees vote for.
        coarse_kernels.mark_way(parent, stride, root, cells)
    for root in connected:
        flood(ground.weight, ground.low, ground.high, stride, root, rule, corners, cost, parent)
        coarse_kernels.mark_traffic(parent, stride, least, cells)
    chosen = np.flatnonzero(cells)
    attach = np.full(ground.size, np.inf, np.float32)
    attach[chosen] = 0.0
    before = np.full(chosen.size, np.inf, np.float32)
    kernels.lower(ground.weight, attach, stride, rule, corners, chosen, before, ground.size)
    box = (0, 0, grid.rows, grid.cols)
    kernels.point_to_parents(ground.weight, attach, stride, rule, corners, first, box, parent)
    parent[chosen] = kernels.NONE
    anchor = np.zeros(ground.size, np.uint32)
    coarse_kernels.find_anchors(parent, stride, cells, anchor)
    finite = attach[attach < np.inf]
    return Skeleton(cells, attach, parent, anchor, float(finite.max(initial=0.0)))


@dataclass(frozen=True, eq=False)
class Surrounding:
    """What a window around the root cost on its own: a lower bound on every way that stays inside.

    cost   (rows, cols) of the window, s; exact inside it
    rim    padded cells of the window from which a step leads out of it
    """

    window: Window
    cost: Floats
    rim: Cells
    rim_cost: NDArray[np.float64]


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
        self.parent: NDArray[np.uint8] = np.full(ground.size, kernels.NONE, np.uint8)
        self.root = -1
        self.offset = 0.0
        self.exact = False
        self.reach = 0.0
        self.near: Surrounding | None = None
        self._scratch: NDArray[np.uint8] | None = None

    def grow(self, root: int) -> None:
        """Grow the whole tree of a passable cell, exactly."""
        ground = self.ground
        self.reach = flood(
            ground.weight,
            ground.low,
            ground.high,
            ground.stride,
            ground.pad(root),
            ground.rule,
            ground.corners,
            self.cost,
            self.parent,
        )
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

    def grow_coarse(self, root: int, skeleton: Skeleton, window: Window) -> bool:
        """Grow the tree over the skeleton and a window around the root only; all other cells lead to the skeleton.
        False if that cannot be done: then the tree is of no use any more and must be grown."""
        ground = self.ground
        start = ground.pad(root)
        active = skeleton.cells.copy()
        if not skeleton.attach[start] < np.inf:
            return False
        coarse_kernels.mark_way(skeleton.parent, ground.stride, start, active)
        shape = (ground.grid.rows + 2, ground.stride)
        active.reshape(shape)[window.row0 + 1 : window.row1 + 1, window.col0 + 1 : window.col1 + 1] = 1
        rule, corners, stride = ground.rule, ground.corners, ground.stride
        reach = flood(ground.weight, ground.low, ground.high, stride, start, rule, corners, self.cost, None, active)
        if not reach < math.inf:
            return False
        if coarse_kernels.fill_in(self.cost, active, skeleton.attach, skeleton.anchor):
            return False
        box = (0, 0, ground.grid.rows, ground.grid.cols)
        kernels.point_to_parents(ground.weight, self.cost, stride, rule, corners, start, box, self.parent)
        self.root = root
        self.offset = 0.0
        self.near = None
        self.exact = False
        self.reach = reach + skeleton.reach
        return self.fine

    def move(self, root: int, window: Window) -> int:
        """Lead to a new root, by growing only a window that holds it and the old root.

        Returns cells grown, or 0 if nothing was done because the old root has no way to the new one inside the
        window.
        """
        ground = self.ground
        row, col = ground.grid.row_col(root)
        old_row, old_col = ground.grid.row_col(self.root)
        box = (window.row0, window.col0, window.row1, window.col1)
        stride = window.col1 - window.col0 + 2
        part = np.empty((window.row1 - window.row0 + 2) * stride, np.float32)
        kernels.cut_window(ground.weight, ground.stride, box, part)
        cost = np.empty_like(part)
        low, high = kernels.weight_range(part)
        flood(
            part,
            float(low),
            float(high),
            stride,
            (row - window.row0 + 1) * stride + col - window.col0 + 1,
            ground.rule,
            ground.corners,
            cost,
            None,
        )
        way = float(cost[(old_row - window.row0 + 1) * stride + old_col - window.col0 + 1])
        if not way < math.inf:
            return 0
        self.offset += way
        kernels.merge_window(cost, box, np.float32(self.offset), ground.pad(self.root), self.cost, ground.stride)
        grown = Window(
            max(window.row0 - 1, 0),
            max(window.col0 - 1, 0),
            min(window.row1 + 1, ground.grid.rows),
            min(window.col1 + 1, ground.grid.cols),
        )
        kernels.point_to_parents(
            ground.weight,
            self.cost,
            ground.stride,
            ground.rule,
            ground.corners,
            ground.pad(root),
            (grown.row0, grown.col0, grown.row1, grown.col1),
            self.parent,
        )
        self.exact = self.exact and root == self.root
        self.root = root
        self.near = self._surrounding(window, cost.reshape(-1, stride)[1:-1, 1:-1])
        return window.cells

    def _surrounding(self, window: Window, cost: Floats) -> Surrounding:
        grid = self.ground.grid
        on_rim = np.zeros(cost.shape, bool)
        on_rim[0] |= window.row0 > 0
        on_rim[-1] |= window.row1 < grid.rows
        on_rim[:, 0] |= window.col0 > 0
        on_rim[:, -1] |= window.col1 < grid.cols
        rows, cols = np.nonzero(on_rim & (cost < np.inf))
        rim = (rows + window.row0 + 1) * self.ground.stride + cols + window.col0 + 1
        return Surrounding(window, cost, rim, cost[rows, cols].astype(np.float64))

    def repair(self, changes: Changes, limit: int) -> int:
        """Bring the tree up to date after the ground changed. Returns cells visited, or -1 if more than `limit` are
        concerned: then it must be grown again before anything else."""
        if changes.cells.size == 0:
            return 0
        if self._scratch is None:
            self._scratch = np.zeros(self.ground.size, np.uint8)
        ground = self.ground
        visited, highest = kernels.repair(
            ground.weight,
            self.cost,
            self.parent,
            ground.stride,
            ground.rule,
            ground.corners,
            ground.pad(self.root),
            changes.cells,
            changes.before,
            limit,
            self._scratch,
        )
        self.reach = max(self.reach, float(highest))
        return int(visited)

    def relabel(self) -> None:
        """Make every cost what is really driven along the parents."""
        ground = self.ground
        kernels.relabel(ground.weight, self.parent, ground.stride, ground.rule, ground.pad(self.root), self.cost)
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
