"""Intake of map changes by the planner of one target: which changes wait, and for how long. Pure.

To repair a tree costs about the same however many cells have changed. With hundreds of vehicles that see something
new in every tick, somewhere, a planner that repaired in every tick did little else. A change that no follower's
route passes is nothing to push; so it waits, but not long. Any change is applied within about a second, after the
pause that `planner.cpu_budget` demands (`Planner`); no served route passes a waiting change.
"""

from __future__ import annotations

import numpy as np

from planner_service.followers import Followers
from shared_map.cost_map import CostMap
from swarm.clock import NS_PER_S
from swarm.grid import Window
from swarm.wire.route_columns import LETHAL_START, UNREACHABLE, RouteBatch

LONGEST_WAIT_NS = NS_PER_S
"""A change waits no longer, however seldom routes are pushed."""


class MapIntake:
    """Changes of one map that the tree of one target does not know, and whether they may wait."""

    def __init__(self, cost_map: CostMap, followers: Followers) -> None:
        self._cost_map = cost_map
        self._followers = followers
        self._taken_ns: int | None = None
        """Time of the last ones; None before."""

    def take(self, now_ns: int) -> list[Window]:
        """Returns the changes since the last call, for the tree to apply now."""
        if self._cost_map.dirty:
            self._taken_ns = now_ns
        return self._cost_map.take_dirty()

    def is_due(self, now_ns: int, wait_ns: int) -> bool:
        """Returns True if waiting changes are to be applied now: because the last update was so long ago, or
        because they lie on the route of a follower that may be pushed another."""
        wait_ns = min(wait_ns, LONGEST_WAIT_NS)
        if self._taken_ns is None or not 0 <= now_ns - self._taken_ns < wait_ns:
            return True
        return self._followers.any_due_in(self._cost_map.dirty, now_ns)

    def concerns(self, routes: RouteBatch) -> bool:
        """Returns True if waiting changes lie on one of these routes or next to it, or may open a path where there
        is none."""
        windows = self._cost_map.dirty
        if not windows:
            return False
        statuses = routes.statuses.tobytes()
        if UNREACHABLE in statuses or LETHAL_START in statuses:
            return True
        rows, cols = routes.places(self._cost_map.grid)
        if not rows.size:
            return False
        bounds = Window(int(rows.min()), int(cols.min()), int(rows.max()) + 1, int(cols.max()) + 1)
        return any(
            bool(np.any((rows >= w.row0 - 1) & (rows <= w.row1) & (cols >= w.col0 - 1) & (cols <= w.col1)))
            for w in windows
            if w.touches(bounds)
        )
