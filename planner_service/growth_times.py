"""Times of full searches, and their consequences: the strategy row in force, and the size of searches between
answers."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from planner_service.strategy import AHEAD, HYSTERESIS, STRATEGIES, Growths, OnMove, Strategy, StrategyRow
from planner_service.tree.cost_changes import Cells
from planner_service.tree.strides import FINE, LEAST
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec

MODEL_NS_PER_CELL = 15
"""Model cost of a full search per cell, for choices that must be the same on every machine."""
MODEL_EXACT_NS_PER_CELL = 6
"""The same of an exact move."""
MODEL_PIECES_NS_PER_ROW = 2_400
"""The same of a tree in pieces, for each row of a square map: `bench moves` measures 1.2 ms at 512 x 512, 4 at
2048, 10 at 4096. It counts until a move has been measured."""
MODEL_NEAR_NS_PER_CELL = 7
"""The same of a growth that stops at its askers, for each cell of the window around the target that holds them: the
least that `bench scale --within` and `bench pursuit` measure, so that such a growth is tried before it is left."""
NEAR_CELLS = 1 << 12
"""Such a growth takes as long for these cells more: to clear the last one, and to find out how far it has to go."""
PIECES_CELLS = 1 << 18
"""Maps of this number of cells have their exact trees in pieces. At 512 x 512 an exact move of one takes as long as
by the parents on made-up terrain, less on elevation models; at 383 x 361 more; from there on ever less."""
INLINE_NS = 100_000_000
"""Longer work does not belong on the thread that answers: a forced range is searched immediately if a full search
takes less, and with a worker, so is any other."""
FINE_SHARE = 16
"""Reach of the fine windows of multi-resolution, as a share of the map's side."""

_TICKS = 32
"""Number of ticks for the average rate of target moves, and the change of it at which the row is chosen again: """
_NOTICED = 0.05
"""Moves per tick, far below what makes another row the better one."""

TRIED_AFTER = 2048
"""Moves of the target after which the time of the other way to follow them is the model's again, so that it is
tried: it may have been measured while the machine was busy. That costs a full search at most, some percent of what
the moves between do."""
_MEDIAN_OF = 5
"""Number of recent times whose median counts: single ones take longer, as after a change of processors, or to cut a
tree into pieces."""


def is_slow_to_grow(grid: GridSpec) -> bool:
    """Returns True if a whole tree of this grid takes too long to be searched between two answers."""
    return grid.cells * MODEL_NS_PER_CELL > INLINE_NS


class GrowthTimes:
    """The times of one tree: by the model until one has been measured. A simulation measures none.

    row       of the strategy, in force now
    full_ns   CPU time of a full growth
    exact_ns  CPU time of an exact move, or of mending the tree
    in_pieces whether exact trees are `PartitionedTree`s: on large maps whose cells cost the same from all sides
    """

    def __init__(
        self, grid: GridSpec, config: PlannerConfig, has_worker: bool, climbs: bool, chosen_by: Strategy | None
    ) -> None:
        self._grid = grid
        self.full_ns = self.model_ns
        self.in_pieces = grid.cells >= PIECES_CELLS and not climbs
        self._model_exact_ns = grid.cells * MODEL_EXACT_NS_PER_CELL
        if self.in_pieces:
            self._model_exact_ns = math.isqrt(grid.cells) * MODEL_PIECES_NS_PER_ROW
        self.exact_ns = self._model_exact_ns
        self.row = StrategyRow(OnMove.WHOLE_TREE)
        self.narrowest = 4 << config.k_min
        """Half width of the narrowest scheduled window, in cells."""
        self.fine = max(FINE << config.k_min, 1 << LEAST)
        """Distance up to which strides are so short that all cells are searched, in cells: no less than the least
        block. On a map where that is half of it there are no others."""
        self.budget_ns = config.cpu_budget * 1e9 / config.tick_hz
        """CPU time that a tick may take. Written by `set_budget`."""
        self._tick_hz = config.tick_hz
        self._has_worker = has_worker
        self._chosen_by = chosen_by if chosen_by is not None else STRATEGIES[config.strategy]()
        strategy = self._chosen_by
        self.may_stop = not isinstance(strategy, StrategyRow) or strategy.stops_at_askers
        """True if a row may come into force by which growths stop: askers are then noted under the others, too."""
        self._full_took_ns: deque[int] = deque(maxlen=_MEDIAN_OF)
        self._exact_took_ns: deque[int] = deque(maxlen=_MEDIAN_OF)
        self._expect_near(grid.cells * MODEL_NEAR_NS_PER_CELL)
        self._moves_per_tick, self._chosen_at = 1.0, 1.0
        """Moves in the last `_TICKS` ticks or so; the value when the row was chosen."""
        self._ticks = 0
        self._near_cells, self._near_is_new = math.inf, False
        self._kind, self._in_a_row = "", 0
        """Kind of the last update that was observed, and the number of equal ones before it."""
        self._choose()

    def set_budget(self, cpu_budget: float) -> None:
        """The share of one core that the tree may take from now on."""
        self.budget_ns = cpu_budget * 1e9 / self._tick_hz
        self._choose()

    def rest_ns(self, took_ns: int) -> int:
        """Returns the pause after such work before the next, so that it takes no more than the budget."""
        return int(took_ns * 1e9 / (self.budget_ns * self._tick_hz))

    def note_tick(self, moved: bool) -> None:
        """Notes whether the target has moved since the last tick: one at rest may have a more expensive tree."""
        self._ticks = min(self._ticks + 1, _TICKS)
        self._moves_per_tick += (moved - self._moves_per_tick) / self._ticks
        if abs(self._moves_per_tick - self._chosen_at) > _NOTICED:
            self._choose()

    def note_near(self, cells: float) -> None:
        """Notes the cells of the window that holds the target and its askers, 0 without any; inf if growths cannot
        stop."""
        if cells != self._near_cells or self._near_is_new:
            self._near_cells, self._near_is_new = cells, False
            self._choose()

    @property
    def near_ns(self) -> float:
        """Returns the CPU time of a growth up to the askers; inf if growths cannot stop."""
        return (self._near_cells + NEAR_CELLS) * self._near_whole_ns / self._grid.cells

    def stops(self, is_whole: bool) -> bool:
        """Returns True if a growth up to the askers is to follow a move of the target, and not an exact move.

        is_whole  there is a whole tree, which is given up for a clear gain only: to have it again takes a growth
        """
        return self.near_ns < self.exact_ns * (HYSTERESIS if is_whole else 1.0)

    def observe(self, kind: str, took_ns: int) -> None:
        """CPU time (ns) of a growth or an exact move, by the kind of update. A simulation does not call it."""
        self._in_a_row = self._in_a_row + 1 if kind == self._kind else 0
        self._kind = kind
        if self._in_a_row == TRIED_AFTER:
            self._in_a_row = 0
            if kind == "exact":
                self._expect_near(min(self._near_whole_ns, self._grid.cells * MODEL_NEAR_NS_PER_CELL))
            else:
                self.exact_ns = min(self.exact_ns, self._model_exact_ns)
                self._exact_took_ns.clear()
        observers = {"exact": self.observe_exact_ns, "bounded": self._observe_near_ns}
        observers.get(kind, self.observe_full_ns)(took_ns)

    def _expect_near(self, whole_ns: int) -> None:
        """A growth up to askers is expected to take this long, scaled to the whole map, until some were measured.
        The first ones include allocation of scratch."""
        self._near_whole_ns = max(1, whole_ns)
        self._near_took_ns = deque([self._near_whole_ns] * 2, maxlen=_MEDIAN_OF)

    def _observe_near_ns(self, took_ns: int) -> None:
        if self._near_cells:  # one without askers tells nothing of others
            whole_ns = int(took_ns * self._grid.cells / (self._near_cells + NEAR_CELLS))
            self._near_whole_ns = max(1, _median_with(self._near_took_ns, whole_ns))
            self._near_is_new = True

    def observe_full_ns(self, took_ns: int) -> None:
        """Notes the time of a full search, unless it found networks, too."""
        median_ns = _median_with(self._full_took_ns, took_ns)
        if not self.row.is_exact:
            self._expect_near(self._near_whole_ns * median_ns // self.full_ns)
        # Growths foretell no move of a tree in pieces: they include the cutting, and all planners of a machine grow
        # their first trees at once. The tree is there, so a move is tried. To leave it untried takes another
        # growth, and twice the memory. Beside windows, no exact move is measured, and growths tell that a load of
        # the machine has ended.
        if not self.row.is_exact or not (self._exact_took_ns or self.in_pieces):
            self._exact_took_ns.clear()
            self.exact_ns = self.exact_ns * median_ns // self.full_ns
        self.full_ns = max(1, median_ns)
        self._choose()

    def observe_exact_ns(self, took_ns: int) -> None:
        """Records the CPU time (ns) of an exact update, without the preceding repair."""
        if not self._exact_took_ns:  # one slow move, such as the first after a growth, gives up no tree
            self._exact_took_ns.extend([int(self.exact_ns)] * 2)
        self.exact_ns = max(1, _median_with(self._exact_took_ns, took_ns))
        self._choose()

    def _choose(self) -> None:
        widest = self.widest(thins_far_cells=False)
        exact_ns = min(self.exact_ns if self.mends_quickly else math.inf, self.near_ns)
        self._chosen_at = self._moves_per_tick
        times = Growths(
            self.full_ns, self.budget_ns, widest, self._grid.cells, exact_ns, moves_per_tick=self._moves_per_tick
        )
        self.row = self._chosen_by.row(times)

    def widest(self, thins_far_cells: bool) -> int:
        """Half width of the widest window that is searched without a worker, in cells."""
        if thins_far_cells:
            side = max(self._grid.rows, self._grid.cols)
            return max(self.fine if 4 * self.fine <= side else self.narrowest, side // FINE_SHARE)
        # Over half of the map, a full growth costs as much: that is the worker's.
        share = min(INLINE_NS / self.full_ns, 1.0) / 2
        return math.isqrt(int(share * self._grid.cells)) // 2

    @property
    def most_cells(self) -> int:
        """Returns how many cells may be searched on the thread that answers."""
        return int(INLINE_NS / self.full_ns * self._grid.cells) if self._has_worker else self._grid.cells

    def is_quick(self, cells: int) -> bool:
        """Returns True if this number of cells may be searched on the thread that answers."""
        return not self._has_worker or cells * self.full_ns <= INLINE_NS * self._grid.cells

    @staticmethod
    def is_short(took_ns: float) -> bool:
        """Returns True if work of this length holds up no answer for long."""
        return took_ns <= INLINE_NS

    @property
    def model_ns(self) -> int:
        """Returns the model time of one full search in a simulation: a constant per cell, the same on every
        machine."""
        return self._grid.cells * MODEL_NS_PER_CELL

    @property
    def mends_quickly(self) -> bool:
        """Returns True if the whole tree may be made exact on the thread that answers."""
        return not self._has_worker or self.is_short(self.exact_ns)


def _median_with(took_ns: deque[int], newest_ns: int) -> int:
    """The median of the last times and one more, which is kept."""
    took_ns.append(newest_ns)
    return sorted(took_ns)[len(took_ns) // 2]


class Askers:
    """Cells from which routes and costs were asked lately: a growth that stops goes as far as they are.

    cells  those asked from between the last two updates of the tree in which any were
    """

    def __init__(self) -> None:
        self.cells: Cells = np.empty(0, np.int64)
        self._fresh: list[Cells] = []
        self._needed = deque([0], maxlen=_TICKS)

    def note(self, cells: Cells, needed: int) -> None:
        """Notes cells that asked, and how many the window holds that reaches as far as they are."""
        self._fresh.append(cells)
        self._needed[-1] = max(self._needed[-1], needed)

    def turn(self) -> None:
        """Notes that the tree is updated now."""
        if self._fresh:
            self.cells = self._fresh[0] if len(self._fresh) == 1 else np.unique(np.concatenate(self._fresh))
            self._fresh = []
        self._needed.append(0)

    @property
    def needed(self) -> int:
        """Returns how many cells the window holds that reaches as far as the farthest recent asker."""
        return max(self._needed)


class WindowSchedule:
    """Extent of the search when the target moves: windows of doubling width, each due once the target has come a
    share of that width.

    Routes are as old as the widest window that they begin in. A move of the target matters to a cell relative to
    the cell's distance: less, the farther it is. A window that reaches `AHEAD` times as far keeps that small at
    every distance, and costs 64 cells of search per cell of its width and move. One of the narrowest is grown with
    every move.

    moves  of the target since the whole tree was last exact. The owner counts them
    """

    def __init__(self, grid: GridSpec, config: PlannerConfig, times: GrowthTimes) -> None:
        self.moves = 0
        self._grid = grid
        self._k_min = config.k_min
        self._times = times
        self._narrowest = times.narrowest
        self._side = max(grid.rows, grid.cols)
        # Cell of the target at the last full search, and at the last window of each width: narrowest first.
        self._whole = 0
        self._centres = [0] * max((self._side // self._narrowest).bit_length(), 1)

    def half(self, cell: int, widest: int) -> int:
        """Returns the half width of the window around a target that came to `cell`, at most `widest` unless the
        narrowest is wider. A window is never narrower than the target's move since the last of its width, so that
        windows overlap."""
        found = self._narrowest
        for doublings, centre in enumerate(self._centres):
            half = self._narrowest << doublings
            if half > max(widest, self._narrowest):
                break
            if AHEAD * self._grid.distance_cells(centre, cell) >= half:
                found = half
        return found

    def note_whole(self, root: int) -> None:
        """The whole tree of a root is exact."""
        self.moves = 0
        self.note_window(root, self._side)

    def note_window(self, cell: int, half: int) -> None:
        """A window of `half` cells to every side of `cell` was grown, or strides as far: all widths up to it start
        again."""
        if half >= self._side:
            self._whole = cell
        for doublings in range(len(self._centres)):
            if self._narrowest << doublings <= half:
                self._centres[doublings] = cell

    def after_move(self, row: StrategyRow, old: int, new: int, has_network: bool) -> tuple[int, int]:
        """Returns the half width in which all cells are searched now, and that of strides: no further if both are
        the same."""
        fine = self._times.fine
        has_strides = row.thins_far_cells and has_network and 4 * fine <= self._side
        least = 2 * self._grid.distance_cells(old, new)
        if row.on_move is OnMove.BLOCK_WINDOW:
            half = block_half(self._grid, old, new, self._k_min)
            return (min(half, max(fine, least)) if has_strides else half), half
        widest = self._times.widest(row.thins_far_cells)
        # Cells beyond the widest window are due when a window twice as wide would be.
        if has_strides and AHEAD * self._grid.distance_cells(self._whole, new) >= 2 * widest:
            return max(widest, fine, least), self._side
        half = max(self.half(new, widest), least)
        return half, half


def block_half(grid: GridSpec, old: int, new: int, k_min: int) -> int:
    """Returns the half width, in cells, of the window of variable range (section 3.3.2).

    With the largest k >= k_min for which the target crossed the border of a block of 2**k cells the window is
    2**(k+2) + 1 cells wide; if there is no such k, 2**(k_min+1) + 1 as in figure 3: 9 cells with k_min = 2. The
    printed rule asks that row and column cross at once, which a move along an axis never does; here either is
    enough. At least twice as far as the move was long, so that the window holds both cells and some room around
    them.
    """
    row, col = grid.row_col(new)
    old_row, old_col = grid.row_col(old)
    # Of numbers that differ, their highest differing bit is the largest block whose border was crossed.
    k = ((row ^ old_row) | (col ^ old_col)).bit_length() - 1
    half = 2 << k if k >= k_min else 1 << k_min
    return max(half, 2 * grid.distance_cells(old, new))


def exact_half(grid: GridSpec, old: int, new: int) -> int:
    """Returns the half width, in cells, of the window of an exact move.

    Near the root the paths of whole trunks change, which a window finds at the cost of a search per cell; changes
    beyond it cost several times as much a cell, without harm to exactness. Measured on four elevation models and
    made-up terrain of 512 to 2048 cells a side.
    """
    side = min(grid.rows, grid.cols)
    return max(16, min(side // 12, 64), 2 * grid.distance_cells(old, new))
