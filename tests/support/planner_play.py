"""A target's tree, its map, and the changes of both."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from support import slow_twins as naive
from support.kernel_oracle import inner
from support.planner_strategies import Job, Marks, Move

from planner_service.kernels.stride_networks import StrideNetwork
from planner_service.strategy import Strategy
from planner_service.target_tree import TargetTree
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.partitioned_tree import GrownTree, PartitionedTree
from shared_map.terrain.slope_and_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST
from swarm.wire.route_columns import RouteStatus

_MARKED = np.array([np.inf, 0.5, 1.0, 20.0, 500.0, PACE_LEAST, PACE_MOST], np.float32)
"""s/m: what a mark makes of a cell, up to the bounds of the wire. Another may undo it."""


class Play:
    """A tree, its map, and the job that a worker may have of it.

    grid        of the map; cells of a metre by default
    target      where the target begins; by default on the first passable cell
    has_worker  long growths are left to that job: until it is adopted, answers are about where the target was
    in_pieces   the tree lies in pieces, as if the map were large
    """

    def __init__(
        self,
        pace: np.ndarray,
        config: PlannerConfig,
        all_kernels: Callable[[], bool] = lambda: True,
        *,
        has_worker: bool = False,
        chosen_by: Strategy | None = None,
        climb: Climb | None = None,
        grid: GridSpec | None = None,
        target: int | None = None,
        in_pieces: bool = False,
    ) -> None:
        self.pace = pace
        self.config = config
        rows, cols = pace.shape
        self.grid = grid or GridSpec(rows, cols, 1.0)
        self.tree = TargetTree(self.grid, config, climb, all_kernels, has_worker=has_worker, chosen_by=chosen_by)
        self.tree.times.in_pieces |= in_pieces
        self.has_worker = has_worker
        self.version = 0
        self.target = int(np.flatnonzero(np.isfinite(pace))[0]) if target is None else target
        self.grown: GrownTree | None = None
        self.search: Callable[[], StrideNetwork] | None = None
        self.since: list[Window] = []
        self.rules: dict[str, Any] = {
            "climb": climb,
            "neighbours": config.neighbours,
            "edge": config.edge,
            "corner_cutting": config.corner_cutting,
        }
        self.last = self.tree.update(self.pace, self.target, [], 0)

    def happen(self, event: Move | Marks | Job) -> None:
        if isinstance(event, Move):
            row, col = self.grid.row_col(self.target)
            row = min(max(row + event.rows, 0), self.grid.rows - 1)
            col = min(max(col + event.cols, 0), self.grid.cols - 1)
            self.target = row * self.grid.cols + col
            self.last = self.tree.update(self.pace, self.target, [], self.version)
        elif isinstance(event, Marks):
            window = self._mark(event)
            self.since.append(window)
            self.version += 1
            self.tree.update(self.pace, self.target, [window], self.version)
        elif event.what == "begin":
            job = self.tree.full_job(self.target)
            self.grown = job()
            if self.tree.wants_strides:
                self.search = self.tree.stride_job()
            self.since = []
        elif event.what == "end" and self.grown is not None:
            self.tree.adopt(
                self.grown, self.pace, self.target, self.since, self.version, np.arange(self.grid.cells)
            )
            self.grown = None
            if self.search is not None:
                self.tree.take_strides(self.search())
                self.search = None
        elif event.what == "force":
            self.tree.force([0, self.grid.cells - 1])

    def walk(self, rng: np.random.Generator, steps: int, check_every: int) -> set[str]:
        """Moves to random neighbours, with marks and a worker's growths now and then. Returns the kind of
        growth."""
        kinds: set[str] = set()
        for step in range(steps):
            self.happen(Move(int(rng.integers(-1, 2)), int(rng.integers(-1, 2))))
            kinds.add(self.last.kind)
            if step % 3 == 0:
                self.happen(Marks(step, 2))
            if step % 10 == 5:
                self.happen(Job("begin"))
            if step % 10 == 8:
                self.happen(Job("end"))
            if step % check_every == 0:
                self.check()
        self.check()
        return kinds

    def check_equals_a_growth(self) -> None:
        """The tree is, in costs and parents, the one that is grown from scratch; in pieces, its costs are nearer to
        the optimum."""
        mine = self.tree._tree
        if isinstance(mine, PartitionedTree):
            cells = mine.cost_grid.pad_all(np.arange(self.grid.cells))
            optimum = naive.cost_to_go(self.pace, mine.root, **self.rules).reshape(-1)
            optimum[~np.isfinite(self.pace.reshape(-1))] = np.inf
            np.testing.assert_allclose(mine.cost_at(cells), optimum, rtol=1e-11)
            return
        fresh = CostToGoTree(mine.cost_grid)
        fresh.grow(mine.root)
        np.testing.assert_array_equal(np.abs(inner(mine, mine.cost)), inner(fresh, fresh.cost))
        np.testing.assert_array_equal(inner(mine, mine.parent), inner(fresh, fresh.parent))

    def _mark(self, event: Marks) -> Window:
        rng = np.random.default_rng(event.seed)
        window = Window(0, 0, 0, 0)
        for _ in range(event.count):
            row, col = int(rng.integers(self.grid.rows)), int(rng.integers(self.grid.cols))
            self.pace[row, col] = rng.choice(_MARKED)
            window = window.union(Window(row, col, row + 1, col + 1))
        return window

    def check(self) -> None:
        """Laws (a) to (c), certificates and upper bounds, for a route from every cell."""
        routes = self.tree.routes(np.arange(self.grid.cells))
        waits = self.has_worker and not self.tree.ready
        if waits or not np.isfinite(self.pace.flat[self.target]):
            assert all(route.status is RouteStatus.NO_TARGET for route in routes)
            return
        target = self.tree.target_cell
        assert target is not None
        assert self.has_worker or target == self.target
        optimum = naive.cost_to_go(self.pace, target, **self.rules).reshape(-1)
        lethal = ~np.isfinite(self.pace.reshape(-1))
        known = np.ones(self.grid.cells, np.bool_)
        for cell, route in enumerate(routes):
            if lethal[cell]:
                assert route.status is RouteStatus.LETHAL_START
            elif route.status is RouteStatus.NO_TARGET:  # farther than the first growth could go
                assert self.has_worker
                assert not self.tree._is_whole
                assert route.lower_bound_s <= optimum[cell]
                known[cell] = False
            elif not math.isfinite(optimum[cell]):
                assert route.status is RouteStatus.UNREACHABLE
            else:
                assert route.status is RouteStatus.OK
        odd, begins = np.append(0, np.cumsum(routes.directions & 1)), np.append(0, routes.ends[:-1])
        slant = math.sqrt(2) - 1 if self.config.neighbours == 8 and self.config.edge == "octile" else 0.0
        length_m = routes.ends - begins + slant * (odd[routes.ends] - odd[begins])
        served = np.isfinite(optimum) & ~lethal & known
        cells = np.flatnonzero(served)
        last, seconds = naive.drive(self.grid, self.config, self.pace, self.rules["climb"], routes)
        assert (last[cells] == target).all(), "a route enters a lethal cell, squeezes or leaves the grid"
        driven = seconds[cells]
        cost, bound = routes.cost_s[cells], routes.lower_bound_s[cells]
        upper = self.tree.cost_to_go_at(cells)
        best = optimum[cells]
        np.testing.assert_allclose(cost, driven, rtol=1e-6)
        np.testing.assert_allclose(routes.length_m[cells], length_m[cells], rtol=1e-5)
        assert (bound <= best * (1 + 1e-12)).all()
        assert (cost >= best * (1 - 1e-6)).all()
        assert (upper >= driven * (1 - 1e-4)).all()
        if self.config.strategy in ("full", "exact") and not self.has_worker:
            np.testing.assert_allclose(cost, best, rtol=1e-5)
            self.check_equals_a_growth()
