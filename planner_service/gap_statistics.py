"""Statistics of one planner about the gap of its routes to the optimum. Pure.

certified_gap_excess  proven, of every route served: its cost over its lower bound, less 1
gap_excess            measured at full growths: driven cost over optimum of what the tree offered each follower
broken_certificates   routes whose cost is below their lower bound, and offers below what an exact tree proves:
                      none, unless there is a bug
held_gap_excess       measured at full growths: driven cost over optimum of going on along the route that a
                      follower was given last, and from its end by the cheapest way
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from planner_service.followers import Follower, Followers
from planner_service.target_tree import TargetTree
from shared_map.terrain.step_climb import Climb
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec
from swarm.runtime.stats import Counters
from swarm.wire.route_columns import RouteBatch

_EVERY_NS = NS_PER_S
_MOST = 64
"""Followers that are measured at a time, evenly chosen: to read a route takes as long as a small growth."""

Gaps = NDArray[np.float64]


class GapStatistics:
    """Measured gaps of one planner's routes. `last` is mean, p95 and highest of the last full growth."""

    def __init__(
        self, grid: GridSpec, config: PlannerConfig, counters: Counters, climb: Climb | None = None
    ) -> None:
        self.last: tuple[float, float, float] | None = None
        self._counters = counters
        self._climb = climb
        self._grid = grid
        self._length_weight = config.length_weight
        self._straight_m = grid.resolution_m
        self._diagonal_m = grid.resolution_m * (math.sqrt(2) if config.edge == "octile" else 1.0)
        self._due_ns = 0

    def certify(self, routes: RouteBatch) -> float:
        """Notes the proven gaps of served routes. Returns the widest, at least 1."""
        gaps = routes.gaps
        # The histogram and `gaps` would take a route below its bound for one that is proven optimal.
        self._count_broken(int(np.count_nonzero(routes.lower_bound_s > routes.cost_s)))
        self._counters.observe_all("certified_gap", gaps)
        self._counters.observe_all("certified_gap_excess", gaps - 1.0)
        return float(gaps.max(initial=1.0))

    def adopted(self, tree: TargetTree, followers: Followers, pace: NDArray[np.float32], now_ns: int) -> None:
        """A worker's tree has replaced the one that was offered until now, and has been compared with it."""
        self._offered(tree.last_gaps)
        self._count_broken(int(np.count_nonzero(tree.last_gaps < 1.0)))
        self._due_ns = now_ns + _EVERY_NS
        self._held(tree, _some(followers), pace)

    def record_growth(self, tree: TargetTree, followers: Followers, pace: NDArray[np.float32], now_ns: int) -> None:
        """A tree was grown on this thread: what it offers is read and compared with what it promises."""
        if now_ns < self._due_ns or not len(followers):
            return
        self._due_ns = now_ns + _EVERY_NS
        some = _some(followers)
        cells = [follower.cell for follower in some]
        routes = tree.routes(cells, 0)
        driven = routes.cost_s + self._length_weight * routes.length_m
        self._offered(_ratios(driven, tree.cost_to_go_at(cells)))
        self._held(tree, some, pace)

    def _offered(self, gaps: Gaps) -> None:
        gaps = gaps[np.isfinite(gaps)]
        if not len(gaps):
            return
        self.last = (float(gaps.mean()), float(np.quantile(gaps, 0.95)), float(gaps.max()))
        self._counters.observe_all("gap", gaps)
        self._counters.observe_all("gap_excess", gaps - 1.0)

    def _count_broken(self, many: int) -> None:
        self._counters.count("broken_certificates", many)

    def _held(self, tree: TargetTree, followers: Sequence[Follower], pace: NDArray[np.float32]) -> None:
        starts, rests = list[int](), list[list[int]]()
        for follower in followers:
            route = follower.cells(self._grid)
            if follower.cell in route:  # else it has left the route, or has none
                starts.append(follower.cell)
                rests.append(route[route.index(follower.cell) :])
        if not starts:
            return
        cells = np.fromiter(chain.from_iterable(rests), np.int64)
        of = np.repeat(np.arange(len(rests)), [len(rest) for rest in rests])
        steps = np.flatnonzero(of[1:] == of[:-1])
        tails, heads = cells[steps], cells[steps + 1]
        rows, cols = np.divmod(heads, self._grid.cols)
        diagonal = (tails // self._grid.cols != rows) & (tails % self._grid.cols != cols)
        metres = np.where(diagonal, self._diagonal_m, self._straight_m)
        paces = pace[rows, cols].astype(np.float64)
        if self._climb is not None:
            paces *= self._climb.along(tails, heads)
        driven = np.zeros(len(rests))
        np.add.at(driven, of[steps], (paces + self._length_weight) * metres)
        whole = driven + tree.cost_to_go_at([rest[-1] for rest in rests]).astype(np.float64)
        self._counters.observe_all("held_gap_excess", _ratios(whole, tree.cost_to_go_at(starts)) - 1.0)


def _some(followers: Followers) -> list[Follower]:
    every = [follower for _, follower in followers.all_items()]
    return every[:: -(-len(every) // _MOST) or 1]


def _ratios(driven: Gaps, optimum: NDArray[np.float32]) -> Gaps:
    """Cost over optimum where both are finite and there is any way to go."""
    given = np.isfinite(driven) & np.isfinite(optimum) & (optimum > 0)
    return np.asarray(driven[given] / optimum[given].astype(np.float64), np.float64)
