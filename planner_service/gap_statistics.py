"""Statistics of one planner about the gap of its routes to the optimum. Pure.

certified_gap_excess  proven, of every route served: its cost over its lower bound, less 1
gap_excess            measured at full growths: cost of each follower's old route over the new optimum, less 1
broken_certificates   routes whose cost is below their lower bound, and offers below what an exact tree proves:
                      none, unless there is a bug
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.followers import Followers
from planner_service.target_tree import TargetTree
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.runtime.stats import Counters
from swarm.wire.route_columns import RouteBatch

_EVERY_NS = NS_PER_S
_MOST = 64
"""Followers that are measured at a time, evenly chosen: to read a route takes as long as a small growth."""

Gaps = NDArray[np.float64]


class GapStatistics:
    """Measured gaps of one planner's routes. `last` is mean, p95 and highest of the last full growth."""

    def __init__(self, config: PlannerConfig, counters: Counters) -> None:
        self.last: tuple[float, float, float] | None = None
        self._counters = counters
        self._length_weight = config.length_weight
        self._due_ns = 0

    def certify(self, routes: RouteBatch) -> float:
        """Notes the proven gaps of served routes. Returns the widest, at least 1."""
        gaps = routes.gaps
        # The histogram would take a route below its bound for one that is proven optimal.
        self._count_broken(int(np.count_nonzero(routes.lower_bound_s > routes.cost_s)))
        self._counters.observe_all("certified_gap_excess", gaps - 1.0)
        return float(gaps.max(initial=1.0))

    def adopted(self, tree: TargetTree, now_ns: int) -> None:
        """A worker's tree has replaced the one that was offered until now, and has been compared with it."""
        self._offered(tree.last_gaps)
        self._count_broken(int(np.count_nonzero(tree.last_gaps < 1.0)))
        self._due_ns = now_ns + _EVERY_NS

    def record_growth(self, tree: TargetTree, followers: Followers, now_ns: int) -> None:
        """A tree was grown on this thread: what it offers is read and compared with what it promises."""
        if now_ns < self._due_ns or not len(followers):
            return
        self._due_ns = now_ns + _EVERY_NS
        every = followers.cells
        cells = every[:: -(-every.size // _MOST)]
        routes = tree.routes(cells, 0)
        driven = routes.cost_s + self._length_weight * routes.length_m
        optimum = tree.cost_to_go_at(cells).astype(np.float64)
        given = np.isfinite(driven) & np.isfinite(optimum) & (optimum > 0)
        self._offered(driven[given] / optimum[given])

    def _offered(self, gaps: Gaps) -> None:
        gaps = gaps[np.isfinite(gaps)]
        if not len(gaps):
            return
        self.last = (float(gaps.mean()), float(np.quantile(gaps, 0.95)), float(gaps.max()))
        self._counters.observe_all("gap_excess", gaps - 1.0)

    def _count_broken(self, many: int) -> None:
        self._counters.count("broken_certificates", many)
