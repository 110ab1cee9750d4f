"""Update of one target's tree: the search after a move of the target or a change of the map.

The strategy's row (`strategy.STRATEGIES`) selects the work, this module performs it. `TargetTree` has no thread, no
clock and no bus: `full_job` returns the long work as a closure for a worker, `adopt` takes its result. In every
state, the tree that `routes` reads has no cycle and crosses no lethal cell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.growth_times import Askers, GrowthTimes, WindowSchedule, exact_half
from planner_service.kernels.layout import NONE
from planner_service.kernels.partial_growth_kernels import open_cells
from planner_service.kernels.route_kernels import UNREACHABLE
from planner_service.kernels.stride_networks import StrideNetwork
from planner_service.strategy import OnMove, Strategy, StrategyRow, whole_trees_only
from planner_service.tree import partitioned_tree
from planner_service.tree.cost_changes import Changes
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.partial_growth import PartialGrowth
from planner_service.tree.routes_with_bounds import LowerBounds, read_routes
from planner_service.tree.strides import find_strides
from shared_map.array_files import Floats
from shared_map.terrain.slope_and_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.wire.route_columns import NO_TARGET, RouteBatch

_NO_WINDOW = Window(0, 0, 0, 0)
Kind = Literal["none", "full", "bounded", "exact", "window", "repair", "coarse", "forced"]


@dataclass(frozen=True, slots=True)
class Update:
    """Changes by one call.

    kind        the most expensive work: none, full search, search as far as the farthest asker, tree made exact by
                its parents, window, repair after map changes, window and strides beyond it, forced range
    window      the cells that may have a new cost or parent; empty if none
    cells       how many cells the kernels visited
    wants_full  the caller is to run `full_job` on a worker, and to `adopt` its result
    repair_ns   CPU time of the repair after map changes that came first, by the tree's stopwatch; excludes moves
                and growths
    """

    kind: Kind
    window: Window = _NO_WINDOW
    cells: int = 0
    wants_full: bool = False
    repair_ns: int = 0

    def after(self, repaired: Update) -> Update:
        """The same change with the repair before it."""
        if self.kind == "none":
            return replace(repaired, wants_full=self.wants_full)
        if self.kind in ("full", "exact"):
            return replace(self, repair_ns=repaired.repair_ns)
        window, cells = self.window.union(repaired.window), self.cells + repaired.cells
        return Update("window", window, cells, self.wants_full, repaired.repair_ns)


class LethalTarget(NamedTuple):
    """A target's lethal cell, to which no tree leads, and the nearest cell that can be reached; None if none is
    near."""

    cell: int
    nearest: int | None


class State(Enum):
    """State of a tree. `TargetTree.ready` states whether its target is on a cell that can be reached.

    =========  ===========================================  ====================================================
    state      what it means                                what ends it
    =========  ===========================================  ====================================================
    STALE      of no use: before the first growth, or the   a growth, here or adopted: CURRENT
               map changed while there was no target
    CURRENT    it leads to the target as it was last told   a move that takes too long here: BEHIND; a map that
                                                            has changed without a target, or too much: STALE
    BEHIND     a worker grows the tree; meanwhile it leads  the worker's tree is adopted: CURRENT; STALE as above
               to the old root
    =========  ===========================================  ====================================================
    """

    STALE = "stale"
    CURRENT = "current"
    BEHIND = "behind"


@dataclass(frozen=True, slots=True)
class Decision:
    """Planned update of a tree, decided before any work.

    how   nothing; the whole tree, here or on the worker; an exact move; a window, and strides beyond it
    half  how far the window reaches to every side of the target, cells; 0 if it has not moved
    far   how far strides are grown, cells; no further than `half`: none are
    """

    how: Literal["nothing", "whole", "exact", "window"]
    half: int = 0
    far: int = 0


class TargetTree:
    """The tree of one target under one strategy.

    target_cell  where the tree leads; None before the first update, or while it stands on a lethal or outside cell
    map_version  of the last update; -1 before the first
    all_kernels  whether kernels beside those for whole trees may be called by now. While it says no, windows,
                 repairs and strides give way to whole trees, so that nothing waits for a compilation
    has_worker   whether a growth that takes longer than `INLINE_NS` is left to `full_job`. Until that is adopted
                 the tree leads where it led, and says so by `target_cell`; where it is of no use, `ready` is false
    chosen_by    the strategy; the built-in one that `config` names if not given
    stopwatch    CPU time of this thread, ns, which separates repairs from later work; none in a simulation
    times        times of searches, by which the strategy chooses
    last_gaps    float64, driven cost over optimum of the offer to each followed vehicle, measured by the last
                 `adopt`; empty before
    """

    def __init__(
        self,
        grid: GridSpec,
        config: PlannerConfig,
        climb: Climb | None = None,
        all_kernels: Callable[[], bool] = lambda: True,
        *,
        has_worker: bool = False,
        chosen_by: Strategy | None = None,
        stopwatch: Callable[[], int] = lambda: 0,
    ) -> None:
        self.target_cell: int | None = None
        self.lethal_target: LethalTarget | None = None
        self.map_version = -1
        self.last_gaps: NDArray[np.float64] = np.empty(0, np.float64)
        self._grid = grid
        self._all_kernels = all_kernels
        self._has_worker = has_worker
        self._stopwatch = stopwatch
        # The last known cell costs of the map, whose owner is this tree, and whether there are any.
        self.cost_grid = CostGrid(grid, config, climb)
        self._loaded = False
        self._tree: partitioned_tree.AnyTree = CostToGoTree(self.cost_grid)
        self._state = State.STALE
        # A worker has a `full_job` that was not adopted yet: no second one is asked for.
        self._job_out = False
        # The network of strategies that thin far cells; None until it is found.
        self._network: StrideNetwork | None = None
        self._seeks_network = False
        self.times = GrowthTimes(grid, config, has_worker, climb is not None, chosen_by)
        self._windows = WindowSchedule(grid, config, self.times)
        # Knows the last exact costs and every change since: certificates while the tree is not exact.
        self._bounds = LowerBounds(self.cost_grid)
        # Growths that stop, and the askers, which decide how far they go. Some were too far for a growth here.
        self._growth = PartialGrowth(self.cost_grid)
        self._can_stop = False
        self._askers = Askers()
        self._too_far = False
        # The tree became exact on this thread: before it is no longer, its costs are to be taken for bounds.
        self._is_better_bound = False

    @property
    def ready(self) -> bool:
        """True if routes can be given; if not, every route's status is NO_TARGET."""
        return self.target_cell is not None

    @property
    def strategy(self) -> StrategyRow:
        """The row in force now; it changes with `observe_full_ns`, as under `auto`."""
        row = self.times.row
        return row if self._all_kernels() else whole_trees_only(row)

    def share(self, cell_cost: Floats) -> None:
        """Begins with the cell costs of the map before any mark, which other processes share; `update` receives all
        changes since. Before the first `update`."""
        self.cost_grid.share(cell_cost)
        self._loaded, self._can_stop = True, self._growth.usable

    # --- keeping up ---------------------------------------------------------------------------------------------

    def update(self, pace: Floats, target_cell: int, dirty: Sequence[Window], map_version: int) -> Update:
        """Follows a move of the target, changes of the map, or both, by the strategy's work on this thread.

        Parameters
        ----------
        pace : (rows, cols) float32, C-contiguous, s/m; inf is lethal
        dirty : windows that cover every cell that changed since the last call

        Raises ValueError on a pace that is NaN, zero, negative, or of the wrong dtype or shape.
        """
        changes = self._learn(pace, dirty)
        self.map_version = map_version
        self._askers.turn()
        return self._follow(target_cell, changes) if self._set_target(target_cell, changes) else Update("none")

    def full_job(self, target_cell: int) -> Callable[[], partitioned_tree.GrownTree]:
        """Returns a full search for a worker, on the last known map: see `growth_job`."""
        self._too_far = False
        leads_there = self.ready and self._state is not State.STALE and self._tree.root == target_cell
        offered = self._tree.parent.copy() if leads_there else None
        self._job_out = True
        return partitioned_tree.growth_job(
            self.cost_grid.snapshot(), target_cell, self.map_version, offered, self._in_pieces
        )

    @property
    def wants_full(self) -> bool:
        """True if the caller is to run `full_job`: an asker is farther away than a growth may go on this thread."""
        return self._too_far and not self._job_out

    @property
    def wants_strides(self) -> bool:
        """True if the caller is to run `stride_job` on a worker, and to pass its result to `take_strides`."""
        return self.strategy.thins_far_cells and self._loaded and not self._seeks_network

    def stride_job(self) -> Callable[[], StrideNetwork]:
        """Returns the search for this tree's stride network, for a worker: marks make its result less good, never
        wrong."""
        self._seeks_network = True
        return partial(find_strides, self.cost_grid.snapshot())

    def take_strides(self, found: StrideNetwork) -> None:
        """Uses a stride network from now on, as `stride_job` found it."""
        self._network = found

    def adopt(
        self,
        grown: partitioned_tree.GrownTree,
        pace: Floats,
        target_cell: int,
        dirty: Sequence[Window],
        map_version: int,
        followed_cells: Any,
    ) -> Update:
        """Replaces the tree by a grown one and brings it up to date; measures `last_gaps` over `followed_cells`.

        dirty  covers every cell that changed since the snapshot of `grown` was taken
        """
        self._job_out = False
        if self._state is State.BEHIND:
            self._state = State.CURRENT
        changes = self._learn(pace, dirty)
        self.map_version = map_version
        if grown.offered is not None:
            self.last_gaps = partitioned_tree.offered_gaps(self.cost_grid, grown, self._inside(followed_cells))
        if not self._set_target(target_cell, changes):
            return Update("none")
        since = self.cost_grid.changes_since(grown.cell_cost)
        if grown.reach < 0:  # then the target had left the grid, or stood on a lethal cell
            return self._follow(target_cell, changes)
        in_pieces = self._in_pieces or not self.times.is_quick(self._grid.cells)  # as it is, if that takes long
        self._tree = grown.tree_on(self.cost_grid, in_pieces)
        self._windows.note_whole(grown.target_cell)
        self._is_better_bound = grown.heuristic is None
        if grown.heuristic is None:
            self._bounds.forget()
        else:
            self._bounds.take(grown.heuristic)
            self._learn_bounds(since)
        self._state = State.CURRENT
        then = self._follow(target_cell, since)
        return Update("full", self._grid.window, self._grid.cells + then.cells, then.wants_full)

    def force(self, cells: Any) -> Update:
        """Forces the range to cover these cells, so that their routes become optimal (section 3.3.2).

        If that would delay answers for long, a worker grows the whole tree, and routes are optimal once that is
        adopted.
        """
        target = self.target_cell
        wanted = self._inside(cells)
        if target is None or not wanted.size or self._tree.exact:
            return Update("none")
        if (forced := self._force_near(wanted)) is not None:
            return forced
        if self.times.is_short(self.times.full_ns):
            return self._grow_full(target)
        if self._can_mend and self.times.is_short(self.times.exact_ns):
            return self._mend()
        return Update("none", wants_full=not self._job_out)

    # --- answers ------------------------------------------------------------------------------------------------

    def routes(self, cells: Any, max_cells: int = 0) -> RouteBatch:
        """A route from each cell, in order; statuses, no exceptions. 0 for `max_cells` is the whole route."""
        asked = _in_a_row(cells)
        if not self.ready:
            return RouteBatch.none(asked, NO_TARGET)
        self._reach(asked)
        routes = read_routes(self._tree, self._bounds, asked, max_cells)
        if not self._is_whole and (unknown := routes.statuses == UNREACHABLE).any():
            routes.statuses[unknown] = NO_TARGET
            routes.lower_bound_s[unknown] = self._tree.bound * self.cost_grid.time_share
        return routes

    def cost_to_go_at(self, cells: Any) -> Floats:
        """float32, s, per cell; inf where there is no path or the cell is outside."""
        asked = _in_a_row(cells)
        costs: Floats = np.full(asked.size, np.inf, np.float32)
        if self.ready:
            inside = (asked >= 0) & (asked < self._grid.cells)
            self._reach(asked)
            starts = self.cost_grid.pad_all(asked[inside])
            costs[inside] = self._tree.cost_at(starts)
        return costs

    def may_reach(self, cells: Any, costs_s: Floats) -> bool:
        """Returns True if a growth that has stopped may still find a way for one of the cells without a cost."""
        unknown = _in_a_row(cells)[np.isinf(costs_s)]
        return not self._is_whole and self._open(unknown).size > 0

    # --- how ----------------------------------------------------------------------------------------------------

    def _learn(self, pace: Floats, dirty: Sequence[Window]) -> Changes | None:
        """Takes the map's changes. None the first time: everything is new."""
        if not self._loaded:
            self.cost_grid.load(pace)
            self._loaded, self._can_stop = True, self._growth.usable
            return None
        changes = self.cost_grid.apply(pace, dirty)
        if not changes.cells.size:
            return changes
        self._growth.learn(changes)
        self._can_stop = self._growth.usable
        if changes.any_lower:
            self._tree.window_bound = None
        self._learn_bounds(changes)
        return changes

    def _learn_bounds(self, changes: Changes) -> None:
        if self._all_kernels():
            self._bounds.learn(changes)
        else:
            self._bounds.forget()

    def _set_target(self, target_cell: int, changes: Changes | None) -> bool:
        """Returns True if the target is on a cell to which a tree can lead. If not, the tree is stale as soon as
        the map changes."""
        self.target_cell = target_cell if partitioned_tree.can_be_root(self.cost_grid, target_cell) else None
        changed = changes is None or bool(changes.cells.size)
        if self.ready or not 0 <= target_cell < self._grid.cells:
            self.lethal_target = None
        elif changed or self.lethal_target is None or self.lethal_target.cell != target_cell:
            self.lethal_target = LethalTarget(target_cell, self._nearest(target_cell))
        if not self.ready and changed:
            self._state = State.STALE
        return self.ready

    def _nearest(self, target_cell: int) -> int | None:
        """The open cell nearest to a lethal one, of those from which the last tree led, or of all if it led from
        none near; of equals the first of the grid. None if none is near.

        It looks at a circle that holds the last answer, and at wider ones if no tree leads from there any more, so
        that a target which moves over water costs what lies between it and the shore.
        """
        last = None if self.lethal_target is None else self.lethal_target.nearest
        first = 1 if last is None else self._grid.distance_cells(target_cell, last) * 3 // 2 + 1
        return self.cost_grid.nearest_open(target_cell, first, self._leads)

    def _follow(self, target_cell: int, changes: Changes | None) -> Update:
        """Brings the tree up to date with the map, then with its target: decide, and do it."""
        self.times.note_near(self._askers.needed if self._can_stop else np.inf)
        if self._state is State.STALE:
            return self._grow_full(target_cell)
        self._windows.moves += target_cell != self._tree.root
        if (near := self._follow_near(target_cell, changes)) is not None:
            return near
        grows_anew = self.strategy.on_move is OnMove.WHOLE_TREE and self._is_quick
        if grows_anew and self._decide(target_cell).how == "whole":
            return self._grow_full(target_cell)
        repaired = self._repair(changes)
        if repaired is None:
            return self._grow_full(target_cell)
        done = self._perform(self._decide(target_cell), target_cell)
        if self._is_full_due(done):
            done = self._renew(done)
        return done if repaired.kind == "none" else done.after(repaired)

    def _decide(self, target_cell: int) -> Decision:
        """Decides how to reach the target's cell from the current tree."""
        tree, row = self._tree, self.strategy
        moved = target_cell != tree.root
        if not moved and (tree.exact or not row.is_exact):
            return Decision("nothing")
        if row.on_move is OnMove.WHOLE_TREE or self._state is State.BEHIND:
            return Decision("whole")
        if row.on_move is OnMove.EXACT_MOVE:
            # To cut a tree into pieces, or to write a cost into every cell of one, takes as long as to grow it.
            cuts = self._in_pieces and not isinstance(tree, partitioned_tree.PartitionedTree) and not self._is_quick
            if not self._can_mend or cuts:
                return Decision("whole")
            return Decision("exact", exact_half(self._grid, tree.root, target_cell) if moved else 0)
        if isinstance(tree, partitioned_tree.PartitionedTree) and not self._is_quick:
            return Decision("whole")
        return Decision("window", *self._windows.after_move(row, tree.root, target_cell, self._network is not None))

    def _perform(self, decision: Decision, target_cell: int) -> Update:
        """Performs a decision; if it does not lead to the target, it searches the whole tree."""
        if decision.how == "exact" and self._in_pieces:
            self._tree = partitioned_tree.in_pieces(self._tree)
        elif decision.how == "window":
            self._tree = self._prepared(partitioned_tree.in_cells(self._tree))
        if decision.how == "nothing":
            return Update("none")
        if decision.how == "whole" or not self._tree.fine:
            return self._grow_or_leave(target_cell)
        window, cells = None, 0
        if decision.half:
            window, cells = self._grow_window(target_cell, decision.half)
            if window is None:
                return self._grow_or_leave(target_cell)
        if decision.how == "exact":
            mended = self._mend()
            return Update(mended.kind, mended.window, mended.cells + cells, mended.wants_full)
        assert window is not None
        if self._network is not None and decision.far > decision.half and isinstance(self._tree, CostToGoTree):
            self._windows.note_window(target_cell, decision.far)
            cells += self._tree.grow_strides(window, self._network, decision.far)
            return Update("coarse", self._grid.around(target_cell, decision.far), cells)
        return Update("window", window, cells)

    @property
    def _is_quick(self) -> bool:
        """Returns True if a whole tree may be searched here."""
        return self.times.is_quick(self._grid.cells)

    def _prepared(self, tree: CostToGoTree) -> CostToGoTree:
        """Prepares a tree before a window loosens its costs: exact costs are kept as a heuristic."""
        if tree.fine:
            if not tree.precise:
                tree.mend()
            if self._is_better_bound and tree.exact:
                self._bounds.take(tree.cost.copy())
            self._is_better_bound = False
        return tree

    def _grow_or_leave(self, target_cell: int) -> Update:
        """Grows the whole tree here, or leaves that to the worker; routes lead to the old root until it is
        adopted."""
        if self._is_quick and self._state is not State.BEHIND:
            return self._grow_full(target_cell)
        self.target_cell, self._state = self._tree.root, State.BEHIND
        return Update("none", wants_full=not self._job_out)

    def _grow_full(self, target_cell: int) -> Update:
        """Grows the whole tree: here or, where that would take too long, on the worker. The old tree is dropped. If
        growths can stop, and more is not needed here, it grows only up to the askers."""
        stops = self._stops
        if self._can_stop and (stops or not self._is_quick):
            near = self._grow_near(target_cell, rest=not stops)
            if near is not None:
                return near
        if not self._is_quick:
            self._state, self.target_cell = State.STALE, None
            return Update("none", wants_full=not self._job_out)
        if isinstance(self._tree, partitioned_tree.PartitionedTree) is not self._in_pieces:
            self._tree = (
                partitioned_tree.PartitionedTree(self.cost_grid)
                if self._in_pieces
                else CostToGoTree(self.cost_grid)
            )
        self._tree.grow(target_cell)
        self._state = State.CURRENT
        self._windows.note_whole(target_cell)
        self._bounds_are_old()
        return Update("full", self._grid.window, self._grid.cells)

    # --- as far as the askers are --------------------------------------------------------------------------------

    @property
    def _stops(self) -> bool:
        """Returns True if a growth is to go only as far as the askers: with every move of brute force,
        and instead of exact moves that take longer."""
        row = self.strategy
        if not (row.stops_at_askers and self._can_stop):
            return False
        if row.on_move is OnMove.WHOLE_TREE:
            return self._is_quick or self.times.is_short(self.times.near_ns)
        return self.times.stops(self._is_whole)

    @property
    def _is_whole(self) -> bool:
        """Returns True if a cell without a cost has no path."""
        return self._tree.bound == np.inf

    def _follow_near(self, target_cell: int, changes: Changes | None) -> Update | None:
        """Follows by a growth that stops; None where the whole tree is to be kept."""
        whole, moved = self._is_whole, target_cell != self._tree.root
        if not moved and whole:
            return None
        if not moved and changes is not None and not changes.cells.size:
            return Update("none")
        if whole and not self._stops:
            return None
        return self._grow_full(target_cell)

    def _grow_near(self, target_cell: int, rest: bool = False) -> Update | None:
        """Grows as far as the askers are, or as is quick. None if costs are too large for that.

        rest  the worker is to grow the whole tree
        """
        root, askers = self.cost_grid.pad(target_cell), self._askers.cells
        askers = askers[self.cost_grid.cell_cost[askers] < np.inf]
        aim = self._growth.aim_at(askers, root, self._tree.parent)
        self._growth.begin(root)
        grown = self._growth.go_on(askers, self.times.most_cells, aim)
        if grown < 0:
            return None
        self._take_grown(target_cell)
        self._state = State.CURRENT
        self._windows.note_whole(target_cell)
        self._bounds.forget()
        self._is_better_bound = False
        return Update("bounded", self._grid.window, grown + 1, wants_full=rest and not self._job_out)

    def _take_grown(self, target_cell: int) -> None:
        if not isinstance(self._tree, CostToGoTree):
            self._tree = CostToGoTree(self.cost_grid)
        self._tree.take_grown(target_cell, self._growth)

    def knows(self, cells: Any) -> bool:
        """Returns True if these cells are answered for good; if not, a worker's tree is to come."""
        if not self.ready or self._is_whole:
            return self.ready
        self._reach(cells)
        return self._is_whole or not self._without_path(self._open(cells)).size

    def _reach(self, cells: Any) -> None:
        """Continues a stopped growth up to these cells."""
        if not self.times.may_stop and self._is_whole:
            return
        starts, unknown, half = self._find_starts(cells)
        if not self._is_whole and unknown:
            if self._growth.go_on(starts, self.times.most_cells) < 0:
                self._too_far = True
                return
            self._take_grown(self._tree.root)
            self._too_far |= not self._is_whole and self._without_path(starts).size > 0
        if not self._is_whole and isinstance(self._tree, CostToGoTree):
            self._tree.point(starts)
        self._note(starts, half)

    def expect(self, cells: Any) -> None:
        """Notes cells from which queries will come, such as those of a standby's followers: growths will reach
        them."""
        if self.ready and self._can_stop:
            starts, _, half = self._find_starts(cells)
            self._note(starts, half)

    def _note(self, starts: NDArray[np.int64], half: int) -> None:
        """Notes padded cells that asked, and how far a growth must go for them."""
        if not starts.size:
            return
        if (self._is_whole or self._too_far) and self._without_path(starts).size:
            half = self._grid.cells
        self._askers.note(starts, self._grid.around(self._tree.root, half).cells)

    def _leads(self, starts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Returns from which of some padded, passable cells the tree leads to its root."""
        if not self._is_whole:
            return self._growth.cost[starts] < np.inf
        root = self._tree.root
        return (
            (self._tree.parent[starts] != NONE) | (starts == self.cost_grid.pad(root)) if root >= 0 else starts < 0
        )

    def _without_path(self, starts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of some padded cells from which the tree leads nowhere, or not yet."""
        return starts[~self._leads(starts)]

    def _open(self, cells: Any) -> NDArray[np.int64]:
        """Those of some numbers that are passable cells of the grid, padded."""
        return self._find_starts(cells)[0]

    def _find_starts(self, cells: Any) -> tuple[NDArray[np.int64], int, int]:
        """Returns those of some numbers that are passable cells of the grid, padded; how many of them a growth that
        has stopped did not reach; and how many rows or columns the farthest is away from the root."""
        asked = _in_a_row(cells)
        grid, starts = self.cost_grid, np.empty(asked.size, np.int64)
        found = grid.cell_cost, self._growth.cost, grid.stride, grid.pad(self._tree.root), asked, starts
        count, unknown, half = open_cells(*found)
        return starts[:count], unknown, half

    def _force_near(self, wanted: NDArray[np.int64]) -> Update | None:
        """Makes the tree exact as far as these cells are; None if that takes too long here."""
        tree, growth = self._tree, self._growth
        if not (isinstance(tree, CostToGoTree) and self._can_stop and tree.precise and self._all_kernels()):
            return None
        growth.begin(self.cost_grid.pad(tree.root))
        starts = self._open(wanted)
        grown = growth.go_on(starts, self.times.most_cells)
        if grown < 0 or (growth.bound < np.inf and not (growth.cost[starts] < np.inf).all()):
            return None
        return Update("forced", tree.merge_grown(growth), grown + 1)

    @property
    def _in_pieces(self) -> bool:
        """Returns True if the row in force wants the tree in pieces."""
        return self.times.in_pieces and self.strategy.on_move is OnMove.EXACT_MOVE

    def _bounds_are_old(self) -> None:
        self._bounds.forget()
        self._is_better_bound = True

    def _repair(self, changes: Changes | None) -> Update | None:
        """Brings the tree up to date with the map; None if it must be grown instead."""
        if changes is None:
            return None
        if changes.cells.size == 0:
            return Update("none")
        tree = self._tree
        if not tree.fine or not self.cost_grid.cell_cost[self.cost_grid.pad(tree.root)] < np.inf:
            return None
        if not self._all_kernels():
            return None
        began_ns = self._stopwatch()
        visited = tree.repair(changes)
        if visited < 0 or not tree.fine:
            return None
        window, took_ns = self.cost_grid.window_of(changes.cells), self._stopwatch() - began_ns
        return Update("repair", window, visited, repair_ns=took_ns)

    @property
    def _can_mend(self) -> bool:
        """Returns True if the tree can be made exact here and now, by its parents. Where exact trees are in pieces,
        to make another exact takes as long as to grow it."""
        fits = isinstance(self._tree, partitioned_tree.PartitionedTree) or not self.times.in_pieces
        return fits and self.times.mends_quickly and self._all_kernels() and self._tree.fine

    def _mend(self) -> Update:
        """Makes the tree exact; where a growth costs less, grow it or ask a worker to."""
        tree = self._tree
        cells = tree.mend()
        if not tree.exact:
            if not tree.fine or self._is_quick:
                return self._grow_full(tree.root)
            return Update("window", self._grid.window, cells, wants_full=not self._job_out)
        self._windows.note_whole(tree.root)
        self._bounds_are_old()
        return Update("exact", self._grid.window, cells)

    def _renew(self, done: Update) -> Update:
        """Handles a due full search, after the work in `done`."""
        if not self._can_mend or self._state is State.BEHIND:
            return Update(done.kind, done.window, done.cells, wants_full=True)
        mended = self._mend()
        return Update(mended.kind, mended.window, done.cells + mended.cells, mended.wants_full)

    def _grow_window(self, target_cell: int, half: int) -> tuple[Window | None, int]:
        """Leads to the target's new cell by a window that reaches so far to every side, or further where that does
        not connect it to the old one. Returns it, None where a growth of the whole tree costs less; and the cells
        grown."""
        cells = 0
        window = self._grid.around(target_cell, half)
        while window.cells * 2 < self._grid.cells and self.times.is_quick(window.cells):
            connected = self._tree.move(target_cell, window)
            cells += window.cells
            if connected:
                self._windows.note_window(target_cell, half)
                return window, cells
            half *= 2
            window = self._grid.around(target_cell, half)
        return None, cells

    def _is_full_due(self, done: Update) -> bool:
        """Returns True if a full search is due after this work, unless one is under way."""
        if done.kind in ("full", "exact") or done.wants_full or self._job_out:
            return False
        costs_ns = self.times.exact_ns if self._can_mend else self.times.full_ns
        moves = self._windows.moves
        return self.strategy.renews_within_budget and moves > 0 and moves * self.times.budget_ns >= costs_ns

    def _inside(self, cells: Any) -> NDArray[np.int64]:
        asked = _in_a_row(cells)
        return asked[(asked >= 0) & (asked < self._grid.cells)]


def _in_a_row(cells: Any) -> NDArray[np.int64]:
    """Numbers as kernels take them: side by side in memory, whatever list or part of an array they are."""
    return np.ascontiguousarray(cells, np.int64).reshape(-1)
