"""The process `places`: routes between any two cells of the map, for groups that share their marks.

A place is a goal without a process of its own: its tree is grown as far as its askers are and is kept for the next
(`GoalTrees`). The worker grows beside the loop, a slice of cells at a time. Questions of agents come first, then
those whose goal is near, then those of the asker that has paid least. One that was begun is finished before another
of its kind begins. Begun by turns, a thousand growths would drop each other's trees from the cache.

Between two slices the map takes its changes. A vehicle whose route a change concerns is pushed another, as by
planners of targets (`Followers`). Nothing here need outlive the process: the one that takes over grows again when
asked.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import NamedTuple

import msgspec
import numpy as np

from planner_service.followers import Followers
from planner_service.goal_tree_cache import GoalTrees
from planner_service.planner import FOLLOWER_LEASE_NS, MOST_ROUTES, MOST_STEPS
from planner_service.planning_process import Planning, PlanningProcess
from planner_service.tree.cost_grid import CostGrid
from shared_map.array_files import Floats
from shared_map.cost_map import CostMap
from swarm.bus.bus import Asked, Event, LinkChanged, WorkDone
from swarm.clock import NS_PER_S
from swarm.config import scenario as settings
from swarm.config.scenario import PlannerConfig
from swarm.config.vehicle_classes import GROUND
from swarm.grid import Window
from swarm.peers import job_of
from swarm.runtime.inbox import FairQueue
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import PlaceRouteReply, PlaceRouteRequest, PlaceStatus, PushedRoute
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus
from swarm.wire.topics import PLACE_ROUTE, SENT, asker_of, rank_of

log = logging.getLogger(__name__)

SLICE_CELLS = 1 << 16
"""Cells that are grown before others have their turn: 1 to 4 ms."""
_MOST_WAITING, _MOST_EACH = 1 << 16, 1 << 14
"""Prices of the questions that wait for near goals, and for far ones, of all askers and of one. Of more the oldest
are refused."""
_BASE_PRICE, _CELLS_OF_A_PRICE = 16, 1 << 10
"""Price of a question without its routes, which bounds how many wait; and cells grown at the price of a route."""
_MOST_NEAR = 3
"""Slices of near goals, one after the other, while far ones of the same rank wait."""
_HOLD_NS = NS_PER_S
"""A question waits at most this time for its growth; then it is answered as far as it is known."""
_KEEPS_UP_NS = NS_PER_S
"""While a question goes on, its map is so old at most: else marks beside a goal would end no growth."""
_CELL_NS = 25
"""Time that a simulation counts for a cell grown."""


@dataclass(slots=True, eq=False)
class _Question:
    """A question, and as much of its answer as is known.

    event  None if no vehicle asked: its routes are pushed to those which follow an older one
    """

    event: Asked | None
    asker: str
    request: PlaceRouteRequest
    asked_ns: int
    found: list[Route] = field(default_factory=list)
    lethal_goal: bool = False
    nearest: int | None = None
    """The open cell nearest to a lethal goal."""
    rank: int = 0
    """Those of a lower one come first: of agents before those of others."""
    version: int = -1
    """Version of the map on which they were found."""

    @property
    def done(self) -> bool:
        return len(self.found) == len(self.request.cells)

    @property
    def routes(self) -> RouteBatch:
        """The routes as they are known. Those which are still to be found have the status NO_TARGET."""
        unknown = self.request.cells[len(self.found) :]
        return RouteBatch.of(self.found + [Route(status=RouteStatus.NO_TARGET, start=cell) for cell in unknown])


class _News(NamedTuple):
    """Changes of the map for the worker, in copies: the map goes on changing meanwhile.

    pace       of the whole map; only what lies in the windows counts
    following  vehicles with a route, the cells where they are and to which they go
    """

    version: int
    pace: Floats
    windows: list[Window]
    following: list[tuple[str, int, int]]


class _Slice(NamedTuple):
    """Work done on a question.

    changed   windows of the map that have changed
    outdone   vehicles which may have a cheaper route now, because some cell became cheaper
    """

    grown: int
    changed: Sequence[Window] = ()
    outdone: Sequence[str] = ()


class _ClassTrees:
    """The map of one class of vehicles, the trees on it, and the vehicles which follow their routes.

    All of it belongs to the loop, except what `work` touches: that is the worker's during a slice.
    """

    def __init__(self, cost_map: CostMap, config: PlannerConfig, budget_bytes: int, route_cells: int) -> None:
        self.cost_map = cost_map
        self.followers = Followers(cost_map.grid, FOLLOWER_LEASE_NS, route_cells)
        self.trees = GoalTrees(CostGrid(cost_map.grid, config, cost_map.terrain.climb), budget_bytes)
        self._version = -1
        """Version of the map that the trees know."""
        self.kept_up_ns = 0

    def news(self, now_ns: int) -> _News | None:
        """Returns the changes of the map since the last call; None without any. Not to be called during a slice."""
        self.kept_up_ns = now_ns
        pace, windows = self.cost_map.pace_s_per_m, self.cost_map.take_dirty()
        if self._version < 0:
            return _News(self.cost_map.version, pace.copy(), [self.cost_map.grid.window], [])
        if not windows:
            return None
        following = [
            (id, each.cell, each.goal)
            for id, each in self.followers.all_items()
            if each.goal is not None and not each.stale
        ]
        copied = np.empty_like(pace)  # only written pages take memory
        for window in windows:
            part = np.s_[window.row0 : window.row1, window.col0 : window.col1]
            copied[part] = pace[part]
        return _News(self.cost_map.version, copied, windows, following)

    def work(self, question: _Question, news: _News | None) -> _Slice:
        """Applies the news to the costs and trees, then works on the question for at most `SLICE_CELLS` cells."""
        changed: Sequence[Window] = ()
        outdone: list[str] = []
        if news is not None and self._version < 0:
            self.trees.costs.load(news.pace)
        elif news is not None:
            changes = self.trees.costs.apply(news.pace, news.windows)
            self.trees.changed(changes)
            changed = news.windows
            if changes.any_lower:
                keeps = self.trees.still_cheapest
                outdone = [id for id, cell, goal in news.following if not keeps(goal, cell)]
        if news is not None:
            self._version = news.version
        return _Slice(self._answer(question), changed, outdone)

    def _answer(self, question: _Question) -> int:
        request, grown = question.request, 0
        if question.version != self._version:
            question.found, question.version = [], self._version
        most, walked = MOST_STEPS // max(len(request.cells), 1), 0
        most = min(request.max_cells or most, most)
        while not question.done and grown + walked < SLICE_CELLS:
            start = request.cells[len(question.found)]
            answer = self.trees.ask(request.to, start, SLICE_CELLS - grown, most)
            grown += answer.grown_cells
            if answer.grows:
                break
            walked += 1 + len(answer.route.directions)
            question.found.append(answer.route)
            question.lethal_goal = answer.lethal_goal
        near = question.done and question.lethal_goal
        question.nearest = self.trees.costs.nearest_open(request.to) if near else None
        return grown

    def status(self, question: _Question) -> PlaceStatus:
        if question.found and question.lethal_goal:
            return "lethal_goal"
        if not 0 <= question.request.to < self.cost_map.grid.cells:
            return "outside_goal"
        return "ok" if question.done else "growing"


class PlacesService(PlanningProcess):
    """Serves routes between any two cells. The process has the name of the first group that it serves."""

    def __init__(self, planning: Planning, all_kernels: Callable[[], bool] | None = None) -> None:
        job, scenario = job_of(planning.setup.id), planning.setup.scenario
        served = {PLACE_ROUTE: {"places": job}}
        super().__init__(planning, settings.readable_groups(scenario, job), served, all_kernels)
        self._push_ns = int(scenario.planner.push_s * NS_PER_S)
        self._foreign = {
            asker_of("agent", plan.id): plan.group.name
            for plan in settings.plan_agents(scenario)
            if settings.place_job(scenario, plan.group.name) != job
        }
        """The agents which may not know what this process knows, and their groups. Routers hold an asker's name
        against its certificate."""
        self._classes: dict[str, _ClassTrees] = {}
        self._near: FairQueue[_Question] = FairQueue(_MOST_WAITING, _MOST_EACH)
        """Questions for which one slice is expected to do."""
        self._far: FairQueue[_Question] = FairQueue(_MOST_WAITING, _MOST_EACH)
        self._near_in_a_row = 0
        self._at_work: _Question | None = None
        """The question of which the worker has a slice."""
        self._going_on: list[_Question] = []
        """Questions that wait for another slice. The last one has the lowest rank."""
        for name in ("routes_served", "place_cells_grown", "place_questions_refused", "pushes"):
            self.counters.count(name, 0)

    def start(self, now_ns: int) -> None:
        self._bus.collect(SENT, places=self._job)
        super().start(now_ns)

    def handle(self, event: Event, now_ns: int) -> None:
        self._now_ns = now_ns
        match event:
            case Asked(request=PlaceRouteRequest() as request):
                self._take(event, request, now_ns)
            case WorkDone(result=_Slice() as done):
                self._worked(done, now_ns)
            case _:
                if isinstance(event, LinkChanged) and event.up:
                    self._forget_routes()
                super().handle(event, now_ns)

    def tick(self, now_ns: int) -> None:
        self._take_map(now_ns)
        self._lead(self._candidacy.tick(not self.lacks(), now_ns), now_ns)
        self._push_due(now_ns)
        self.counters.gauge("places_waiting", float(len(self._near) + len(self._far)))
        self.counters.gauge("place_trees", float(sum(each.trees.trees for each in self._classes.values())))
        self.counters.gauge("place_bytes", float(sum(each.trees.bytes for each in self._classes.values())))
        self._order_client.tick(now_ns)
        self._go_on()
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._candidacy.stop()
        waiting = iter(self._near.take, None), iter(self._far.take, None)
        for question in (self._at_work, *self._going_on, *chain(*waiting)):
            if question is not None:
                self._drop(question, "the process ends")
        self._at_work = None
        self._member.publish_stats(now_ns)

    def _lead(self, leads: bool, now_ns: int) -> None:
        if leads and not self._leads:
            self._forget_routes()
        super()._lead(leads, now_ns)

    # --- questions ----------------------------------------------------------------------------------------------

    def _take(self, event: Asked, request: PlaceRouteRequest, now_ns: int) -> None:
        name = request.vehicle_class
        if (fault := self._fault_of(name)) is not None:
            self._refuse(event, fault)
        elif event.asker in self._foreign:
            self._refuse(event, f"{event.asker} is of group {self._foreign[event.asker]}: ask its own places")
        elif len(request.cells) > MOST_ROUTES:
            self._refuse(event, f"{len(request.cells)} routes at once, at most {MOST_ROUTES}: ask in parts")
        else:
            self._wait(_Question(event, event.asker, request, now_ns))
            self._go_on()

    def _wait(self, question: _Question) -> None:
        """Puts a question into the queue, at the price of its first slice: a growth takes about three times the
        square of the distance in cells."""
        request, cols = question.request, self._cost_maps[GROUND].grid.cols
        row, col = divmod(request.to, cols)
        away = (max(abs(cell // cols - row), abs(cell % cols - col)) for cell in request.cells)
        cells = 3 * max(away, default=0) ** 2
        price = _BASE_PRICE + len(request.cells) + min(cells, SLICE_CELLS) // _CELLS_OF_A_PRICE
        question.rank = rank_of(question.asker)
        queue = self._far if cells > SLICE_CELLS else self._near
        for dropped in queue.put(question.asker, question, price=price, rank=question.rank):
            self._drop(dropped, "too many questions wait here already: ask again in a second")

    def _next(self) -> _Question | None:
        """The question that has the next slice. Of those of one rank, near goals come first, but not for ever."""
        goes_on = self._going_on[-1].rank if self._going_on else math.inf
        far, near = min(goes_on, self._far.first_rank), self._near.first_rank
        if far < near or (far == near and self._near_in_a_row >= _MOST_NEAR):
            self._near_in_a_row = 0
            return self._going_on.pop() if goes_on == far and self._going_on else self._far.take()
        self._near_in_a_row += 1
        return self._near.take()

    def _go_on(self) -> None:
        """Gives the worker the next slice, if it has none."""
        while self._at_work is None and (question := self._next()) is not None:
            if question.event is not None and question.event.expired:
                question.event.end()
                continue
            trees, news = self._trees(question.request.vehicle_class), None
            if question.event is None and not question.found and not self._starts_now(trees, question):
                continue
            self._at_work = question
            if not self._goes_on or self._now_ns - trees.kept_up_ns >= _KEEPS_UP_NS:
                news = trees.news(self._now_ns)
            self._worker.submit("places", partial(trees.work, question, news), self._post, SLICE_CELLS * _CELL_NS)

    @property
    def _goes_on(self) -> bool:
        """True if a question has had a slice and is still to be answered."""
        return bool(self._going_on) or (self._at_work is not None and self._at_work.version >= 0)

    def _starts_now(self, trees: _ClassTrees, question: _Question) -> bool:
        """Moves the start of a route that no vehicle asked for to where the vehicle is by now. Returns False if it
        goes elsewhere."""
        for vehicle in question.request.vehicles:
            follower = trees.followers.get(vehicle)
            if follower is None or follower.goal != question.request.to:
                return False
            question.request = msgspec.structs.replace(question.request, cells=[follower.cell])
        return True

    def _trees(self, name: str) -> _ClassTrees:
        trees = self._classes.get(name)
        if trees is None:
            scenario, cost_map = self._scenario, self._cost_maps[name]
            padded = (cost_map.grid.rows + 2) * (cost_map.grid.cols + 2)
            budget = settings.place_trees_bytes(settings.PLACE_TREES_BYTES, len(self._cost_maps), padded)
            trees = _ClassTrees(cost_map, scenario.planner, budget, scenario.vehicles.route_cells)
            self._classes[name] = trees
            log.info("places of %s: trees for the class %s", self._job, name)
        return trees

    def _worked(self, done: _Slice, now_ns: int) -> None:
        question, self._at_work = self._at_work, None
        if question is None:
            return
        trees = self._trees(question.request.vehicle_class)
        self.counters.count("place_cells_grown", done.grown)
        trees.followers.touch(Window(0, 0, 0, 0), done.changed)
        for vehicle in done.outdone:
            trees.followers.mark_stale(vehicle)
        if not question.done and (question.event is None or now_ns - question.asked_ns < _HOLD_NS):
            self._going_on.append(question)
        elif question.event is None:
            self._push_routes(trees, question, now_ns)
        else:
            self._reply(trees, question, question.event, now_ns)
        self._go_on()

    def _reply(self, trees: _ClassTrees, question: _Question, event: Asked, now_ns: int) -> None:
        request, routes = question.request, question.routes
        reply = PlaceRouteReply(
            to_cell=request.to,
            incarnation=self._incarnation,
            map_version=max(question.version, 0),
            routes=routes.columns(),
            status=trees.status(question),
            vehicle_class=request.vehicle_class,
            nearest_cell=question.nearest,
        )
        event.answer(reply, places=self._job)
        event.end()
        self.counters.count("routes_served", len(question.found))
        for vehicle, route in zip(request.vehicles, routes, strict=False):
            if _asker(vehicle) == event.asker:  # no other asker may have it pushed routes
                push_ns = now_ns + self._push_ns
                trees.followers.given(vehicle, route, request.max_cells, now_ns, push_ns, request.to)

    def _drop(self, question: _Question, reason: str) -> None:
        """Leaves a question without an answer. Vehicles which did not ask are pushed a route later."""
        if question.event is not None:
            self._refuse(question.event, reason)
            return
        followers = self._trees(question.request.vehicle_class).followers
        for vehicle in question.request.vehicles:
            followers.mark_stale(vehicle)

    def _refuse(self, event: Asked, reason: str) -> None:
        self.counters.count("place_questions_refused")
        super()._refuse(event, reason)

    # --- published without a question ---------------------------------------------------------------------------

    def _forget_routes(self) -> None:
        """Forgets the given routes, so that each follower is pushed one: this process does not know which routes
        they have."""
        for trees in self._classes.values():
            trees.followers.forget_routes()

    def _push_due(self, now_ns: int) -> None:
        """Asks for the routes of those followers which a change concerns. An empty question lets the worker learn
        of changes while no other asks."""
        for heard in self._bus.collected(SENT):
            assert isinstance(heard.message, Chasers)
            if heard.message.target is None and heard.message.vehicle_class in self._cost_maps:
                self._trees(heard.message.vehicle_class).followers.on_chasers(heard.message, now_ns)
        for name, trees in self._classes.items():
            trees.followers.drop_silent(now_ns)
            if not self._leads or not self._has_kernels(name):
                continue
            if len(trees.followers) and trees.cost_map.dirty and not (self._near or self._far):
                self._wait(_Question(None, self._job, PlaceRouteRequest(to=0, vehicle_class=name), now_ns))
            for (goal, max_cells), batch in trees.followers.due(now_ns).items():
                for id, follower in batch:
                    asker = _asker(id)
                    if goal is not None and asker not in self._foreign:
                        request = PlaceRouteRequest(
                            to=goal, cells=[follower.cell], vehicles=[id], max_cells=max_cells, vehicle_class=name
                        )
                        self._wait(_Question(None, asker, request, now_ns))

    def _push_routes(self, trees: _ClassTrees, question: _Question, now_ns: int) -> None:
        request, followers = question.request, trees.followers
        batch = [(id, follower) for id in request.vehicles if (follower := followers.get(id)) is not None]
        batch = [each for each in batch if each[1].goal == request.to]
        routes = question.routes
        for id, route in followers.pushed(batch, routes, now_ns + self._push_ns) if batch else ():
            self._push(
                PushedRoute(
                    vehicle=id,
                    target=None,
                    incarnation=self._incarnation,
                    target_cell=request.to,
                    map_version=max(question.version, 0),
                    route=route,
                )
            )
            self.counters.count("pushes")

    def _obeys(self, order: Obey) -> bool:
        """A zone is obeyed once the map has it: the next question finds it in the trees."""
        pending = any(each.cost_map.dirty for each in self._classes.values())
        return order.subject is not None or (
            not (pending and self._goes_on) and self._sync.holds(order.author, order.sets, self._now_ns)
        )


def _asker(vehicle: str) -> str:
    """The name under which the agent of a vehicle asks, or a rover, which is its own agent."""
    agent = settings.agent_of(vehicle)
    return asker_of("rover" if agent == vehicle else "agent", agent)
