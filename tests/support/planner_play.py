"""A target's tree, its map, and the changes of both."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
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
from swarm.wire.route_columns import LETHAL_START, NO_TARGET, OK, UNREACHABLE, RouteBatch

_MARKED = np.array([np.inf, 0.5, 1.0, 20.0, 500.0, PACE_LEAST, PACE_MOST], np.float32)
"""s/m: what a mark makes of a cell, up to the bounds of the wire. Another may undo it."""

Seconds = NDArray[np.float64]
LAWS = {
    "status": "a cell has a route exactly where there is a way",
    "legal": "a route breaks no rule and ends at the target",
    "bound": "no way is quicker than the lower bound",
    "optimum": "no route is quicker than the best way",
    "stated": "a whole route's stated cost is driven, within 1e-6",
    "cut": "a cut route's stated cost is driven, and so is what remains, within 1e-6",
    "batch": "a route has the same numbers alone, in a batch and asked for again",
    "exact": "the route of an exact tree is as good as any, within float32",
}
"""Checks of every route, and the name of each violation."""

STATED = 1e-6
"""Relative; what a stated cost may be off by."""
FLOAT64 = 1e-12
"""Relative; sums of float64 over other orders of the same steps."""


def above(one: Seconds, other: Seconds) -> Seconds:
    """Relative excess of one over the other; 0 where it is not larger."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(one <= other, 0.0, one / other - 1.0)


def apart(one: Seconds, other: Seconds) -> Seconds:
    return np.maximum(above(one, other), above(other, one))


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
        self.chosen_by = chosen_by
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

    def best_s(self, length_weight: float = 0.0) -> Seconds:
        """The cheapest way from every cell, by the oracle."""
        cost = naive.cost_to_go(self.pace, self.led_to, **self.rules, length_weight=length_weight)
        return self.grid.resolution_m * cost.reshape(-1)

    @property
    def led_to(self) -> int:
        """The target or, while a worker grows, the cell that the tree leads to."""
        led_to = self.tree.target_cell if self.has_worker else self.target
        assert led_to is not None
        return led_to

    def driven(self, routes: RouteBatch) -> naive.Driven:
        return naive.drive(self.grid, self.config, self.pace, self.rules["climb"], routes)

    def measured(
        self, best_s: Seconds, whole: RouteBatch, *cut: RouteBatch
    ) -> Iterator[tuple[str, Seconds, float]]:
        """For each of `LAWS` but "batch": how far routes from every cell are off, relative, and what is allowed.

        best_s  of the cheapest way from every cell, by the oracle (`best_s`)
        cut     parts of the routes
        """
        expected = np.where(np.isfinite(best_s), OK, UNREACHABLE)
        expected[~np.isfinite(self.pace).reshape(-1)] = LETHAL_START
        there = np.isfinite(best_s)
        for routes in (whole, *cut):
            beyond = (routes.statuses == NO_TARGET) & self.has_worker  # farther than the first growth could go
            yield "status", np.where((routes.statuses == expected) | beyond, 0.0, math.inf), 0.0
            yield "bound", above(routes.lower_bound_s[there], best_s[there]), FLOAT64
        there &= np.logical_and.reduce([routes.statuses == OK for routes in (whole, *cut)])
        driven = self.driven(whole)
        time_s, astray = driven.time_s[there], driven.last[there] != self.led_to
        yield "legal", np.where(astray, math.inf, 0.0), 0.0
        if astray.any():
            return
        yield "stated", apart(whole.cost_s[there], time_s), STATED
        for part in cut:
            rest_s = driven.time_s[self.driven(part).last[there]]
            yield "cut", apart(part.cost_s[there], time_s), STATED
            yield "cut", apart(part.remaining_s[there], rest_s), STATED
        yield "optimum", above(best_s[there], time_s), FLOAT64
        # A strategy of a test may choose a row that this tree is not made by yet.
        exact = self.tree._tree.exact or (self.tree.strategy.is_exact and self.chosen_by is None)
        if exact and not self.has_worker:
            weight = self.config.length_weight
            asked, best = time_s + weight * whole.length_m[there], self.best_s(weight) if weight else best_s
            yield "exact", above(asked, best[there]), self.grid.cells * 2.0**-23

    def check(self) -> None:
        """The laws, lengths and upper bounds, for a route from every cell."""
        routes = self.tree.routes(np.arange(self.grid.cells))
        waits = self.has_worker and not self.tree.ready
        if waits or not np.isfinite(self.pace.flat[self.target]):
            assert (routes.statuses == NO_TARGET).all()
            return
        assert self.has_worker or self.tree.target_cell == self.target
        best_s, beyond = self.best_s(), routes.statuses == NO_TARGET
        assert not beyond.any() or not self.tree._is_whole
        assert (routes.lower_bound_s[beyond] <= best_s[beyond]).all()
        for law, off, allowed in self.measured(best_s, routes):
            assert (off <= allowed).all(), LAWS[law]
        odd, begins = np.append(0, np.cumsum(routes.directions & 1)), np.append(0, routes.ends[:-1])
        slant = math.sqrt(2) - 1 if self.config.neighbours == 8 and self.config.edge == "octile" else 0.0
        steps = routes.ends - begins + slant * (odd[routes.ends] - odd[begins])
        served = np.flatnonzero(routes.statuses == OK)
        np.testing.assert_allclose(routes.length_m[served], self.grid.resolution_m * steps[served], rtol=1e-5)
        assert (self.tree.cost_to_go_at(served) >= self.driven(routes).time_s[served] * (1 - 1e-4)).all()
        if self.config.strategy in ("full", "exact") and not self.has_worker:
            np.testing.assert_allclose(routes.cost_s[served], best_s[served], rtol=1e-5)
            self.check_equals_a_growth()
