"""The cell costs of a map as the kernels want them, and what changed in them."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels import cell_costs as kernels
from planner_service.kernels import layout, repair, route_kernels
from planner_service.kernels.climbs import Climbs, row_scratch, with_scratch
from planner_service.tree.cost_changes import NO_CHANGES, Cells, Changes, CostRange, Rounding, joined
from planner_service.tree.queue_choice import grow_tree
from shared_map.array_files import Bools, Floats, private_copy
from shared_map.terrain.slope_and_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.errors import ArgumentError
from swarm.grid import GridSpec, Window


def check_pace(grid: GridSpec, pace: NDArray[np.float32]) -> None:
    """Raises ValueError unless the array is what kernels may be handed. Values are checked as they are read."""
    if not isinstance(pace, np.ndarray) or pace.dtype != np.float32:
        raise ValueError(f"pace must be a float32 array, not {getattr(pace, 'dtype', type(pace).__name__)}")
    if pace.shape != (grid.rows, grid.cols):
        raise ValueError(f"pace has shape {pace.shape}, the grid is {grid.rows} x {grid.cols}")
    if not pace.flags.c_contiguous:
        raise ValueError("pace must be C-contiguous")


def bad_pace_text(pace: Floats, window: Window) -> str:
    """Returns the sentence about the first cell of a window with an invalid pace."""
    part = pace[window.row0 : window.row1, window.col0 : window.col1]
    bad = np.argwhere(~(part > 0))
    row, col = (bad[0] + (window.row0, window.col0)).tolist()
    return (
        f"the pace of cell [{row}, {col}] is {pace[row, col]:g} s/m ({len(bad)} cells have one that is NaN, zero or"
        " negative); expected a number above 0, or inf where a cell is lethal"
    )


log = logging.getLogger(__name__)

NO_COSTS: Floats = np.empty(0, np.float32)
_NO_STATUSES: NDArray[np.uint8] = np.empty(0, np.uint8)


def rule_of(config: PlannerConfig) -> int:
    if config.neighbours == 4:
        return layout.RULE_FOUR
    return layout.RULE_OCTILE if config.edge == "octile" else layout.RULE_PAPER


_SHORTEST_M, _LONGEST_M = 1e-30, 1e30
"""Sides of cells that float32 knows."""
NEAR_CELLS = 256
"""Rows and columns about a cell within which the nearest open one is looked for: some milliseconds."""
_BLOCK = 1 << 10
"""Cells that are copied at a time: a page of memory."""
_FEWEST, _MOST = 1 << 9, 1 << 14
"""Buckets of a repair."""
_BAND = 1 << 8
"""Rows of a map that are taken in at a time."""
_SMALL = 1 << 20
"""Padded cells of a small map."""


class Walks(NamedTuple):
    """Routes read off a tree, as `kernels.route_kernels` describes them."""

    directions: NDArray[np.uint8]
    ends: Cells
    driven: NDArray[np.float64]
    length: NDArray[np.float64]
    last: Cells


class CostGrid:
    """Cost of entering each cell of a map, padded with a lethal border."""

    def __init__(self, grid: GridSpec, config: PlannerConfig, climb: Climb | None = None) -> None:
        self.grid = grid
        self.config = config
        self.rule = rule_of(config)
        """Rule of the allowed steps: RULE_FOUR, RULE_PAPER or RULE_OCTILE."""
        self.corners = config.corner_cutting
        """True if a diagonal step may pass a lethal cell."""
        self.stride = grid.cols + 2
        """Cells of a padded row."""
        self.size = (grid.rows + 2) * self.stride
        """Cells of a padded array."""
        self.diagonal = layout.SQRT2_EXACT if self.rule == layout.RULE_OCTILE else 1.0
        """Length of a diagonal step in straight ones."""
        self.climbs: Climbs | None = None
        """Effect of a step's rise on its cost, for kernels; None if entering a cell costs the same from every side.
        If not, a cell's cost is that of the cheapest straight step into it."""
        self.dearest_step = self.diagonal
        """Highest cost of a step, in cell costs."""
        self.metres = grid.resolution_m
        """m; a straight step into a cell takes its pace times this."""
        if climb is not None:
            self.climbs, self.dearest_step = _padded_climbs(climb, self.rule)
            self.metres *= climb.lowest
        self.length_weight_s = min(config.length_weight * grid.resolution_m, float(kernels.DEAREST_S))
        """s; what a cell's length costs beside the time. It is part of every cell cost."""
        # With climbs, a step's factor would hold for the price of its length, too.
        most = 0 if climb else np.inf
        if not (_SHORTEST_M <= self.metres <= _LONGEST_M and 0 <= config.length_weight <= most):
            raise ArgumentError(
                f"resolution_m is {grid.resolution_m:g}, planner.length_weight {config.length_weight:g}; expected"
                f" {_SHORTEST_M:g} to {_LONGEST_M:g} and 0 or more, with climbs 0"
            )
        self.cell_cost: Floats = NO_COSTS
        """float32 (size,), s: price of a straight step into each cell; inf is lethal, as is the border. Empty
        before `load` or `share`; `apply` writes it, in place."""
        self.rounding = Rounding.of(NO_COSTS)
        """Rounding of labels of trees on this map. `load`, `share` and `apply` put another in its place."""
        self._time_cost: Floats | None = None
        """Same as `time_cost`, if that is an array of its own. `load` and `share` set it, `apply` writes it."""
        self._range = self._time_range = CostRange(NO_COSTS)
        """Range of `cell_cost` and of `_time_cost`. `load`, `share` and `apply` put others in their place."""
        self._offsets = layout.step_offsets(self.stride)
        self._shared: Floats | None = None
        """The original `cell_cost`, if that is mapped: `share` sets it, `load` resets it."""
        self._written: Bools = np.zeros(self.size // _BLOCK + 1, np.bool_)
        """Blocks of `_BLOCK` cells in which a cell cost has changed since `share`. `apply` sets it."""
        self._moves = route_kernels.moves_of(self.stride, self.rule)
        self._make_scratch()

    def _make_scratch(self) -> None:
        """Makes scratch arrays for kernels: one thread's."""
        self._directions: NDArray[np.uint8] = np.empty(1 << 12, np.uint8)
        """Scratch of `walk`, which makes it longer where routes are."""
        self._trail: tuple[NDArray[np.uint32], NDArray[np.float64]] | None = None
        """Scratch of `rests`, which makes it. It reserves all cells; memory is used only where routes need it."""
        self._repair_scratch: repair.Scratch | None = None
        """Made by the first repair of a small map."""
        if self.climbs is not None:
            self.climbs = with_scratch(self.climbs)

    @property
    def padded(self) -> layout.PaddedGrid:
        """The same for kernels."""
        return self.cell_cost, self._offsets, self.stride, self.rule, self.corners

    @property
    def padded_box(self) -> tuple[int, int, int, int]:
        """All padded rows and columns."""
        return 0, 0, self.grid.rows + 2, self.stride

    @property
    def lowest_cell_cost(self) -> float:
        """s; inf if all is lethal."""
        return self._range.lowest

    @property
    def highest_cell_cost(self) -> float:
        """s; the highest finite cell cost, 0 if all is lethal."""
        return self._range.highest

    @property
    def buckets(self) -> layout.Buckets:
        """Buckets of a repair: as wide as the lowest cell cost, and enough for costs at most a step higher."""
        longest = self.highest_cell_cost * self.dearest_step
        count = math.ceil(longest / self.lowest_cell_cost) + 2
        return self.lowest_cell_cost, min(max(count, _FEWEST), _MOST)

    @property
    def repair_scratch(self) -> repair.Scratch:
        """Room for a repair. Kept where it is small: there, to get new pages takes longer than many a repair."""
        if self._repair_scratch is not None:
            return self._repair_scratch
        scratch = repair.make_scratch(self.size, self.stride, _MOST)
        if self.size <= _SMALL:
            self._repair_scratch = scratch
        return scratch

    def check_root(self, cell: int) -> None:
        """Raises OutsideGridError if the cell is not in the grid, because kernels check no index. Raises ValueError
        if it is lethal, because no tree leads there."""
        if not self.passable(cell):
            raise ValueError(f"cell {cell} is lethal: no tree can lead there")

    def pad(self, cell: int) -> int:
        """The padded cell of a cell of the grid."""
        row, col = divmod(cell, self.grid.cols)
        return (row + 1) * self.stride + col + 1

    def pad_all(self, cells: Cells) -> Cells:
        rows, cols = np.divmod(cells, self.grid.cols)
        padded: Cells = (rows + 1) * self.stride + cols + 1
        return padded

    def load(self, pace: Floats) -> None:
        """Takes the whole map. Raises ValueError on a pace that is NaN, zero or negative; the grid is then as it
        was.

        A cell costs between `CHEAPEST_S` and `DEAREST_S`, whatever its pace is; the log says where that holds.
        """
        check_pace(self.grid, pace)
        if not (pace > 0).all():
            raise ValueError(bad_pace_text(pace, self.grid.window))
        cell_cost = self._padded(pace, self.length_weight_s)
        bounded = sum(np.count_nonzero(cell_cost == each) for each in (kernels.CHEAPEST_S, kernels.DEAREST_S))
        if bounded:
            log.warning(
                "%d of %d cells cost %.2g s or %.2g s, the least and the most that a cell can cost",
                *(bounded, self.grid.cells, kernels.CHEAPEST_S, kernels.DEAREST_S),
            )
        self._shared = None
        self.cell_cost = cell_cost
        if self.length_weight_s:
            self._time_cost = self._padded(pace, 0.0)
        self._find_range()
        self.rounding = Rounding.of(self.cell_cost)

    def _padded(self, pace: Floats, extra_s: float) -> Floats:
        costs: Floats = np.full(self.size, np.inf, np.float32)
        for row in range(0, self.grid.rows, _BAND):  # in parts: all changes of a large map are much memory
            self._taken(pace, (row, 0, min(row + _BAND, self.grid.rows), self.grid.cols), extra_s, costs)
        return costs

    @property
    def time_cost(self) -> Floats:
        """float32 (size,), s: what a straight step into each cell takes; `cell_cost` itself where length costs
        nothing. With such a price, a route's time cannot be derived from `cell_cost`: the price of its length may
        have rounded it away."""
        return self.cell_cost if self._time_cost is None else self._time_cost

    @property
    def time_share(self) -> float:
        """Least share of time in any route's cost: that of the lowest cell, less the rounding of float32 in both of
        its costs."""
        if not self.length_weight_s:
            return 1.0
        lowest = self._time_range.lowest
        return lowest / (lowest + self.length_weight_s) * (1.0 - 2.0**-22)

    def share(self, time_cost: Floats) -> None:
        """Takes the `time_cost` that another cost grid of the same map and `metres` has loaded, from `open_array`.
        Cells changed by `apply` are this grid's own. Raises ValueError unless they are of this grid, and such as
        `load` makes."""
        if time_cost.shape != (self.size,) or time_cost.dtype != np.float32:
            raise ValueError(f"cell costs of this map are float32, {self.size} cells")
        own = private_copy(time_cost)  # kernels know arrays that may be written only
        found = CostRange(own)
        lowest, highest, last = found.lowest, found.highest, found.last
        if not (lowest >= kernels.CHEAPEST_S and highest <= kernels.DEAREST_S and last <= math.inf):
            raise ValueError(
                f"cell costs lie between {kernels.CHEAPEST_S:.2g} s and {kernels.DEAREST_S:.2g} s or are inf; these"
                f" lie between {lowest:.2g} s and {last:.2g} s"
            )
        self._written[:] = False
        if self.length_weight_s:
            self._shared, self._time_cost = None, own
            self.cell_cost = self._time_cost + np.float32(self.length_weight_s)
            np.minimum(self.cell_cost, kernels.DEAREST_S, out=self.cell_cost, where=time_cost < np.inf)
        else:
            self._shared, self.cell_cost = time_cost, own
        self._find_range()
        self.rounding = Rounding.of(self.cell_cost)

    def snapshot(self) -> Self:
        """Returns the same costs, which do not change any more. Of shared ones only changed cells are copied."""
        frozen = copy.copy(self)
        frozen._make_scratch()
        if self._shared is None:
            frozen.cell_cost = self.cell_cost.copy()
            frozen._time_cost = None if self._time_cost is None else self._time_cost.copy()
            return frozen
        frozen.cell_cost = private_copy(self._shared)
        for block in np.flatnonzero(self._written).tolist():
            part = np.s_[block * _BLOCK : (block + 1) * _BLOCK]
            frozen.cell_cost[part] = self.cell_cost[part]
        return frozen

    def changes_since(self, older: Floats) -> Changes:
        """Returns the changes since an earlier snapshot of this grid."""
        if self._shared is None:
            cells = np.flatnonzero(self.cell_cost != older)
        else:
            starts = np.flatnonzero(self._written)[:, None] * _BLOCK
            near = (starts + np.arange(_BLOCK)).reshape(-1)
            near = near[near < self.size]
            cells = near[self.cell_cost[near] != older[near]]
        return Changes(cells, older[cells], self.cell_cost[cells])

    def _find_range(self) -> None:
        self._range = CostRange(self.cell_cost)
        self._time_range = CostRange(NO_COSTS if self._time_cost is None else self._time_cost)

    def apply(self, pace: Floats, dirty: Sequence[Window]) -> Changes:
        """Takes what changed inside the dirty windows. Raises ValueError on a pace that is NaN, zero or negative;
        the grid is then as it was. Costs are bounded as by `load`."""
        check_pace(self.grid, pace)
        boxes = list(self._boxes(dirty))
        if not boxes:
            return NO_CHANGES
        for row0, col0, row1, col1 in boxes:
            if not (pace[row0:row1, col0:col1] > 0).all():
                raise ValueError(bad_pace_text(pace, Window(row0, col0, row1, col1)))
        # A cell in two overlapping windows changes in the first only, so there is no repetition.
        found = [self._taken(pace, box, self.length_weight_s, self.cell_cost) for box in boxes]
        if self._time_cost is not None:
            # A change of time may be too small to be seen in a cost that holds the price of length, too.
            timed = [self._taken(pace, box, 0.0, self._time_cost)[0] for box in boxes]
            self._time_range = self._time_range.after(self._time_cost, np.concatenate(timed))
        changes = joined([Changes(cells, before, self.cell_cost[cells]) for cells, before in found])
        if not changes.cells.size:
            return NO_CHANGES
        self._written[changes.cells // _BLOCK] = True
        self.rounding = self.rounding.after(changes)
        self._range = self._range.after(self.cell_cost, changes.cells)
        return changes

    def _taken(
        self, pace: Floats, box: tuple[int, int, int, int], extra_s: float, costs: Floats
    ) -> tuple[Cells, Floats]:
        """Takes a window into the padded costs, `cell_cost` or `time_cost`. Returns the cells that changed, and
        what they cost before."""
        row0, col0, row1, col1 = box
        most = (row1 - row0) * (col1 - col0)
        cells, before = np.empty(most, np.int64), np.empty(most, np.float32)
        count = kernels.changed_cells(pace, self.metres, extra_s, box, self.stride, costs, cells, before)
        return cells[:count], before[:count]

    def window_of(self, cells: Cells | NDArray[np.uint32]) -> Window:
        """The least window that holds these padded cells, one at least."""
        rows = cells // self.stride
        cols = cells - rows * self.stride  # both vectorise, unlike a remainder
        return Window(int(rows.min()) - 1, int(cols.min()) - 1, int(rows.max()), int(cols.max()))

    def _boxes(self, windows: Sequence[Window]) -> Iterator[tuple[int, int, int, int]]:
        """(row0, col0, row1, col1) of what of each window lies on the grid, where anything does."""
        for window in windows:
            row0, col0 = max(window.row0, 0), max(window.col0, 0)
            row1, col1 = min(window.row1, self.grid.rows), min(window.col1, self.grid.cols)
            if row0 < row1 and col0 < col1:
                yield row0, col0, row1, col1

    def grow(self, root: int, cost: Floats, parent: NDArray[np.uint8]) -> float:
        """The exact tree of a padded root, a passable cell. Arrays of the map's size are written whole; no cost
        exceeds the returned one, s."""
        bounds = self.lowest_cell_cost, self.highest_cell_cost, self.dearest_step
        return grow_tree(self.padded, self.climbs, bounds, root, cost, parent)

    def walk(
        self,
        parent: NDArray[np.uint8],
        root: int,
        starts: Cells,
        most: int,
        cell_cost: Floats,
        statuses: NDArray[np.uint8] = _NO_STATUSES,
    ) -> Walks:
        """Routes from padded cells with a path to a padded root, over the cell costs of this or an earlier map.

        most      steps of a route; 0 for all of it
        statuses  (n,), written: then `starts` are any numbers of cells of the grid, which become padded ones.
                  Starts without a route become the root, and the cost driven from there is inf
        Raises ValueError where a start is no padded cell.
        """
        count = starts.size
        ends, last = np.empty(count, np.int64), np.empty(count, np.int64)
        driven, length = np.empty(count), np.empty(count)
        walks = statuses, ends, driven, length, last
        read = cell_cost, self.climbs, self._ways(parent, root), starts
        limits, metres, asked = (most, self.grid.cells), (self.grid.resolution_m, self.diagonal), starts.copy()
        steps = route_kernels.walk_routes(*read, limits, metres, walks, self._directions)
        if steps > self._directions.size:
            self._directions = np.empty(2 * steps, np.uint8)
            starts[:] = asked
            steps = route_kernels.walk_routes(*read, limits, metres, walks, self._directions)
        if steps == route_kernels.BROKEN:
            raise AssertionError("a route does not end at the target: the tree is broken")
        return Walks(self._directions[:steps].copy(), ends, driven, length, last)

    def rests(self, parent: NDArray[np.uint8], root: int, starts: Cells, cell_cost: Floats) -> NDArray[np.float64]:
        """Returns float64, s: the cost driven from padded cells along the parents to a padded root; inf without a
        path. Raises ValueError where a start is no padded cell."""
        rests = np.empty(starts.size)
        many = min(1 << 16, 64 << starts.size.bit_length())
        known = np.zeros(many, np.uint32), np.empty(many)
        if self._trail is None:
            self._trail = np.empty(self.grid.cells + 1, np.uint32), np.empty(self.grid.cells + 1)
        ways = self._ways(parent, root)
        if not route_kernels.drive_rests(cell_cost, self.climbs, ways, starts, known, self._trail, rests):
            raise AssertionError("a route does not end at the target: the tree is broken")
        return rests

    def _ways(self, parent: NDArray[np.uint8], root: int) -> route_kernels.Ways:
        return parent, *self._moves, root, self.stride

    def nearest_open(
        self, cell: int, first: int = 1, leads: Callable[[NDArray[np.int64]], NDArray[np.bool_]] | None = None
    ) -> int | None:
        """The open cell nearest to another; of equals the first of the grid. None if none is near.

        first  rows and columns about it that are looked at first
        leads  which of some cells, with the border, are preferred; those which are not count if no other is near
        """
        row, col = self.grid.row_col(cell)
        costs = self.cell_cost.reshape(-1, self.stride)[1:-1, 1:-1]
        for half in (*(first << n for n in range(8) if first << n < NEAR_CELLS), NEAR_CELLS):
            window = self.grid.around(cell, half)
            rows, cols = np.nonzero(costs[window.row0 : window.row1, window.col0 : window.col1] < np.inf)
            rows, cols = rows + window.row0, cols + window.col0
            away = (rows - row) ** 2 + (cols - col) ** 2
            near = np.flatnonzero((away <= half**2) | (half == NEAR_CELLS))
            led = near if leads is None else near[leads((rows[near] + 1) * self.stride + cols[near] + 1)]
            chosen = led if led.size or half < NEAR_CELLS else near
            if chosen.size:
                best = int(chosen[away[chosen].argmin()])
                return self.grid.cell(int(rows[best]), int(cols[best]))
        return None

    def passable(self, cell: int) -> bool:
        """Returns True if a cell of the grid can be entered. Raises OutsideGridError where it is none of the
        grid."""
        self.grid.row_col(cell)
        return bool(self.cell_cost[self.pad(cell)] < np.inf)


def _padded_climbs(climb: Climb, rule: int) -> tuple[Climbs, float]:
    """Returns (climbs, the highest cost of an allowed step, in cell costs)."""
    grid = climb.grid
    height = np.zeros((grid.rows + 2, grid.cols + 2), np.float32)
    height[1:-1, 1:-1] = climb.elevation_m
    diagonal = {layout.RULE_FOUR: np.float32(np.inf), layout.RULE_OCTILE: layout.SQRT2}.get(rule, np.float32(1.0))
    tables = climb.table[: 8 if climb.windy else 2] / np.float32(climb.lowest)
    tables[1::2] *= diagonal
    begins = (np.arange(8) % len(tables) * tables.shape[1]).astype(np.int32)
    per_metre = np.array(climb.per_metre, np.float32)
    climbs = height.reshape(-1), tables.reshape(-1), per_metre, begins, *row_scratch(grid.cols + 2)
    return climbs, float(tables[tables < np.inf].max())
