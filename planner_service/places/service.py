"""The shell of routes to places: questions from the bus to the trees of their class, and answers back.

One question at a time is with the worker, for a slice of cells. While it is there, this thread leaves all trees and
their costs alone. A question that needs more waits for its next turn, as others do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from planner_service.goal_trees import GoalAnswer, GoalTrees
from planner_service.tree.cost_grid import CostGrid
from shared_map.cost_map import CostMap
from shared_map.replication.mark_filter import MarkFilter, readable_groups
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import class_terrains
from shared_map.vehicle_class_maps import ClassMaps
from swarm.bus.bus import Asked, Bus, Event, Post, WorkDone, Worker
from swarm.clock import NS_PER_S
from swarm.config.agents import PLACE_TREES_BYTES
from swarm.config.explain import choice
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND, class_numbers
from swarm.grid import GridSpec
from swarm.runtime.fair_queue import FairQueue
from swarm.runtime.membership import Member
from swarm.runtime.order_client import OrderClient
from swarm.runtime.role import RoleSetup
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import PlaceRouteReply, PlaceRouteRequest
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus, directions_of
from swarm.wire.topics import PLACE_ROUTE, is_own

_SLICE_CELLS = 1 << 16
"""Cells that a question may grow in one turn, some 2 ms."""
_SLICE_NS = 2_000_000
_CELLS_OF_A_PRICE = 1 << 8
"""Cells grown at the price of one route that needs no growth, some 10 us."""
_WITHIN_NS = NS_PER_S // 2
"""A question that still grows after so long is answered with the routes that are known."""
_TAG = "grow-goals"
_MOST_ROUTES = 1000
_MOST_HELD = 4096
_STATUSES = {
    "ok": RouteStatus.OK,
    "unreachable": RouteStatus.UNREACHABLE,
    "lethal_goal": RouteStatus.UNREACHABLE,
    "lethal_start": RouteStatus.LETHAL_START,
    "outside": RouteStatus.OUTSIDE,
}
"""Status of an answer -> status of its route. One that still grows has NO_TARGET: vehicles ask again."""


class _ClassTrees:
    """The trees of one class on its map."""

    def __init__(self, scenario: Scenario, cost_map: CostMap, budget_bytes: int) -> None:
        self._map = cost_map
        self._costs = CostGrid(cost_map.grid, scenario.planner, cost_map.terrain.climb)
        cost_map.take_dirty()
        self._costs.load(cost_map.pace_s_per_m)
        self.trees = GoalTrees(self._costs, budget_bytes)
        self.version = cost_map.version
        """Version of the map that the trees go by."""

    def keep_up(self) -> None:
        """Takes what has changed in the map."""
        if dirty := self._map.take_dirty():
            self.trees.changed(self._costs.apply(self._map.pace_s_per_m, dirty))
        self.version = self._map.version


@dataclass(slots=True, eq=False)
class _Question:
    """A question that waits, or is with the worker.

    version  of the map on which the answers so far hold
    routes   of its first cells, as far as they are known
    """

    asked: Asked
    request: PlaceRouteRequest
    trees: _ClassTrees
    until_ns: int
    version: int = -1
    routes: list[Route] = field(default_factory=list)
    lethal_goal: bool = False

    def price(self, cols: int) -> int:
        """The price of its next turn: of its routes, and of the cells that may grow by then."""
        (row, col), starts = divmod(self.request.to, cols), self.request.cells[len(self.routes) :]
        far = max((max(abs(cell // cols - row), abs(cell % cols - col)) for cell in starts), default=0)
        return 1 + len(starts) + min(3 * far * far, _SLICE_CELLS) // _CELLS_OF_A_PRICE


@dataclass(frozen=True, slots=True)
class _Slice:
    """The result of a turn: routes that are known by now, and the cells grown for them."""

    routes: list[Route]
    grown_cells: int
    lethal_goal: bool


class PlacesService:
    """Serves routes from any cell to any other.

    class_kernels  whether the kernels for all classes may be called, not only those of "ground"
    """

    def __init__(
        self,
        setup: RoleSetup,
        terrain: Terrain,
        bus: Bus,
        post: Post,
        worker: Worker,
        class_kernels: Callable[[], bool] | None = None,
    ) -> None:
        scenario = setup.scenario
        self._scenario, self._id, self._incarnation = scenario, setup.id, setup.incarnation
        self._bus, self._post, self._worker = bus, post, worker
        self._grid = terrain.grid
        self._class_kernels = class_kernels or (lambda: True)
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post, setup.before)
        self.counters = self._member.counters
        cost_map = CostMap(terrain, learning=scenario.map.learning)
        self._maps = ClassMaps(cost_map, class_terrains(scenario, terrain), class_numbers(scenario))
        self.replica = MapReplica(terrain.grid, self._maps, filter=MarkFilter(terrain.grid, read_by_all(scenario)))
        self._sync = MapSync(self.replica, bus, post, scenario.map, setup.role, at_ticks=True)
        self._classes: dict[str, _ClassTrees] = {}
        self._obedience = OrderClient(setup, bus, post, self._obeys)
        self._held: FairQueue[_Question] = FairQueue(_MOST_HELD, _MOST_HELD // 4)
        """Questions that wait, agents' first, of others each in its turn."""
        self._in_work: _Question | None = None
        self._now_ns = 0
        for name in ("place_routes", "place_cells_grown"):
            self.counters.count(name, 0)
        self._member.needs("the shared map", lambda: self._sync.joined)

    def lacks(self) -> list[str]:
        return self._member.lacks()

    def start(self, now_ns: int) -> None:
        self._member.join()
        self._sync.start(now_ns)
        self._obedience.start(now_ns)
        self._bus.serve(PLACE_ROUTE, self._post, undecoded=True, places=self._id)

    def handle(self, event: Event, now_ns: int) -> None:
        self._now_ns = now_ns
        if isinstance(event, Asked) and isinstance(event.request, PlaceRouteRequest):
            self._take(event, event.request)
        elif isinstance(event, WorkDone) and isinstance(event.result, _Slice):
            self._on_slice(event.result)
        elif not self._member.on_member_event(event):
            any(handle(event, now_ns) for handle in (self._sync.on_map_event, self._obedience.on_order_event))
        self._begin()

    def tick(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._sync.tick(now_ns)
        self._obedience.tick(now_ns)
        if self._in_work is None:
            for each in self._classes.values():
                each.keep_up()
        self._begin()
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        waiting, self._in_work = self._in_work, None
        while waiting is not None:
            self._refuse(waiting.asked, "the process that plans to places ends")
            waiting = self._held.take()
        self._member.publish_stats(now_ns)

    def _take(self, asked: Asked, request: PlaceRouteRequest) -> None:
        trees = self._trees_of(request.vehicle_class)
        if len(request.cells) > _MOST_ROUTES:
            trees = f"{len(request.cells)} routes at once, at most {_MOST_ROUTES}: ask in parts"
        if isinstance(trees, str):
            self._refuse(asked, trees)
        else:
            self._await_turn(_Question(asked, request, trees, self._now_ns + _WITHIN_NS))

    def _trees_of(self, name: str) -> _ClassTrees | str:
        """The trees of a class, made at its first question; or why there are none."""
        if name not in self._classes:
            known = [GROUND, *self._maps.of]
            if name not in known:
                return f"there is no class {name!r}{choice(name, known, ' there are ')}"
            if name != GROUND and not self._class_kernels():
                return f"the kernels for class {name} are still being compiled"
            cost_map = self._maps.common if name == GROUND else self._maps.of[name]
            self._classes[name] = _ClassTrees(self._scenario, cost_map, PLACE_TREES_BYTES // len(known))
        return self._classes[name]

    def _await_turn(self, question: _Question) -> None:
        asker = question.asked.asker
        price = question.price(self._grid.cols)
        dropped = self._held.put(asker, question, price=price, rank=int(not is_own(asker)))
        if dropped is not None:
            self.counters.count("place_refusals")
            self._refuse(dropped.asked, "too many questions wait here already: ask again in a second")

    def _begin(self) -> None:
        """Gives the worker the next question, if it has none; agents come first."""
        while self._in_work is None and (question := self._held.take()) is not None:
            if question.asked.expired:
                question.asked.end()
                continue
            question.trees.keep_up()
            if question.version != question.trees.version:
                question.version, question.routes, question.lethal_goal = question.trees.version, [], False
            self._in_work = question
            job = partial(_grow, question.trees.trees, question.request, len(question.routes), self._grid)
            self._worker.submit(_TAG, job, self._post, _SLICE_NS)

    def _on_slice(self, done: _Slice) -> None:
        question, self._in_work = self._in_work, None
        classes = self._classes.values()
        self.counters.count("place_cells_grown", done.grown_cells)
        self.counters.gauge("place_trees", float(sum(each.trees.trees for each in classes)))
        self.counters.gauge("place_bytes", float(sum(each.trees.bytes for each in classes)))
        if question is None:
            return  # it was refused at the end
        question.routes += done.routes
        question.lethal_goal |= done.lethal_goal
        if len(question.routes) < len(question.request.cells) and self._now_ns < question.until_ns:
            self._await_turn(question)
            return
        self.counters.count("place_routes", len(question.routes))
        question.asked.answer(self._reply(question), places=self._id)
        question.asked.end()

    def _reply(self, question: _Question) -> PlaceRouteReply:
        request, known = question.request, question.routes
        unknown = [
            Route(status=RouteStatus.NO_TARGET if 0 <= cell < self._grid.cells else RouteStatus.OUTSIDE, start=cell)
            for cell in request.cells[len(known) :]
        ]
        status: Literal["ok", "growing", "lethal_goal", "outside_goal"] = "growing" if unknown else "ok"
        if question.lethal_goal:
            status = "lethal_goal"
        if not 0 <= request.to < self._grid.cells:
            status = "outside_goal"
        return PlaceRouteReply(
            to_cell=request.to,
            incarnation=self._incarnation,
            map_version=question.version,
            routes=RouteBatch.of([*known, *unknown]).columns(),
            status=status,
            vehicle_class=request.vehicle_class,
        )

    @staticmethod
    def _refuse(asked: Asked, reason: str) -> None:
        asked.refuse(reason)
        asked.end()

    def _obeys(self, order: Obey) -> bool:
        """A zone is obeyed once the map has it: the next question finds it in the trees."""
        return order.subject is not None or self._sync.holds(order.author, order.sets, self._now_ns)


def _grow(trees: GoalTrees, request: PlaceRouteRequest, first: int, grid: GridSpec) -> _Slice:
    """Finds routes from the cells of a question, from its `first` on, as far as a slice goes."""
    routes: list[Route] = []
    left, lethal_goal = _SLICE_CELLS, False
    for start in request.cells[first:]:
        answer = trees.ask(request.to, start, left)
        left -= answer.grown_cells
        if answer.status == "growing":
            break
        lethal_goal |= answer.status == "lethal_goal"
        routes.append(_route(trees, request, start, answer, grid))
        if left <= 0:
            break
    return _Slice(routes, _SLICE_CELLS - left, lethal_goal)


def _route(trees: GoalTrees, request: PlaceRouteRequest, start: int, answer: GoalAnswer, grid: GridSpec) -> Route:
    if answer.status != "ok":
        return Route(status=_STATUSES[answer.status], start=start)
    cells, rest_s = answer.cells, 0.0
    if 0 < request.max_cells < len(cells) - 1:
        cells = cells[: request.max_cells + 1]
        rest_s = trees.ask(request.to, int(cells[-1]), 1).cost_s
    if not math.isfinite(rest_s):
        cells, rest_s = answer.cells, 0.0
    codes = directions_of(cells, grid.cols)
    steps = np.where(np.frombuffer(codes, np.uint8) & 1, math.sqrt(2.0), 1.0)
    return Route(
        status=RouteStatus.OK,
        start=start,
        directions=codes,
        cost_s=answer.cost_s,
        lower_bound_s=answer.lower_bound_s,
        length_m=float(steps.sum()) * grid.resolution_m,
        remaining_s=rest_s,
    )


def read_by_all(scenario: Scenario) -> frozenset[str] | None:
    """The groups whose marks every group takes in: routes to places tell no group what it must not know. None if
    that is all groups."""
    readable = [found for group in scenario.groups if (found := readable_groups(scenario, group.name)) is not None]
    return frozenset.intersection(*readable) if readable else None
