"""How one target's tree is kept up with: what is grown when the target moves or the map changes.

    full              the exact tree, every time
    variable_range    the paper's: a window around the target, as wide as its movement asks for
    rotation          windows of doubling width, and every `full_every` moves a full growth on a worker
    multi_resolution  windows near the target; beyond, in rings of doubling width, only cells that carry traffic
    variable_range+multi_resolution
                      the paper's combination: its windows, and the rings where a window would get wide
    auto              full while it fits `cpu_budget`, then rotation as often as that allows; rings where it is too
                      seldom

`TargetTree` has no thread, no clock and no bus: `full_job` returns the long work as a closure for a worker, `adopt`
takes its result. Whatever happened, the tree that `routes` reads has no cycle and crosses no lethal cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.layout import NONE
from planner_service.strategy import Auto
from planner_service.tree.bounds import LowerBounds
from planner_service.tree.corridors import CorridorGraph, find_corridors
from planner_service.tree.cost_grid import Changes, CostGrid, check_pace
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.directed_cost_grid import cost_grid_of
from planner_service.tree.route_reading import read_routes
from planner_service.tree.windows import AHEAD, WindowSchedule, block_half
from shared_map.arrays import Floats
from shared_map.terrain.climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.wire.routes import NO_TARGET, RouteBatch

Kind = Literal["none", "full", "window", "repair", "coarse", "forced"]
EMPTY = Window(0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Update:
    """What one call changed.

    kind        the dearest thing that was done
    window      the cells that may have a new cost or parent; empty if none
    cells       how many cells the kernels visited
    wants_full  please run `full_job` on a worker, and `adopt` what it returns
    """

    kind: Kind
    window: Window = EMPTY
    cells: int = 0
    wants_full: bool = False


MODEL_NS_PER_CELL = 15
"""What a full growth costs per cell, for choices that must come out alike on every machine."""
INLINE_NS = 100_000_000
"""A forced range is grown at once where a full growth takes less."""
WIDE_SHARE = 16
"""A window over one cell in so many gives way to the rings, where corridors are known."""
FINE_SHARE = 16
"""How far the fine windows of `multi_resolution` reach, as a share of the map."""


@dataclass(frozen=True, eq=False)
class GrownTree:
    """An exact tree, grown by a worker on a snapshot.

    target_cell           the root, wherever the target was
    cost, parent, cell_cost  padded, as `kernels.layout` says
    reach                 s; no cost exceeds it. Negative where nothing was grown, as no tree can lead there
    offered               padded parents of the tree that was served when the snapshot was taken; None before any
    corridors              None unless it was wanted
    """

    target_cell: int
    map_version: int
    cost: Floats
    parent: NDArray[np.uint8]
    cell_cost: Floats
    reach: float
    offered: NDArray[np.uint8] | None
    corridors: CorridorGraph | None = None


class TargetTree:
    """The tree of one target under one strategy.

    target_cell  where the tree leads; None before the first update, or when it stands on a lethal or outside cell
    map_version  of the last update
    ready        whether routes can be given; if not, every route's status is NO_TARGET
    last_gaps    float64, driven cost over optimum of what was offered to each followed vehicle, measured at the
                 last full growth; empty before
    """

    def __init__(self, grid: GridSpec, config: PlannerConfig, climb: Climb | None = None) -> None:
        self.target_cell: int | None = None
        self.map_version = -1
        self.ready = False
        self.last_gaps: NDArray[np.float64] = np.empty(0, np.float64)
        self._grid = grid
        self._config = config
        self._climb = climb
        self._ground = cost_grid_of(grid, config, climb)
        self._tree = CostToGoTree(self._ground)
        self._loaded = False
        self._stale = True
        self._moves = 0
        self._job_out = False
        self._corridors: CorridorGraph | None = None
        self._full_ns = self.measured_model_ns()
        self._schedule = WindowSchedule(grid, 4 << config.k_min)
        self._full_root = 0
        self._auto = Auto(config.cpu_budget * 1e9 / config.tick_hz)
        self._auto.observe(self._full_ns, self._widest)
        self._bounds = LowerBounds(self._ground)

    # --- keeping up ---------------------------------------------------------------------------------------------

    def update(self, pace: Floats, target_cell: int, dirty: Sequence[Window], map_version: int) -> Update:
        """The target moved, the map changed, or both: do this strategy's inline work.

        pace   (rows, cols) float32 C-contiguous, s/m, inf is lethal. ValueError on NaN, <= 0, wrong dtype or shape
        dirty  covers every cell that changed since the last call
        """
        changes = self._learn(pace, dirty)
        self.map_version = map_version
        if not self._aim(target_cell, changes):
            return Update("none")
        if self._stale:
            return self._grow_full(target_cell)
        moved = target_cell != self._tree.root
        self._moves += moved
        if not self._windows and (moved or not self._tree.exact):
            return self._grow_full(target_cell)
        mended = self._mend(changes)
        if mended is None:
            return self._grow_full(target_cell)
        if not moved:
            return self._with_wish(mended)
        window = self._move(target_cell)
        if mended.kind == "none" or window.kind == "full":
            return self._with_wish(window)
        return self._with_wish(Update("window", window.window.union(mended.window), window.cells + mended.cells))

    def full_job(self, pace_snapshot: Floats, target_cell: int, map_version: int) -> Callable[[], GrownTree]:
        """A pure, GIL-free full growth. Nobody may write to `pace_snapshot` before it ends."""
        check_pace(self._grid, pace_snapshot)
        grid, config, climb = self._grid, self._config, self._climb
        serves_it = self.ready and not self._stale and self._tree.root == target_cell
        offered = self._tree.parent.copy() if serves_it else None
        self._job_out = True
        wants_corridors = self._coarse and self._corridors is None

        def job() -> GrownTree:
            ground = cost_grid_of(grid, config, climb)
            ground.load(pace_snapshot)
            cost = np.full(ground.size, np.inf, np.float32)
            parent = np.full(ground.size, NONE, np.uint8)
            reach = -1.0
            corridors = None
            if _can_stand(ground, target_cell):
                reach = ground.grow(ground.pad(target_cell), cost, parent)
                corridors = find_corridors(ground) if wants_corridors else None
            return GrownTree(target_cell, map_version, cost, parent, ground.cell_cost, reach, offered, corridors)

        return job

    def adopt(
        self,
        grown: GrownTree,
        pace: Floats,
        target_cell: int,
        dirty: Sequence[Window],
        map_version: int,
        followed_cells: Any,
    ) -> Update:
        """Replace the tree by a grown one and bring it up to date; measure `last_gaps` over `followed_cells`.

        dirty  covers every cell that changed since the snapshot of `grown` was taken
        """
        self._job_out = False
        fresh = not self._loaded
        changes = self._learn(pace, dirty)
        self.map_version = map_version
        if grown.offered is not None:
            self._measure(grown, followed_cells)
        if not self._aim(target_cell, changes):
            return Update("none")
        since = self._ground.difference(grown.cell_cost, [self._grid.window] if fresh else dirty)
        tree = self._tree
        if grown.reach < 0:  # then the target had left the grid, or stood on a lethal cell
            return self._grow_full(target_cell)
        tree.take(grown.target_cell, grown.cost, grown.parent, grown.reach)
        self._full_at(grown.target_cell)
        self._bounds.take(grown.cost.copy())
        self._bounds.learn(since)
        self._stale = False
        self._renew_corridors(grown.corridors, since)
        moved = target_cell != tree.root
        if moved and not self._windows:
            return self._grow_full(target_cell)
        if not tree.fine and (since.cells.size or moved):
            return self._grow_full(target_cell)
        mended = self._mend(since)
        if mended is None:
            return self._grow_full(target_cell)
        cells = self._grid.cells + mended.cells
        if moved:
            cells += self._move(target_cell).cells
        return Update("full", self._grid.window, cells)

    def force(self, pace: Floats, cells: Any) -> Update:
        """The range is forced to cover these cells: what they get afterwards is the best there is. Where growing
        the whole tree would hold up answers for long, a worker is asked to, and they get it when that is adopted;
        until then, the best inside a window that holds them and the target, where that is quick enough."""
        target = self.target_cell
        if not self.ready or target is None:
            return Update("none")
        wanted = self._inside(np.asarray(cells, np.int64))
        if wanted.size == 0 or self._tree.exact:
            return Update("none")
        if self._full_ns > INLINE_NS:
            row, col = self._grid.row_col(target)
            rows, cols = np.divmod(wanted, self._grid.cols)
            half = int(max(np.abs(rows - row).max(), np.abs(cols - col).max())) * 5 // 4 + 1
            window = self._grid.around(target, half)
            grown_cells = 0
            if half <= self._widest and self._windows and self._tree.precise:
                grown_cells = self._tree.move(target, window)
            kind: Kind = "forced" if grown_cells else "none"
            return Update(kind, window if grown_cells else EMPTY, grown_cells, wants_full=not self._job_out)
        return self._grow_full(target)

    def observe_full_ns(self, took_ns: int) -> None:
        """What a full growth really took, for `auto` to choose by; not one that found a corridors too. A simulation
        does not call it."""
        self._full_ns = max(1, took_ns)
        self._auto.observe(self._full_ns, self._widest)

    def measured_model_ns(self) -> int:
        """What one full growth is taken to cost in a simulation: a constant per cell, the same on every machine."""
        return self._grid.cells * MODEL_NS_PER_CELL

    # --- answers ------------------------------------------------------------------------------------------------

    def routes(self, pace: Floats, cells: Any, max_cells: int = 0) -> RouteBatch:
        """A route from each cell, in order; statuses, no exceptions. 0 for `max_cells` is the whole route."""
        asked = np.asarray(cells, np.int64).reshape(-1)
        if not self.ready:
            return RouteBatch.none(asked, NO_TARGET)
        return read_routes(self._tree, self._bounds, asked, max_cells)

    def cost_to_go_at(self, cells: Any) -> Floats:
        """float32, s, per cell; inf where there is no way or the cell is outside."""
        asked = np.asarray(cells, np.int64).reshape(-1)
        costs: Floats = np.full(asked.size, np.inf, np.float32)
        if self.ready:
            inside = (asked >= 0) & (asked < self._grid.cells)
            starts = self._ground.pad_all(asked[inside])
            self._tree.tighten(starts)
            costs[inside] = np.maximum(self._tree.cost[starts] + np.float32(self._tree.offset), 0)
        return costs

    def lengths(self) -> Floats:
        """(rows, cols) float32, m: how long the way of each cell along its parents is; inf where there is none, or
        no target."""
        if not self.ready:
            return np.full((self._grid.rows, self._grid.cols), np.inf, np.float32)
        return self._tree.lengths()

    # --- how ----------------------------------------------------------------------------------------------------

    @property
    def _windows(self) -> bool:
        """Whether a move is followed by a window rather than by a full growth."""
        if self._ground.directed or self._config.strategy == "full":
            return False
        return self._config.strategy != "auto" or self._auto.stage != "exact"

    @property
    def _coarse(self) -> bool:
        """Whether far from the target only what carries traffic is grown."""
        strategy = self._config.strategy
        return not self._ground.directed and (
            strategy in ("multi_resolution", "variable_range+multi_resolution")
            or (strategy == "auto" and self._auto.stage == "coarsen")
        )

    @property
    def _widest(self) -> int:
        """How far the widest window reaches that is grown without a worker, in cells."""
        if self._config.strategy == "multi_resolution":
            return max(4 << self._config.k_min, max(self._grid.rows, self._grid.cols) // FINE_SHARE)
        # Over half of the map, a full growth costs as much: that is the worker's.
        share = min(INLINE_NS / self._full_ns, 1.0) / 2
        return math.isqrt(int(share * self._grid.cells)) // 2

    def _learn(self, pace: Floats, dirty: Sequence[Window]) -> Changes | None:
        """Take the map's changes. None the first time: everything is new."""
        if not self._loaded:
            self._ground.load(pace)
            self._loaded = True
            return None
        changes = self._ground.apply(pace, dirty)
        if changes.cells.size and self._corridors is not None and not self._corridors.learn(self._ground, changes):
            self._corridors = None
        if changes.any_lower:
            self._tree.window_bound = None
        self._bounds.learn(changes)
        return changes

    def _aim(self, target_cell: int, changes: Changes | None) -> bool:
        """Whether the target stands where a tree can lead. If not, the tree is stale as soon as the map changes."""
        self.ready = _can_stand(self._ground, target_cell)
        self.target_cell = target_cell if self.ready else None
        if not self.ready and (changes is None or changes.cells.size):
            self._stale = True
        return self.ready

    def _grow_full(self, target_cell: int) -> Update:
        self._tree.grow(target_cell)
        self._stale = False
        self._full_at(target_cell)
        if self._windows:
            self._bounds.take(self._tree.cost.copy())
        return Update("full", self._grid.window, self._grid.cells)

    def _full_at(self, root: int) -> None:
        """The whole tree was grown around this cell."""
        self._moves = 0
        self._full_root = root
        self._schedule.note_grown(root, max(self._grid.rows, self._grid.cols))

    def _mend(self, changes: Changes | None) -> Update | None:
        """Repair the tree; None if it must be grown instead."""
        if changes is None:
            return None
        if changes.cells.size == 0:
            return Update("none")
        tree = self._tree
        if not tree.fine or not self._ground.cell_cost[self._ground.pad(tree.root)] < np.inf:
            return None
        visited = tree.repair(changes)
        if visited < 0 or not tree.fine:
            return None
        rows = changes.cells // self._ground.stride - 1
        cols = changes.cells % self._ground.stride - 1
        window = Window(int(rows.min()), int(cols.min()), int(rows.max()) + 1, int(cols.max()) + 1)
        return Update("repair", window, visited)

    def _move(self, target_cell: int) -> Update:
        tree = self._tree
        if not tree.fine:
            return self._grow_full(target_cell)
        if not tree.precise:
            tree.relabel()
        half, rings = self._reach(target_cell)
        window = self._grid.around(target_cell, half)
        cells = 0
        while window.cells * 2 < self._grid.cells:
            grown = tree.move(target_cell, window)
            cells += window.cells
            if grown and rings is not None:
                self._schedule.note_grown(target_cell, max(self._grid.rows, self._grid.cols))
                return Update("coarse", self._grid.window, cells + tree.grow_corridors(window, rings))
            if grown:
                self._schedule.note_grown(target_cell, half)
                return Update("window", window, cells)
            half *= 2
            window = self._grid.around(target_cell, half)
        return self._grow_full(target_cell)

    def _reach(self, target_cell: int) -> tuple[int, CorridorGraph | None]:
        """How far to every side of the target the tree is grown now, and over which corridors beyond; None for not
        at all."""
        rings = self._corridors if self._coarse else None
        old = self._tree.root
        least = 2 * self._grid.distance_cells(old, target_cell)
        if self._config.strategy.startswith("variable_range"):
            half = block_half(self._grid, old, target_cell, self._config.k_min)
            if rings is None or self._grid.around(target_cell, half).cells * WIDE_SHARE <= self._grid.cells:
                return half, None
            return max(4 << self._config.k_min, least), rings
        widest = self._widest
        if rings is not None and self._schedule.beyond(target_cell, widest):
            return max(widest, least), rings
        return max(self._schedule.half(target_cell, widest), least), None

    def _with_wish(self, update: Update) -> Update:
        """Ask for a full growth where one is due and none is under way."""
        wants = self._coarse and self._corridors is None
        if self._config.strategy == "rotation":
            # On a small map a full growth is due as soon as windows have cost half as much.
            twice = 2 * (8 << self._config.k_min) ** 2
            wants = self._moves >= min(self._config.full_every, self._grid.cells // twice + 1)
        elif self._config.strategy == "auto" and self._auto.stage != "exact":
            # As often as the budget allows, but no sooner than the whole map were due as a window.
            come = self._grid.distance_cells(self._full_root, self._tree.root)
            far = 2 * AHEAD * come >= max(self._grid.rows, self._grid.cols)
            wants |= far and self._moves * self._auto.budget_ns >= self._full_ns
        wants = wants and update.kind != "full" and not self._job_out
        return Update(update.kind, update.window, update.cells, wants)

    def _renew_corridors(self, found: CorridorGraph | None, since: Changes) -> None:
        """Take what a worker found, and what changed since it looked."""
        if found is not None:
            self._corridors = found if not since.cells.size or found.learn(self._ground, since) else None

    def _inside(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        asked = cells.reshape(-1)
        return asked[(asked >= 0) & (asked < self._grid.cells)]

    def _measure(self, grown: GrownTree, followed_cells: Any) -> None:
        """Driven cost over optimum of what was offered when the snapshot was taken, on the snapshot."""
        cells = self._inside(np.asarray(followed_cells, np.int64))
        starts = self._ground.pad_all(cells)
        root = self._ground.pad(grown.target_cell)
        offered = grown.offered
        assert offered is not None
        starts = starts[(grown.cost[starts] < np.inf) & (offered[starts] != NONE)]
        walks = self._ground.walk(offered, root, starts, 0, grown.cell_cost)
        whole = walks.ends >= 0
        optimum = grown.cost[starts[whole]].astype(np.float64)
        self.last_gaps = np.maximum(walks.driven[whole] / optimum, 1.0)


def _can_stand(ground: CostGrid, cell: int) -> bool:
    """Whether a tree can lead to a cell: it is one of the grid, and not lethal."""
    return ground.grid.inside(*divmod(cell, ground.grid.cols)) and ground.passable(cell)
