"""The vehicles that follow one target, or go to places: their routes, and whose is due to be pushed. Pure.

`MapIntake` decides which map changes wait for the tree, and for how long. To repair a tree costs about the same
however many cells have changed. With hundreds of vehicles that see something new in every tick, somewhere, a
planner that repaired in every tick did little else. A change that no follower's route passes is nothing to push; so
it waits, but not long. Any change is applied within about a second, after the pause that `planner.cpu_budget`
demands (`Planner`); no served route passes a waiting change.

`GapStatistics` has the gap of their routes to the optimum:

certified_gap_excess  proven, of every route served: its cost over its lower bound, less 1
gap_excess            measured at full growths: cost of each follower's old route over the new optimum, less 1
broken_certificates   routes whose cost is below their lower bound, and offers below what an exact tree proves:
                      none, unless there is a bug
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.target_tree import TargetTree
from shared_map.cost_map import CostMap
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window, step_offsets, walk
from swarm.runtime.stats import Counters
from swarm.wire.fields import column
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.route_columns import LETHAL_START, UNREACHABLE, Route, RouteBatch, RouteOutline, RouteStatus

_NOWHERE_BOUNDS = (0, 0, 0, 0)
"""An empty window, which no change of the map touches."""


@dataclass(slots=True, eq=False)
class Follower:
    """One vehicle, as its planner knows it. Not the `Follower` of `vehicle_agent.driving`, a route as a vehicle
    drives it.

    cell       on its path, by its agent's last report or its own request: where a new route for it begins
    route      its last route from this incarnation of the planner; None if there is none
    bounds     row0, col0, row1, col1 of that route with its neighbour cells
    walked     the cells of that route; None until they are needed
    stale      there may be a better route than the one it has
    push_ns    earliest time of its next push
    goal       the cell of the place to which it goes; None if it follows the target
    """

    cell: int
    max_cells: int
    heard_ns: int
    goal: int | None = None
    route: Route | None = None
    bounds: tuple[int, int, int, int] = _NOWHERE_BOUNDS
    walked: list[int] | None = None
    stale: bool = False
    push_ns: int = 0

    def cells(self, grid: GridSpec) -> list[int]:
        """Those of its route, empty without one."""
        if self.walked is None:
            route = self.route
            found = route is not None and route.status is RouteStatus.OK
            self.walked = walk(grid, route.start, route.directions) if route is not None and found else []
        return self.walked


@dataclass(frozen=True, slots=True)
class _Report:
    """The newest message of one agent: whom it named, when by its own clock, and when that was heard."""

    ids: frozenset[str]
    stamp_ns: int
    heard_ns: int


class Batch(NamedTuple):
    """Followers whose routes are read together: to one goal, of as many cells."""

    goal: int | None
    max_cells: int


_WORTH_PUSHING = (RouteStatus.OK, RouteStatus.UNREACHABLE)
"""A vehicle wants to know of a way, and that there is none any more."""
CAPACITY = 4096
"""Followers at most: any client may ask for vehicles that do not exist."""
MOST_PUSHES = 256
"""Routes pushed in one tick at most, so that a tick stays short however many followers a change concerns."""


class Followers:
    """The followers of one target, at most `CAPACITY`, each on a cell of the grid.

    Registered by a request that names them, or by their agent's message that they chase this target; dropped if
    that agent no longer names them, after a lease without messages, or, when full, oldest first. A vehicle that is
    dropped so is registered again by its agent's next message.
    """

    def __init__(self, grid: GridSpec, lease_ns: int, max_cells: int) -> None:
        self._grid = grid
        self._lease_ns = lease_ns
        self._max_cells = max_cells
        self._by_id: dict[str, Follower] = {}
        self._reports: dict[str, _Report] = {}
        """Agent's name as an author -> its newest message, for the lease."""

    def __len__(self) -> int:
        return len(self._by_id)

    def ids(self) -> Iterable[str]:
        return self._by_id.keys()

    def all_items(self) -> Iterable[tuple[str, Follower]]:
        return self._by_id.items()

    @property
    def cells(self) -> NDArray[np.int64]:
        """int64 (followers,): the cell of each follower."""
        return np.fromiter((follower.cell for follower in self._by_id.values()), np.int64, len(self._by_id))

    def on_chasers(self, chasers: Chasers, now_ns: int) -> None:
        """Sets the vehicles of an agent that chase the target, and their cells. Ignored if older than the last."""
        before = self._reports.get(chasers.author)
        if before is not None and chasers.stamp_ns < before.stamp_ns:
            return
        report = _Report(frozenset(chasers.ids), chasers.stamp_ns, now_ns)
        if before is not None:
            for id in before.ids - report.ids:
                self._by_id.pop(id, None)
        elif len(self._reports) >= CAPACITY:
            del self._reports[next(iter(self._reports))]
        self._reports[chasers.author] = report
        goals: list[int] | list[None] = [None] * len(chasers.ids)
        if chasers.target is None:
            goals = column(chasers.goals, "<u4").tolist()
        for id, cell, goal in zip(chasers.ids, column(chasers.cells, "<u4").tolist(), goals, strict=True):
            follower = self._by_id.get(id)
            if cell >= self._grid.cells:
                self._by_id.pop(id, None)
            elif follower is None:
                self._register(id, Follower(cell, self._max_cells, now_ns, goal))
            else:
                follower.cell, follower.heard_ns = cell, now_ns
                if follower.goal != goal:
                    follower.goal = goal
                    self._forget_route(follower)

    def given(
        self, vehicle: str, route: Route, max_cells: int, now_ns: int, push_ns: int, goal: int | None = None
    ) -> None:
        """Notes the route that a request of a vehicle received. A start outside the grid is ignored."""
        if not 0 <= route.start < self._grid.cells:
            return
        follower = self._by_id.get(vehicle)
        if follower is None:
            follower = self._register(vehicle, Follower(route.start, max_cells, now_ns))
        follower.cell, follower.max_cells, follower.heard_ns, follower.goal = route.start, max_cells, now_ns, goal
        self.sent(follower, route, push_ns)

    def sent(self, follower: Follower, route: Route, push_ns: int) -> None:
        follower.route, follower.stale, follower.push_ns = route, False, push_ns
        follower.bounds = self._bounds(route) if route.status is RouteStatus.OK else _NOWHERE_BOUNDS
        follower.walked = None

    def _bounds(self, route: Route) -> tuple[int, int, int, int]:
        """Outer bounds of a route, from its step counts: ten times as fast as walking it, and routes which turn
        back are few."""
        row, col = divmod(route.start, self._grid.cols)
        n, ne, e, se, s, sw, w, nw = map(route.directions.count, range(8))
        return row - (nw + n + ne) - 1, col - (sw + w + nw) - 1, row + se + s + sw + 2, col + ne + e + se + 2

    def forget_routes(self) -> None:
        """Forgets all given routes after another planner has given some: the next route is new to every
        follower."""
        for follower in self._by_id.values():
            self._forget_route(follower)

    def _forget_route(self, follower: Follower) -> None:
        follower.route, follower.stale, follower.push_ns = None, True, 0
        follower.bounds, follower.walked = _NOWHERE_BOUNDS, None

    def _register(self, vehicle: str, follower: Follower) -> Follower:
        if len(self._by_id) >= CAPACITY:
            del self._by_id[next(iter(self._by_id))]
        self._by_id[vehicle] = follower
        return follower

    def drop_silent(self, now_ns: int) -> None:
        for id in [id for id, each in self._by_id.items() if now_ns - each.heard_ns > self._lease_ns]:
            del self._by_id[id]
        for author in [author for author, each in self._reports.items() if now_ns - each.heard_ns > self._lease_ns]:
            del self._reports[author]

    def any_due_in(self, changed: Sequence[Window], now_ns: int) -> bool:
        """Returns True if one of these windows lies on the route of a follower which may be pushed another now."""
        return any(now_ns >= each.push_ns and self._crosses(each, window) for each, window in self._near(changed))

    def touch(self, window: Window, changed: Sequence[Window]) -> None:
        """Marks the routes concerned stale: the tree is new inside a window, and the map changed in others."""
        fresh = [follower for follower in self._by_id.values() if not follower.stale]
        cells = np.fromiter((follower.cell for follower in fresh), np.int64, len(fresh))
        rows, cols = np.divmod(cells, self._grid.cols)
        inside = (rows >= window.row0) & (rows < window.row1) & (cols >= window.col0) & (cols < window.col1)
        for n in np.flatnonzero(inside).tolist():
            fresh[n].stale = True
        for follower, near in self._near(changed):
            follower.stale = follower.stale or self._crosses(follower, near)

    def due(self, now_ns: int) -> dict[Batch, list[tuple[str, Follower]]]:
        """Followers with a stale route that may be pushed another one, grouped by goal and length; of too many,
        those that waited longest. From now on their routes are not stale."""
        due = [(id, each) for id, each in self._by_id.items() if each.stale and now_ns >= each.push_ns]
        if len(due) > MOST_PUSHES:
            due = sorted(due, key=lambda item: item[1].push_ns)[:MOST_PUSHES]
        batches: dict[Batch, list[tuple[str, Follower]]] = {}
        for id, follower in due:
            follower.stale = False
            batches.setdefault(Batch(follower.goal, follower.max_cells), []).append((id, follower))
        return batches

    def pushed(
        self, batch: Iterable[tuple[str, Follower]], routes: RouteBatch, push_ns: int
    ) -> Iterator[tuple[str, Route]]:
        """Returns those of the routes that are new to their followers, in order."""
        for index, ((id, follower), outline) in enumerate(zip(batch, routes.outlines(), strict=True)):
            if outline.status in _WORTH_PUSHING and self.is_news(follower, outline):
                route = routes[index]
                self.sent(follower, route, push_ns)
                yield id, route

    def get(self, vehicle: str) -> Follower | None:
        return self._by_id.get(vehicle)

    def mark_stale(self, vehicle: str) -> None:
        """Notes that a vehicle's route may not be the best any more."""
        if vehicle in self._by_id:
            self._by_id[vehicle].stale = True

    def is_news(self, follower: Follower, route: RouteOutline) -> bool:
        """Returns True if a route is new to the follower: other steps, or no path."""
        old = follower.route
        if old is None or old.status is not route.status:
            return True
        if route.status is not RouteStatus.OK:
            return False
        driven = self._steps_to(old, route.start)
        if driven is None:
            return True
        rest = old.directions[driven:]
        # An extension of the same route is not pushed until half of the old one is driven.
        if old.remaining_s > 0 and route.remaining_s > 0 and 2 * len(rest) >= len(route.directions):
            return not route.directions.startswith(rest)
        return rest != route.directions

    def _steps_to(self, route: Route, cell: int) -> int | None:
        """After how many of its steps a route first comes to a cell; None if it does not."""
        at, offsets = route.start, step_offsets(self._grid.cols)
        for steps, direction in enumerate(route.directions):
            if at == cell:
                return steps
            at += offsets[direction]
        return len(route.directions) if at == cell else None

    def _crosses(self, follower: Follower, window: Window) -> bool:
        """Returns True if the route passes through a window or next to it: a diagonal step depends on the cells
        beside it."""
        rows, cols = np.divmod(np.array(follower.cells(self._grid), np.int64), self._grid.cols)
        inside = (rows >= window.row0 - 1) & (rows <= window.row1)
        return bool((inside & (cols >= window.col0 - 1) & (cols <= window.col1)).any())

    def _near(self, windows: Sequence[Window]) -> Iterator[tuple[Follower, Window]]:
        """Returns pairs of followers and windows that the bounds of the route meet."""
        if not windows or not self._by_id:
            return
        followers = list(self._by_id.values())
        row0, col0, row1, col1 = np.array([each.bounds for each in followers], np.int64).T[:, :, None]
        each = np.array([(w.row0, w.col0, w.row1, w.col1) for w in windows], np.int64).T
        near = (row0 < each[2]) & (each[0] < row1) & (col0 < each[3]) & (each[1] < col1)
        for n, m in zip(*map(np.ndarray.tolist, near.nonzero()), strict=True):
            yield followers[n], windows[m]


LONGEST_WAIT_NS = NS_PER_S
"""A change waits no longer, however seldom routes are pushed."""


class MapIntake:
    """Gives the changes of a map to the tree of one target, and decides whether waiting ones are due."""

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
        """Notes the gaps measured when a worker's tree replaced the one that was offered until now."""
        self._offered(tree.last_gaps)
        self._count_broken(int(np.count_nonzero(tree.last_gaps < 1.0)))
        self._due_ns = now_ns + _EVERY_NS

    def record_growth(self, tree: TargetTree, followers: Followers, now_ns: int) -> None:
        """Measures the gaps of a tree that was grown on this thread, over the cells of all followers."""
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
