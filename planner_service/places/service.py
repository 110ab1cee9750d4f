"""The shell of routes to places: questions from the bus to the trees of their class, and answers back."""

from __future__ import annotations

import math
from collections.abc import Callable

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
from swarm.bus.bus import Asked, Bus, Event, Post
from swarm.config.explain import choice
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND, class_numbers
from swarm.runtime.fair_queue import FairQueue
from swarm.runtime.membership import Member
from swarm.runtime.order_client import OrderClient
from swarm.runtime.role import RoleSetup
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import PlaceRouteReply, PlaceRouteRequest
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus, directions_of
from swarm.wire.topics import PLACE_ROUTE, is_own

_BUDGET_BYTES = 256 << 20
"""Trees of all classes that are kept, besides one in hand of each class."""
_AT_ONCE_CELLS = 1 << 17
"""Cells grown between two ticks, some 3 ms; later questions wait."""
_MOST_ROUTES = 1000
_MOST_HELD = 4096
_STATUSES = {
    "ok": RouteStatus.OK,
    "growing": RouteStatus.NO_TARGET,
    "unreachable": RouteStatus.UNREACHABLE,
    "lethal_goal": RouteStatus.UNREACHABLE,
    "lethal_start": RouteStatus.LETHAL_START,
    "outside": RouteStatus.OUTSIDE,
}
"""Status of an answer -> status of its route; a vehicle asks again after NO_TARGET."""


class _ClassTrees:
    """The trees of one class on its map."""

    def __init__(self, scenario: Scenario, cost_map: CostMap, budget_bytes: int) -> None:
        self._map = cost_map
        self._costs = CostGrid(cost_map.grid, scenario.planner, cost_map.terrain.climb)
        cost_map.take_dirty()
        self._costs.load(cost_map.pace_s_per_m)
        self.trees = GoalTrees(self._costs, budget_bytes)

    def keep_up(self) -> None:
        """Takes what has changed in the map."""
        if dirty := self._map.take_dirty():
            self.trees.changed(self._costs.apply(self._map.pace_s_per_m, dirty))


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
        class_kernels: Callable[[], bool] | None = None,
    ) -> None:
        scenario = setup.scenario
        self._scenario, self._id, self._incarnation = scenario, setup.id, setup.incarnation
        self._bus, self._post = bus, post
        self._class_kernels = class_kernels or (lambda: True)
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post, setup.before)
        self.counters = self._member.counters
        cost_map = CostMap(terrain, learning=scenario.map.learning)
        self._maps = ClassMaps(cost_map, class_terrains(scenario, terrain), class_numbers(scenario))
        self.replica = MapReplica(terrain.grid, self._maps, filter=MarkFilter(terrain.grid, read_by_all(scenario)))
        self._sync = MapSync(self.replica, bus, post, scenario.map, setup.role, at_ticks=True)
        self._classes: dict[str, _ClassTrees] = {}
        self._obedience = OrderClient(setup, bus, post, self._obeys)
        self._held: FairQueue[Asked] = FairQueue(_MOST_HELD, _MOST_HELD // 4)
        """Questions that wait, agents' first, of others each in its turn."""
        self._now_ns = self._left = 0
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
        if isinstance(event, Asked) and isinstance(event.request, PlaceRouteRequest):
            price = 1 + len(event.request.cells)
            dropped = self._held.put(event.asker, event, price=price, rank=int(not is_own(event.asker)))
            if dropped is not None:
                dropped.refuse("too many questions wait here already: ask again in a second")
                dropped.end()
            self._answer()
        elif not self._member.on_member_event(event):
            any(handle(event, now_ns) for handle in (self._sync.on_map_event, self._obedience.on_order_event))

    def tick(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._sync.tick(now_ns)
        for trees in self._classes.values():
            trees.keep_up()
        self._obedience.tick(now_ns)
        self._left = _AT_ONCE_CELLS
        self._answer()
        self.counters.gauge("place_trees", float(sum(each.trees.trees for each in self._classes.values())))
        self.counters.gauge("place_bytes", float(sum(each.trees.bytes for each in self._classes.values())))
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        while (asked := self._held.take()) is not None:
            asked.refuse("the process that plans to places ends")
            asked.end()
        self._member.publish_stats(now_ns)

    def _answer(self) -> None:
        """Answers waiting questions as far as a tick has time to grow trees; agents come first."""
        while self._left > 0 and (asked := self._held.take()) is not None:
            if not asked.expired:
                assert isinstance(asked.request, PlaceRouteRequest)
                reply = self._reply(asked.request)
                if isinstance(reply, str):
                    asked.refuse(reply)
                else:
                    asked.answer(reply, places=self._id)
            asked.end()

    def _reply(self, request: PlaceRouteRequest) -> PlaceRouteReply | str:
        name = request.vehicle_class
        if name not in self._classes:
            known = [GROUND, *self._maps.of]
            if name not in known:
                return f"there is no class {name!r}{choice(name, known, ' there are ')}"
            if name != GROUND and not self._class_kernels():
                return f"the kernels for class {name} are still being compiled"
            cost_map = self._maps.common if name == GROUND else self._maps.of[name]
            self._classes[name] = _ClassTrees(self._scenario, cost_map, _BUDGET_BYTES // len(known))
        if len(request.cells) > _MOST_ROUTES:
            return f"{len(request.cells)} routes at once, at most {_MOST_ROUTES}: ask in parts"
        trees = self._classes[name].trees
        answers = []
        for cell in request.cells:
            answers.append(trees.ask(request.to, cell, max(self._left, 1)))
            self._left -= answers[-1].grown_cells
        self.counters.count("place_routes", len(answers))
        self.counters.count("place_cells_grown", sum(each.grown_cells for each in answers))
        statuses = {each.status for each in answers}
        inside = 0 <= request.to < self.replica.grid.cells
        status = "growing" if "growing" in statuses else "lethal_goal" if "lethal_goal" in statuses else "ok"
        return PlaceRouteReply(
            to_cell=request.to,
            incarnation=self._incarnation,
            map_version=self._maps.common.version,
            routes=RouteBatch.of(
                [self._route(trees, request, *each) for each in zip(request.cells, answers, strict=True)]
            ).columns(),
            status=status if inside else "outside_goal",  # type: ignore[arg-type]
            vehicle_class=name,
        )

    def _route(self, trees: GoalTrees, request: PlaceRouteRequest, start: int, answer: GoalAnswer) -> Route:
        if answer.status != "ok":
            return Route(status=_STATUSES[answer.status], start=start)
        cells, rest_s = answer.cells, 0.0
        if 0 < request.max_cells < len(cells) - 1:
            cells = cells[: request.max_cells + 1]
            rest_s = trees.ask(request.to, int(cells[-1]), 1).cost_s
        if not math.isfinite(rest_s):
            cells, rest_s = answer.cells, 0.0
        codes = directions_of(cells, self.replica.grid.cols)
        steps = np.where(np.frombuffer(codes, np.uint8) & 1, math.sqrt(2.0), 1.0)
        return Route(
            status=RouteStatus.OK,
            start=start,
            directions=codes,
            cost_s=answer.cost_s,
            lower_bound_s=answer.lower_bound_s,
            length_m=float(steps.sum()) * self.replica.grid.resolution_m,
            remaining_s=rest_s,
        )

    def _obeys(self, order: Obey) -> bool:
        """A zone is obeyed once the map has it: the next question finds it in the trees."""
        return order.subject is not None or self._sync.holds(order.author, order.sets, self._now_ns)


def read_by_all(scenario: Scenario) -> frozenset[str] | None:
    """The groups whose marks every group takes in: routes to places tell no group what it must not know. None if
    that is all groups."""
    readable = [found for group in scenario.groups if (found := readable_groups(scenario, group.name)) is not None]
    return frozenset.intersection(*readable) if readable else None
