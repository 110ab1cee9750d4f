"""What growing a tree takes, and what follows: the row in force, and what may be grown between answers."""

from __future__ import annotations

import math
from collections import deque

from planner_service.strategy import STRATEGIES, Growths, OnMove, Strategy, StrategyRow, WidestWindow
from planner_service.tree.strides import FINE, LEAST
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec

MODEL_NS_PER_CELL = 15
"""What a full growth costs per cell, for choices that must come out alike on every machine."""
MODEL_EXACT_NS_PER_CELL = 6
"""The same of an exact move."""
MODEL_PIECES_NS_PER_ROW = 5_000
"""The same of a tree in pieces, for each row of a square map: 4 ms at 512 x 512, 10 at 2048, 16 at 4096. It counts
until a move has been measured."""
PIECES_CELLS = 1 << 18
"""Maps of so many cells have their exact trees in pieces. At 512 x 512 an exact move of one takes as long as by the
parents on made-up terrain, less on elevation models; at 383 x 361 more; from there on ever less."""
INLINE_NS = 100_000_000
"""What takes longer is no work for the thread that answers: a forced range is grown at once where a full growth
takes less, and where there is a worker, so is any other."""
FINE_SHARE = 16
"""How far the fine windows of multi-resolution reach, as a share of the map's side."""

_TICKS = 32
"""Over so many is averaged how often the target moves, and the row is chosen anew where that has changed by: """
_NOTICED = 0.05

_MEDIAN_OF = 5
"""Of the last so many times the median counts: single ones take longer, as after a change of processors, or to cut
a tree into pieces."""


def is_slow_to_grow(grid: GridSpec) -> bool:
    """Whether a whole tree of this grid is nothing to be grown between two answers."""
    return grid.cells * MODEL_NS_PER_CELL > INLINE_NS


class GrowthTimes:
    """The times of one tree: by the model until one has been measured. A simulation measures none.

    row       of the strategy, in force now
    full_ns   CPU time of a full growth
    exact_ns  CPU time of an exact move, or of mending the tree
    in_pieces whether exact trees are `PieceTree`s: on large maps, where a cell costs the same from everywhere
    """

    def __init__(
        self, grid: GridSpec, config: PlannerConfig, has_worker: bool, climbs: bool, chosen_by: Strategy | None
    ) -> None:
        self._grid = grid
        self.full_ns = self.model_ns
        self.in_pieces = grid.cells >= PIECES_CELLS and not climbs
        self.exact_ns = grid.cells * MODEL_EXACT_NS_PER_CELL
        if self.in_pieces:
            self.exact_ns = math.isqrt(grid.cells) * MODEL_PIECES_NS_PER_ROW
        self.row = StrategyRow(OnMove.WHOLE_TREE)
        self.narrowest = 4 << config.k_min
        """How far the narrowest scheduled window reaches, in cells."""
        self.fine = max(FINE << config.k_min, 1 << LEAST)
        """How far strides are so short that all cells are grown, in cells: no less than the least block. On a map
        where that is half of it there are no others."""
        self.budget_ns = config.cpu_budget * 1e9 / config.tick_hz
        """CPU time that a tick may take. Written by `set_budget`."""
        self._tick_hz = config.tick_hz
        self._has_worker = has_worker
        self._chosen_by = chosen_by if chosen_by is not None else STRATEGIES[config.strategy]()
        self._full_took_ns: deque[int] = deque(maxlen=_MEDIAN_OF)
        self._exact_took_ns: deque[int] = deque(maxlen=_MEDIAN_OF)
        self._moves_per_tick, self._chosen_at = 1.0, 1.0
        """Of the last `_TICKS` ticks or so; what it was when the row was chosen."""
        self._ticks = 0
        self._choose()

    def set_budget(self, cpu_budget: float) -> None:
        """The share of one core that the tree may take from now on."""
        self.budget_ns = cpu_budget * 1e9 / self._tick_hz
        self._choose()

    def rest_ns(self, took_ns: int) -> int:
        """How long after such work none like it may begin, so that it takes no more than the budget."""
        return int(took_ns * 1e9 / (self.budget_ns * self._tick_hz))

    def note_tick(self, moved: bool) -> None:
        """Whether the target has moved since the last tick: one that stands may have a dearer tree."""
        self._ticks = min(self._ticks + 1, _TICKS)
        self._moves_per_tick += (moved - self._moves_per_tick) / self._ticks
        if abs(self._moves_per_tick - self._chosen_at) > _NOTICED:
            self._choose()

    def observe_full_ns(self, took_ns: int) -> None:
        """What a full growth really took; not one that found networks too. A simulation does not call it."""
        median_ns = _median_with(self._full_took_ns, took_ns)
        # Growths foretell no move of a tree in pieces: they include the cutting, and all planners of a machine grow
        # their first trees at once. The tree is there, so a move is tried. To leave it untried takes another
        # growth, and twice the memory.
        if not self._exact_took_ns and not self.in_pieces:
            self.exact_ns = self.exact_ns * median_ns // self.full_ns
        self.full_ns = max(1, median_ns)
        self._choose()

    def observe_exact_ns(self, took_ns: int) -> None:
        """What an exact move really took, without the repair before it."""
        if self.in_pieces and not self._exact_took_ns:
            # One slow move, such as the first after a growth, gives up no tree: another one takes a second.
            self._exact_took_ns.extend([int(self.exact_ns)] * 2)
        self.exact_ns = max(1, _median_with(self._exact_took_ns, took_ns))
        self._choose()

    def _choose(self) -> None:
        widest = self.widest(WidestWindow.WHILE_CHEAPER)
        exact_ns = self.exact_ns if self.mends_quickly else math.inf
        self._chosen_at = self._moves_per_tick
        times = Growths(
            self.full_ns, self.budget_ns, widest, self._grid.cells, exact_ns, moves_per_tick=self._moves_per_tick
        )
        self.row = self._chosen_by.row(times)

    def widest(self, rule: WidestWindow) -> int:
        """How far the widest window reaches that is grown without a worker, in cells."""
        if rule is WidestWindow.SHARE_OF_MAP:
            side = max(self._grid.rows, self._grid.cols)
            return max(self.fine if 4 * self.fine <= side else self.narrowest, side // FINE_SHARE)
        # Over half of the map, a full growth costs as much: that is the worker's.
        share = min(INLINE_NS / self.full_ns, 1.0) / 2
        return math.isqrt(int(share * self._grid.cells)) // 2

    def is_quick(self, cells: int) -> bool:
        """Whether so many cells may be grown on the thread that answers."""
        return not self._has_worker or cells * self.full_ns <= INLINE_NS * self._grid.cells

    @staticmethod
    def is_short(took_ns: float) -> bool:
        """Whether work of so long holds up no answer for long."""
        return took_ns <= INLINE_NS

    @property
    def model_ns(self) -> int:
        """What one full growth is taken to cost in a simulation: a constant per cell, the same on every machine."""
        return self._grid.cells * MODEL_NS_PER_CELL

    @property
    def mends_quickly(self) -> bool:
        """Whether the whole tree may be made exact on the thread that answers."""
        return not self._has_worker or self.is_short(self.exact_ns)


def _median_with(took_ns: deque[int], newest_ns: int) -> int:
    """The median of the last times and one more, which is kept."""
    took_ns.append(newest_ns)
    return sorted(took_ns)[len(took_ns) // 2]
