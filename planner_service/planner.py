"""The planner of one target: when to grow, what to answer, to which followers to push newer routes. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner_service.any_angle_routes import Puller, pulls
from planner_service.followers import LONGEST_WAIT_NS, Follower, Followers, GapStatistics, MapIntake
from planner_service.growth_times import MODEL_EXACT_NS_PER_CELL, MODEL_NS_PER_CELL
from planner_service.kernels.stride_networks import StrideNetwork
from planner_service.target_search import Searcher, TargetSearch, Ways, is_place
from planner_service.target_tree import Kind, TargetTree, Update
from planner_service.tracker_notes import TargetWatch
from planner_service.tree.partitioned_tree import GrownTree
from shared_map.cost_map import CostMap, merged
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.config.vehicle_classes import GROUND
from swarm.grid import Window
from swarm.runtime.stats import Counters
from swarm.wire.fields import MOST_VEHICLES, pack_column
from swarm.wire.messages import planning
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.route_columns import Route, RouteBatch

FOLLOWER_LEASE_NS = 5 * NS_PER_S
"""Agents name their vehicles once a second (`topics.CHASERS`): five names in a row are missing."""
STATUS_NS = NS_PER_S // 2
"""Interval of the status (`topics.STATUS`)."""
MAX_GAP = 1.5
"""A served route whose certified gap (cost over proven bound) exceeds this asks for a full growth."""
MOST_ROUTES = MOST_VEHICLES
"""Routes of one answer: for all vehicles of an agent. They take some 10 ms."""
MOST_STEPS = 1 << 19
"""Steps in one answer, some 10 ms: longer routes are cut, as if `max_cells` had asked for that."""
MOST_PULLED_STEPS = MOST_STEPS >> 3
"""The same of routes that are pulled, which cross twice as many cells at most and may have a leg for each step."""
GOOD_GAP = 1.05
"""Under a strategy that goes by proofs, nothing is grown for a route asked for by force that is proven to be this
good already: four of five such growths gave back the route that was there."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A request that is not answered, and why."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Work:
    """Requests a `job` on a worker. Its result goes to `Planner.adopt` or `TargetTree.take_strides`."""

    job: Callable[[], GrownTree] | Callable[[], StrideNetwork]


Answer = planning.RouteReply | planning.CostReply | Refusal
Action = Work | planning.PushedRoute | planning.PlannerStatus | planning.Believed
"""Action of a planner: a search to run, or a message to publish."""

COUNTS = ("routes_served", "growths", "window_growths", "pushes", "costs_served", "growths_late")
SEARCH_COUNTS = ("searches", "search_places")


class Planner:
    """Keeps the tree of one target, and answers from it.

    Each tick applies the newest pose. Changes of the map may wait for a second (`MapIntake`), but no served route
    crosses a waiting change. At most one full growth is under way; what changes meanwhile is applied when it is
    adopted. Before the first tree all routes are NO_TARGET, or SEARCHING while the target is unseen. The cost map
    belongs to the caller, which applies marks to it between calls.

    watch           position of the target, kept by the caller. The planners of all classes share it
    stopwatch       CPU time of this thread, ns; without one growths take what a model says, as in a simulation
    newest_mark_ns  stamp of the newest mark that the map has taken in since this was last asked
    leads           false for a standby, which keeps its tree up to date, pushes nothing and tells no status
    vehicle_class   whose routes these are: what the cost map is for
    target_search   while the target is unseen. All classes share it
    """

    def __init__(
        self,
        watch: TargetWatch,
        incarnation: int,
        config: PlannerConfig,
        tree: TargetTree,
        cost_map: CostMap,
        counters: Counters,
        *,
        route_cells: int = 0,
        target_search: TargetSearch,
        stopwatch: Callable[[], int] | None = None,
        newest_mark_ns: Callable[[], int | None] = lambda: None,
        leads: bool = True,
        vehicle_class: str = GROUND,
    ) -> None:
        self.target = watch.target
        self.vehicle_class = vehicle_class
        self.leads = leads
        self.tree = tree
        self.counters = counters
        self._incarnation = incarnation
        self._config = config
        self._grid = cost_map.grid
        self._cost_map = cost_map
        self._stopwatch = stopwatch
        self._newest_mark_ns = newest_mark_ns
        self._push_ns = int(config.push_s * NS_PER_S)
        self.followers = Followers(self._grid, FOLLOWER_LEASE_NS, route_cells)
        self._intake = MapIntake(cost_map, self.followers)
        self._watch = watch
        # (target cell, map version) of the tree's last update.
        self._taken_in: tuple[int, int] | None = None
        # When the full growth under way was begun, and the map's changes since; None and empty without one.
        self._growing_since_ns: int | None = None
        self._dirty_since_snapshot: list[Window] = []
        # Before this, changes of the map wait, unless a route is to be given that passes one: repairs keep to the
        # budget.
        self._rests_until_ns = 0
        # Stamp of the newest mark that is in the map and not yet in the tree.
        self._unseen_mark_ns: int | None = None
        # A full growth is to begin as soon as none is under way; loose bounds may ask for one again from then on.
        self._wants_full = False
        self._full_due_ns = 0
        # Cells that were forced since the tree changed last: forcing them again would change nothing.
        self._forced: set[int] = set()
        # When the tree was last exact, as of the map that it was grown on; None before.
        self._exact_ns: int | None = None
        # For the status: the part grown last, and how long the last full growth took.
        self._window: Window = Window(0, 0, 0, 0)
        self._growth_ms = 0.0
        climb = cost_map.terrain.climb
        self._gaps = GapStatistics(config, counters)
        pace, resolution_m = cost_map.pace_s_per_m, self._grid.resolution_m
        self._puller = Puller(pace, resolution_m, config, climb) if pulls(config, climb) else None
        self._status_due_ns = 0
        self.target_search = target_search
        self._ways = Ways(tree.cost_grid)
        """Routes of this class's vehicles to search places."""
        for name in COUNTS if target_search.tracked else COUNTS + SEARCH_COUNTS:
            counters.count(name, 0)

    def lead(self, leads: bool) -> None:
        """Begins to lead, or stands by."""
        self.leads = leads
        self.push_all()

    def push_all(self) -> None:
        """Pushes a route to each follower. A planner that takes over, or whose link was lost, does not know which
        routes they have."""
        if self.leads:
            self.followers.forget_routes()

    def set_pace(self, cpu_budget: float, push_s: float) -> None:
        """Sets the share of a core that it may use, and the least time (s) between two pushes to a vehicle."""
        self._push_ns = int(push_s * NS_PER_S)
        self.tree.times.set_budget(cpu_budget)

    def on_chasers(self, chasers: Chasers, now_ns: int) -> None:
        """Notes which vehicles of an agent chase this target, and from where."""
        if chasers.target == self.target:
            self.followers.on_chasers(chasers, now_ns)

    def answer(
        self,
        request: planning.RouteRequest | planning.CostRequest,
        now_ns: int,
        send: Callable[[Answer], None] = lambda answer: None,
    ) -> Answer:
        """Answers from the tree, after changes of the map that lie on a route, and after a growth towards the cells
        if the request forces it. Never waits for a full growth that is under way.

        send  called with the reply as soon as it is known: the asker does not wait for statistics
        """
        if isinstance(request, planning.CostRequest):
            answer: Answer = self._costs(request, now_ns)
        elif len(request.cells) > MOST_ROUTES:
            answer = Refusal(f"{len(request.cells)} routes at once, at most {MOST_ROUTES}: ask in parts")
        else:
            return self._routes(request, now_ns, send)
        send(answer)
        return answer

    def tick(self, now_ns: int) -> list[Action]:
        """Brings the tree up to date, pushes newer routes and publishes the status."""
        actions = self._keep_up(now_ns)
        self._search(now_ns)
        if self.tree.ready and self.tree.wants_strides:
            actions.append(Work(self.tree.stride_job()))
        self.followers.drop_silent(now_ns)
        if self.leads:
            actions.extend(self._pushes(now_ns))
            if self.vehicle_class == GROUND:
                believed = self.target_search.belief_message(self.target, self._incarnation, now_ns)
                actions.extend([] if believed is None else [believed])
        if self.leads and now_ns >= self._status_due_ns:
            self._status_due_ns = now_ns + STATUS_NS
            actions.append(self.status(now_ns))
        return actions

    def adopt(self, grown: GrownTree, took_ns: int, now_ns: int) -> list[Action]:
        """Replaces the tree by what the worker grew, and applies later changes."""
        pose = self._watch.pose
        if self._growing_since_ns is None or pose is None:
            return []
        snapshot_ns = self._growing_since_ns
        news = (pose.cell, self._cost_map.version)
        dirty = self._take_dirty(now_ns)
        self._growing_since_ns = None
        update = self.tree.adopt(
            grown,
            self._cost_map.pace_s_per_m,
            *(news[0], self._dirty_since_snapshot, news[1]),
            self.followers.cells,
        )
        self._taken_in = news
        self._wants_full = False  # all that happened until now is in what `adopt` says
        self._record_growth(took_ns)
        if grown.map_version == news[1] and grown.target_cell == news[0]:
            self._exact_ns = now_ns
        else:
            self.counters.count("growths_late")
            self._exact_ns = snapshot_ns
        self._gaps.adopted(self.tree, now_ns)
        self._changed(update, dirty, now_ns)
        return [self._grow(now_ns)] if self._wants_full else []

    def must_wait(self, cells: Sequence[int]) -> bool:
        """Returns True if no tree answers these cells now, but one will once the search under way is adopted."""
        return not self.tree.knows(cells) and (self._growing_since_ns is not None or self.tree.wants_full)

    @property
    def begins(self) -> bool:
        """Returns True if it waits for its first map, or for the target's position."""
        return not self.tree.ready and (self.tree.map_version < 0 or self._watch.pose is not None)

    @property
    def knows_map(self) -> bool:
        """Returns True if routes follow the current map."""
        return self._taken_in is None or self._taken_in[1] == self._cost_map.version

    # --- the tree -----------------------------------------------------------------------------------------------

    def _keep_up(self, now_ns: int) -> list[Action]:
        """Takes in the newest pose and all map changes since the last time, if there are any."""
        pose = self._watch.pose
        if pose is None:
            if self.target_search.active and self.tree.map_version != self._cost_map.version:
                self._learn_map(now_ns)
            return []  # the first growth takes the map as it is then, whatever changed before
        now_known = (pose.cell, self._cost_map.version)
        moved = self._taken_in is None or pose.cell != self._taken_in[0]
        self.tree.times.note_tick(moved and self._taken_in is not None)
        if moved or (now_known != self._taken_in and self._may_not_wait(now_ns)):
            self._take_in(now_known, now_ns)
        if (self._wants_full or self.tree.wants_full) and self._growing_since_ns is None:
            return [self._grow(now_ns)]
        return []

    def _search(self, now_ns: int) -> None:
        """Searches for the target while it is unseen."""
        search = self.target_search
        if self.tree.map_version < 0 and not search.tracked:
            self._learn_map(now_ns)
        if self.vehicle_class != GROUND:
            return  # that class has given the search all of this
        search.tick(self._watch, self._cost_map.pace_s_per_m, now_ns)
        if search.searches:
            self.counters.counts["searches"] = search.searches
            self.counters.counts["search_places"] = search.searcher.decisions

    def _learn_map(self, now_ns: int) -> None:
        """Takes in the map without a target to lead to."""
        self.tree.update(self._cost_map.pace_s_per_m, -1, self._take_dirty(now_ns), self._cost_map.version)

    def _may_not_wait(self, now_ns: int) -> bool:
        """Returns True if changes of the map are to be applied although the target is at rest."""
        if not self.tree.ready:
            return True
        return now_ns >= self._rests_until_ns and self._intake.is_due(now_ns, self._push_ns)

    def _take_in(self, news: tuple[int, int], now_ns: int) -> None:
        dirty = self._take_dirty(now_ns)
        if not self.leads:  # no query comes here until it takes over
            self.tree.expect([follower.cell for _, follower in self.followers.all_items()])
        began_ns = self._now()
        update = self.tree.update(self._cost_map.pace_s_per_m, news[0], dirty, news[1])
        self._taken_in = news
        self._timed(update, self._now() - began_ns, now_ns)
        self._changed(update, dirty, now_ns)

    def _take_dirty(self, now_ns: int) -> list[Window]:
        dirty = self._intake.take(now_ns)
        if self._growing_since_ns is not None:
            self._dirty_since_snapshot = merged(dirty, self._dirty_since_snapshot)
        stamp_ns = self._newest_mark_ns()
        if stamp_ns is not None:
            self._unseen_mark_ns = max(stamp_ns, self._unseen_mark_ns or 0)
        return dirty

    def _grow(self, now_ns: int) -> Work:
        assert self._taken_in is not None
        self._growing_since_ns = now_ns
        self._dirty_since_snapshot = []
        self._wants_full = False
        return Work(self.tree.full_job(self._taken_in[0]))

    def _changed(self, update: Update, dirty: Sequence[Window], now_ns: int) -> None:
        """The tree is another than before."""
        self._wants_full |= update.wants_full
        self._forced.clear()
        if not update.window.empty:
            self._window = update.window
        if not self.tree.ready:
            return
        self.followers.touch(update.window, dirty)
        put_off = update.wants_full and update.kind == "none"
        if self._unseen_mark_ns is not None and not put_off:
            self.counters.observe("mark_to_tree_ms", max(now_ns - self._unseen_mark_ns, 0) / 1e6)
            self._unseen_mark_ns = None

    def _timed(self, update: Update, took_ns: int, now_ns: int) -> None:
        """Notes what work on this thread cost."""
        if self._stopwatch is None:
            took_ns = update.cells * (MODEL_EXACT_NS_PER_CELL if update.kind == "exact" else MODEL_NS_PER_CELL)
        if update.repair_ns:
            self.counters.observe("repair_ms", update.repair_ns / 1e6)
            self._rests_until_ns = now_ns + min(self.tree.times.rest_ns(update.repair_ns), LONGEST_WAIT_NS)
        if update.kind in ("full", "bounded", "exact"):
            self._exact_ns = now_ns
            self._record_growth(took_ns - update.repair_ns, update.kind)
            self._gaps.record_growth(self.tree, self.followers, now_ns)
        elif update.kind != "none":
            self.counters.count("window_growths")
            self.counters.observe("window_ms", took_ns / 1e6)

    def _record_growth(self, took_ns: int, kind: Kind = "full") -> None:
        self.counters.count("growths")
        self._growth_ms = took_ns / 1e6
        self.counters.observe("growth_ms", self._growth_ms)
        if self._stopwatch is not None:
            self.tree.times.observe(kind, took_ns)

    def _now(self) -> int:
        return 0 if self._stopwatch is None else self._stopwatch()

    # --- answers ------------------------------------------------------------------------------------------------

    def _routes(
        self, request: planning.RouteRequest, now_ns: int, send: Callable[[Answer], None]
    ) -> planning.RouteReply:
        cells = self._cells(request)
        most = (MOST_STEPS if self._puller is None else MOST_PULLED_STEPS) // max(len(cells), 1)
        max_cells = min(request.max_cells or most, most) if most < self._grid.cells else request.max_cells
        search = self.target_search
        if searching := search.active:
            ways, vehicles = self._ways, request.vehicles
            routes = self._on_current_map(
                lambda: search.routes(ways, cells, vehicles, max_cells, self.tree.map_version), now_ns
            )
        else:
            routes = self._read(cells, max_cells, now_ns)
            if request.force and self.tree.ready and self._force(self._improvable(cells, routes), now_ns):
                routes = self._read(cells, max_cells, now_ns)
        given = self._pulled(routes)
        reply = planning.RouteReply(
            rows=self._grid.rows, cols=self._grid.cols, routes=given.columns(), **self._reply_fields(now_ns)
        )
        send(reply)
        if not searching:
            self._certify(routes, now_ns)
        self.counters.count("routes_served", len(given))
        for vehicle, route in zip(request.vehicles, given, strict=False):  # a person's comes last, of no vehicle
            self.followers.given(vehicle, route, request.max_cells, now_ns, now_ns + self._push_ns)
        return reply

    def _read(self, cells: list[int], max_cells: int, now_ns: int) -> RouteBatch:
        """Routes off the tree."""
        return self._on_current_map(lambda: self.tree.routes(cells, max_cells), now_ns)

    def _on_current_map(self, find: Callable[[], RouteBatch], now_ns: int) -> RouteBatch:
        """Routes by `find`. If a waiting change of the map concerns them, it is applied and they are found again.

        Every route that is given to anybody comes through here.
        """
        routes = find()
        if not self._intake.concerns(routes):
            return routes
        if self._taken_in is not None and self.tree.ready:
            self._take_in((self._taken_in[0], self._cost_map.version), now_ns)
        elif self.target_search.active:
            self._learn_map(now_ns)
        else:
            return routes
        return find()

    def _pulled(self, routes: RouteBatch) -> RouteBatch:
        return routes if self._puller is None else self._puller.pull_batch(routes)

    def _improvable(self, cells: list[int], routes: RouteBatch) -> list[int]:
        """The cells whose routes may be worth a growth: all, or those without a proof that they are good."""
        if not self.tree.strategy.renews_loose_bounds:
            return cells
        good = routes.cost_s <= GOOD_GAP * routes.lower_bound_s
        return [cell for cell, is_good in zip(cells, good.tolist(), strict=True) if not is_good]

    def _force(self, cells: list[int], now_ns: int) -> bool:
        """Grows the tree over cells, once each between two changes of the tree. Returns True if the
        tree has changed."""
        fresh = sorted({cell for cell in cells if 0 <= cell < self._grid.cells} - self._forced)
        if not fresh:
            return False
        began_ns = self._now()
        update = self.tree.force(fresh)
        self._timed(update, self._now() - began_ns, now_ns)
        if update.kind != "none":
            self._changed(update, (), now_ns)
        self._wants_full |= update.wants_full
        self._forced.update(fresh)
        return update.kind != "none"

    def _certify(self, routes: RouteBatch, now_ns: int) -> None:
        """Notes the proven gaps; one that is too wide asks for a full growth, now and then, if the strategy
        does."""
        widest = self._gaps.certify(routes)
        loose = widest > MAX_GAP and self.tree.strategy.renews_loose_bounds
        if loose and now_ns >= self._full_due_ns:
            self._full_due_ns = now_ns + self._push_ns
            self._wants_full = True

    def _costs(self, request: planning.CostRequest, now_ns: int) -> planning.CostReply | Refusal:
        cells = self._cells(request)
        costs_s = self.tree.cost_to_go_at(cells)
        if self.tree.ready and self.tree.may_reach(cells, costs_s):
            return Refusal("the tree still grows towards some of these cells: ask again")
        self.counters.count("costs_served", len(cells))
        if self.target_search.active:
            on_map = [0 <= cell < self._grid.cells and self.tree.cost_grid.passable(cell) for cell in cells]
            costs_s = self.target_search.costs_s(costs_s, np.array(on_map, np.bool_))
        return planning.CostReply(cost_to_go_s=pack_column(costs_s, "<f4"), **self._reply_fields(now_ns))

    def _fields(self, now_ns: int) -> dict[str, Any]:
        """Returns the fields about tree and target in replies and the status."""
        return {
            "target": self.target,
            "incarnation": self._incarnation,
            "map_version": max(self.tree.map_version, 0),
            "tree_age_ms": math.inf if self._exact_ns is None else (now_ns - self._exact_ns) / 1e6,
            "pose_age_s": self._watch.age_s(now_ns),
            "tracker_lost": self._watch.lost(now_ns),
        }

    def _reply_fields(self, now_ns: int) -> dict[str, Any]:
        lethal, nearest = self.tree.lethal_target or (None, None)
        own = {"target_cell": self.tree.target_cell, "vehicle_class": self.vehicle_class}
        return self._fields(now_ns) | own | {"lethal_target": lethal, "nearest_cell": nearest}

    def _cells(self, request: planning.RouteRequest | planning.CostRequest) -> list[int]:
        """The cells asked for; a person's row and col come last, as -1 where they are outside."""
        if request.row is None or request.col is None:
            return request.cells
        inside = self._grid.inside(request.row, request.col)
        return [*request.cells, self._grid.cell(request.row, request.col) if inside else -1]

    # --- published without a query ------------------------------------------------------------------------------

    def _pushes(self, now_ns: int) -> list[Action]:
        """Newer routes for followers which a change concerns and which have not had one for a while."""
        if self.target_search.active:
            return self._places_to_push(self.target_search.searcher, now_ns)
        target_cell = self.tree.target_cell
        if not self.tree.ready or target_cell is None:
            return []
        pushes: list[Action] = []
        for (_, max_cells), batch in self.followers.due(now_ns).items():
            cells = [follower.cell for _, follower in batch]
            routes = self._pulled(self._read(cells, max_cells, now_ns))
            for id, route in self.followers.pushed(batch, routes, now_ns + self._push_ns):
                pushes.append(self._pushed(id, route, target_cell))
        self.counters.count("pushes", len(pushes))
        return pushes

    def _places_to_push(self, searcher: Searcher, now_ns: int) -> list[Action]:
        """Reassigns search places of vehicles whose place costs more than it is worth, or which still follow a
        route to the last pose."""
        pushes: list[Action] = []
        searcher.forget_all_but(self._ways, self.followers.ids())
        for id, follower in self.followers.all_items():
            if not searcher.may_decide:
                break
            if not searcher.wants_place(id) or now_ns < follower.push_ns:
                continue
            route = self._pulled(self._place(searcher, id, follower, now_ns))[0]
            follower.push_ns = now_ns + self._push_ns
            if is_place(route):
                self.followers.sent(follower, route, now_ns + self._push_ns)
                pushes.append(self._pushed(id, route, searcher.goals[id]))
        self.counters.count("pushes", len(pushes))
        return pushes

    def _place(self, searcher: Searcher, id: str, follower: Follower, now_ns: int) -> RouteBatch:
        at, most = follower.cell, follower.max_cells
        return self._on_current_map(lambda: searcher.route(self._ways, id, at, most, self.tree.map_version), now_ns)

    def _pushed(self, vehicle: str, route: Route, target_cell: int) -> planning.PushedRoute:
        return planning.PushedRoute(
            vehicle=vehicle,
            target=self.target,
            incarnation=self._incarnation,
            target_cell=target_cell,
            map_version=max(self.tree.map_version, 0),
            route=route,
        )

    def status(self, now_ns: int) -> planning.PlannerStatus:
        window, counts, pose = self._window, self.counters.counts, self._watch.pose
        mean, p95, highest = self._gaps.last or (None, None, None)
        return planning.PlannerStatus(
            **self._fields(now_ns),
            stamp_ns=now_ns,
            strategy=self._config.strategy,
            target_cell=None if pose is None else pose.cell,
            window=[] if window.empty else [window.row0, window.col0, window.row1, window.col1],
            growths=counts["growths"],
            window_growths=counts["window_growths"],
            growth_ms=self._growth_ms,
            routes_served=counts["routes_served"],
            following=len(self.followers),
            tracker=None if pose is None else pose.tracker,
            gap_mean=mean,
            gap_p95=p95,
            gap_max=highest,
        )
