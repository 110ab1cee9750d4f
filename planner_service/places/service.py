"""The shell of `places`: routes between any two cells of the map, for groups that share their marks.

A place is a goal without a process of its own: its tree is grown as far as its askers are and is kept for the next
(`GoalTrees`). The worker grows beside the loop, a slice of cells at a time. Between two slices the map takes its
changes, and the asker that has paid least is next. Nothing here must outlive the process: the one that takes over
grows again when asked.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from planner_service.goal_trees import GoalAnswer, GoalTrees
from planner_service.planner import MOST_ROUTES, MOST_STEPS
from planner_service.tree.cost_grid import CostGrid
from shared_map.cost_map import CostMap
from shared_map.learning.learned_factors import LearnedGauges
from shared_map.replication.mark_filter import MarkFilter
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import class_terrains
from shared_map.vehicle_class_maps import ClassMaps
from swarm.bus.bus import Asked, Bus, Event, Post, WorkDone, Worker
from swarm.clock import NS_PER_S
from swarm.config.agents import PLACE_TREES_BYTES, place_job, place_trees_bytes, plan_agents, readable_groups
from swarm.config.explain import choice
from swarm.config.vehicle_classes import GROUND, class_numbers
from swarm.grid import GridSpec
from swarm.liveness import job_of
from swarm.runtime.election import Candidacy
from swarm.runtime.fair_queue import FairQueue
from swarm.runtime.membership import Member
from swarm.runtime.order_client import OrderClient
from swarm.runtime.role import RoleSetup
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import PlaceRouteReply, PlaceRouteRequest
from swarm.wire.route_columns import LETHAL_START, NO_TARGET, OK, OUTSIDE, UNREACHABLE, RouteBatch, directions_of
from swarm.wire.topics import PLACE_ROUTE, asker_of, is_own

log = logging.getLogger(__name__)

SLICE_CELLS = 1 << 16
"""Cells that are grown before others have their turn: 1 to 4 ms."""
_MOST_WAITING, _MOST_EACH = 1 << 17, 1 << 15
"""Prices of the questions that wait, of all askers and of one. Of more the oldest are refused."""
_BASE_PRICE, _CELLS_OF_A_PRICE = 16, 1 << 10
"""Price of a question without its routes, which bounds how many wait; and cells grown at the price of a route."""
_HOLD_NS = NS_PER_S
"""A question waits so long at most for its growth; then it is answered as far as it is known."""
_KEEPS_UP_NS = NS_PER_S
"""While a question goes on, its map is so old at most: else marks beside a goal would end no growth."""
_CELL_NS = 25
"""Time that a simulation counts for a cell grown."""
_STATUSES = {
    "ok": OK, "unreachable": UNREACHABLE, "outside": OUTSIDE, "lethal_start": LETHAL_START,
    "lethal_goal": UNREACHABLE, "growing": NO_TARGET,
}  # fmt: skip


@dataclass(slots=True, eq=False)
class _Question:
    """A question, and as much of its answer as is known."""

    event: Asked
    request: PlaceRouteRequest
    asked_ns: int
    found: list[GoalAnswer] = field(default_factory=list)
    rests: list[float] = field(default_factory=list)
    """s, what remains after the steps of each route that are given."""
    version: int = -1
    """Version of the map on which they were found."""

    @property
    def done(self) -> bool:
        return len(self.found) == len(self.request.cells)


class _ClassTrees:
    """The map of one class of vehicles, and the trees on it."""

    def __init__(self, cost_map: CostMap, costs: CostGrid, budget_bytes: int) -> None:
        self.cost_map = cost_map
        self._costs = costs
        cost_map.take_dirty()
        costs.load(cost_map.pace_s_per_m)
        self.map_version = cost_map.version
        self.trees = GoalTrees(costs, budget_bytes)
        self.kept_up_ns = 0

    def keep_up(self, now_ns: int) -> None:
        """Takes the changes of the map. Not beside a growth."""
        self.kept_up_ns = now_ns
        if self.cost_map.dirty:
            self.trees.changed(self._costs.apply(self.cost_map.pace_s_per_m, self.cost_map.take_dirty()))
        self.map_version = self.cost_map.version

    def work(self, question: _Question) -> int:
        """Answers as much of a question as a slice of cells gives. Returns the cells that it has grown."""
        request, grown = question.request, 0
        if question.version != self.map_version:
            question.found, question.rests, question.version = [], [], self.map_version
        most, walked = _most_steps(request), 0
        while not question.done and grown + walked < SLICE_CELLS:
            start = request.cells[len(question.found)]
            answer = self.trees.ask(request.to, start, SLICE_CELLS - grown)
            grown += answer.grown_cells
            if answer.status == "growing":
                break
            rest, walked = 0.0, walked + answer.cells.size
            if most < answer.cells.size - 1:
                rest = self.trees.ask(request.to, int(answer.cells[most]), SLICE_CELLS).cost_s
                answer = replace(answer, cells=answer.cells[: most + 1].copy())
            question.found.append(answer)
            question.rests.append(rest)
        return grown

    def reply(self, question: _Question, incarnation: int) -> PlaceRouteReply:
        """The answer as it is known. Cells that are still to be reached have the status NO_TARGET."""
        request, found = question.request, question.found
        status = "ok" if question.done else "growing"
        if any(each.status == "lethal_goal" for each in found):
            status = "lethal_goal"
        elif not 0 <= request.to < self._costs.grid.cells:
            status = "outside_goal"
        known = _batch(found, request.cells, question.rests, self._costs)
        return PlaceRouteReply(
            to_cell=request.to,
            incarnation=incarnation,
            map_version=max(question.version, 0),
            routes=known.columns(),
            status=status,  # type: ignore[arg-type]
            vehicle_class=request.vehicle_class,
        )


def _most_steps(request: PlaceRouteRequest) -> int:
    """Steps of each route: as many as are asked for, and fit into one answer."""
    most = MOST_STEPS // max(len(request.cells), 1)
    return min(request.max_cells or most, most)


def _batch(found: list[GoalAnswer], cells: list[int], rests: list[float], costs: CostGrid) -> RouteBatch:
    """The routes of some answers."""
    grid: GridSpec = costs.grid
    codes = [directions_of(each.cells, grid.cols) for each in found]
    unknown = len(cells) - len(found)
    codes += [b""] * unknown
    lengths = [_length_m(each, costs) for each in codes]

    def column(values: list[float], rest: float) -> NDArray[np.float64]:
        return np.array([*values, *[rest] * unknown], np.float64)

    return RouteBatch(
        np.array([*(_STATUSES[each.status] for each in found), *[NO_TARGET] * unknown], np.uint8),
        np.array(cells, np.int64),
        np.frombuffer(b"".join(codes), np.uint8),
        np.cumsum([len(each) for each in codes], dtype=np.int64),
        column([each.cost_s for each in found], math.inf),
        column([each.lower_bound_s if each.status == "ok" else 0.0 for each in found], 0.0),
        np.array(lengths, np.float64),
        column(rests, 0.0),
    )


def _length_m(codes: bytes, costs: CostGrid) -> float:
    diagonal = np.count_nonzero(np.frombuffer(codes, np.uint8) & 1)
    return float((len(codes) - diagonal + diagonal * costs.diagonal) * costs.grid.resolution_m)


class PlacesService:
    """Serves routes between any two cells. The process is named after the first group that it serves.

    kernels  whether those of all classes may be called by now, not only of "ground"; if not given, they may
    """

    def __init__(
        self,
        setup: RoleSetup,
        terrain: Terrain,
        bus: Bus,
        post: Post,
        worker: Worker,
        kernels: Callable[[], bool] | None = None,
    ) -> None:
        scenario = setup.scenario
        self._scenario, self._job, self._incarnation = scenario, job_of(setup.id), setup.incarnation
        self._bus, self._post, self._worker = bus, post, worker
        self._kernels = kernels or (lambda: True)
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post, setup.before)
        self._candidacy = Candidacy(setup, scenario.standbys.planner, scenario.planner.tick_hz, bus, post)
        self.counters = self._member.counters
        self._cost_map = CostMap(terrain, learning=scenario.map.learning)
        filter = MarkFilter(terrain.grid, readable_groups(scenario, self._job))
        self._maps = ClassMaps(self._cost_map, class_terrains(scenario, terrain), class_numbers(scenario))
        self._replica = MapReplica(terrain.grid, self._maps, filter=filter)
        self._sync = MapSync(self._replica, bus, post, scenario.map, setup.role, at_ticks=True)
        self._learned = LearnedGauges(self._cost_map.keys, self.counters)
        self._obedience = OrderClient(setup, bus, post, self._obeys)
        self._classes: dict[str, _ClassTrees] = {}
        self._waiting: FairQueue[_Question] = FairQueue(_MOST_WAITING, _MOST_EACH)
        self._at_work: _Question | None = None
        """The question of which the worker has a slice."""
        self._going_on: set[int] = set()
        """Identities of the questions that wait for their next slice."""
        self._leads = False
        self._now_ns = 0
        for name in ("place_routes", "place_cells_grown", "place_questions_refused"):
            self.counters.count(name, 0)
        self._member.needs("the shared map", lambda: self._sync.joined)

    def lacks(self) -> list[str]:
        return self._member.lacks()

    def start(self, now_ns: int) -> None:
        self._member.join()
        self._sync.start(now_ns)
        self._obedience.start(now_ns)
        self._candidacy.start()
        self._lead(self._candidacy.leads, now_ns)

    def handle(self, event: Event, now_ns: int) -> None:
        self._now_ns = now_ns
        match event:
            case Asked(request=PlaceRouteRequest() as request):
                self._take(event, request, now_ns)
            case WorkDone(result=int() as grown):
                self._worked(grown, now_ns)
            case _ if not self._member.on_member_event(event):
                handlers = (
                    self._sync.on_map_event,
                    self._candidacy.on_election_event,
                    self._obedience.on_order_event,
                )
                any(handle(event, now_ns) for handle in handlers)

    def tick(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._sync.tick(now_ns)
        self._learned.tick(self._cost_map.factors)
        self._lead(self._candidacy.tick(not self.lacks(), now_ns), now_ns)
        self.counters.gauge("places_waiting", float(len(self._waiting)))
        self.counters.gauge("place_trees", float(sum(each.trees.trees for each in self._classes.values())))
        self.counters.gauge("place_bytes", float(sum(each.trees.bytes for each in self._classes.values())))
        self._obedience.tick(now_ns)
        self._go_on()
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._candidacy.stop()
        if self._at_work is not None:
            self._refuse(self._at_work.event, "the process ends")
            self._at_work = None
        while (question := self._waiting.take()) is not None:
            self._refuse(question.event, "the process ends")
        self._member.publish_stats(now_ns)

    def _lead(self, leads: bool, now_ns: int) -> None:
        if leads == self._leads:
            return
        self._leads = leads
        if leads:
            self._bus.serve(PLACE_ROUTE, self._post, undecoded=True, places=self._job)
        else:
            self._bus.unserve(PLACE_ROUTE, places=self._job)
        self._candidacy.tell(self._member, now_ns)

    # --- questions ----------------------------------------------------------------------------------------------

    def _take(self, event: Asked, request: PlaceRouteRequest, now_ns: int) -> None:
        name = request.vehicle_class
        if name != GROUND and name not in self._maps.of:
            known = [GROUND, *self._maps.of]
            self._refuse(event, f"there is no class {name!r}{choice(name, known, ' there are ')}")
        elif (other := self._foreign(event.asker)) is not None:
            self._refuse(event, f"{event.asker} is of group {other}: ask its own places")
        elif len(request.cells) > MOST_ROUTES:
            self._refuse(event, f"{len(request.cells)} routes at once, at most {MOST_ROUTES}: ask in parts")
        elif name != GROUND and not self._kernels():
            self._refuse(event, f"the kernels for class {name} are still being compiled")
        else:
            self._wait(_Question(event, request, now_ns), self._price(request))
            self._go_on()

    def _foreign(self, asker: str) -> str | None:
        """The group of an agent which may not know what this process knows; None of all others. Routers hold the
        name of an asker against its certificate."""
        groups = (plan.group.name for plan in plan_agents(self._scenario) if asker == asker_of("agent", plan.id))
        group = next(groups, None)
        return None if group is None or place_job(self._scenario, group) == self._job else group

    def _wait(self, question: _Question, price: int) -> None:
        asker = question.event.asker
        for dropped in self._waiting.put(asker, question, price=price, rank=0 if is_own(asker) else 1):
            self._going_on.discard(id(dropped))
            self._refuse(dropped.event, "too many questions wait here already: ask again in a second")

    def _price(self, request: PlaceRouteRequest) -> int:
        """The price of the next slice: a growth takes about three times the square of the distance in cells."""
        cols = self._cost_map.grid.cols
        row, col = divmod(request.to, cols)
        away = (max(abs(cell // cols - row), abs(cell % cols - col)) for cell in request.cells)
        cells = min(3 * max(away, default=0) ** 2, SLICE_CELLS)
        return _BASE_PRICE + len(request.cells) + cells // _CELLS_OF_A_PRICE

    def _go_on(self) -> None:
        """Gives the worker the next slice, if it has none."""
        while self._at_work is None and (question := self._waiting.take()) is not None:
            if question.event.expired:
                self._going_on.discard(id(question))
                question.event.end()
                continue
            trees = self._trees(question.request.vehicle_class)
            if not self._going_on or self._now_ns - trees.kept_up_ns >= _KEEPS_UP_NS:
                trees.keep_up(self._now_ns)
            self._at_work = question
            self._worker.submit("places", partial(trees.work, question), self._post, SLICE_CELLS * _CELL_NS)

    def _trees(self, name: str) -> _ClassTrees:
        trees = self._classes.get(name)
        if trees is None:
            cost_map = self._cost_map if name == GROUND else self._maps.of[name]
            costs = CostGrid(cost_map.grid, self._scenario.planner, cost_map.terrain.climb)
            budget = place_trees_bytes(PLACE_TREES_BYTES, 1 + len(self._maps.of), costs.size)
            trees = self._classes[name] = _ClassTrees(cost_map, costs, budget)
            log.info("places of %s: trees for the class %s", self._job, name)
        return trees

    def _worked(self, grown: int, now_ns: int) -> None:
        question, self._at_work = self._at_work, None
        if question is None:
            return
        self._going_on.discard(id(question))
        self.counters.count("place_cells_grown", grown)
        if question.done or now_ns - question.asked_ns >= _HOLD_NS:
            trees = self._trees(question.request.vehicle_class)
            question.event.answer(trees.reply(question, self._incarnation), places=self._job)
            question.event.end()
            self.counters.count("place_routes", len(question.found))
        else:
            self._going_on.add(id(question))
            self._wait(question, self._price(question.request))
        self._go_on()

    def _obeys(self, order: Obey) -> bool:
        """A zone is obeyed once the map has it: the next question finds it in the trees."""
        pending = any(each.cost_map.dirty for each in self._classes.values())
        return order.subject is not None or (
            not (pending and self._going_on) and self._sync.holds(order.author, order.sets, self._now_ns)
        )

    def _refuse(self, event: Asked, reason: str) -> None:
        self.counters.count("place_questions_refused")
        event.refuse(reason)
        event.end()
