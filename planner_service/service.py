"""The planner's shell: messages from the bus to the core, its answers and actions to the bus and the worker."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial

import msgspec

from planner_service.kernels.stride_networks import StrideNetwork
from planner_service.planner import Action, Answer, Planner, Refusal, Work
from planner_service.planning_process import Planning, PlanningProcess
from planner_service.strategy import StrategyWorld, strategy_of
from planner_service.target_search import TargetSearch, hidden_target
from planner_service.target_tree import TargetTree
from planner_service.tracker_notes import TargetWatch
from planner_service.tree.partitioned_tree import GrownTree
from shared_map.array_files import Floats
from shared_map.cost_map import CostMap
from shared_map.replication.interest import readable_for_target
from shared_map.sightings import Presence, Sightings, pose_of
from swarm.bus.bus import Asked, Event, Heard, LinkChanged, WorkDone
from swarm.clock import NS_PER_S
from swarm.config.vehicle_classes import GROUND
from swarm.peers import job_of
from swarm.plugins import named_plugin
from swarm.wire import topics
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import (
    Believed,
    CostRequest,
    PlannerStatus,
    PushedRoute,
    RouteRequest,
    Sighted,
    TargetPose,
)
from swarm.wire.messages.vehicles import Chasers, Fleet

log = logging.getLogger(__name__)

_PRESENCE_NS = 5 * NS_PER_S
"""A vehicle that was silent for this time sees nothing."""
_HOLD_NS, _MOST_HELD = NS_PER_S, 256
"""A query waits at most this time for a tree to answer from, and of more the oldest are answered at once."""
_AWAITED_NS = 10 * NS_PER_S
"""A target without a first pose for this time is an alarm: simulated targets have theirs within two seconds."""
_AT_ONCE, _ROUTE_COST = 1 << 16, 64
"""Costs after which waiting queries wait for the next tick or event, some 10 ms; a route counts as 64 of them."""
UNUSED_NS = 60 * NS_PER_S
"""A tree of a class without a query for this time is dropped."""
_BEGINS_NS = NS_PER_S
"""A query waits at most this time for the first tree of its class."""


class PlannerService(PlanningProcess):
    """Serves routes and costs to the target that the process is named after.

    stopwatch     the CPU time of this thread, ns, that growths on it are timed with; a simulation gives none, and a
                  model is used
    shared_costs  cell costs of the terrain before any mark; None: it computes them. Nothing else depends on it
    """

    def __init__(
        self,
        planning: Planning,
        all_kernels: Callable[[], bool] | None = None,
        stopwatch: Callable[[], int] | None = None,
        shared_costs: Floats | None = None,
    ) -> None:
        setup, grid = planning.setup, planning.terrain.grid
        scenario, self._target = setup.scenario, job_of(setup.id)
        self._heard_groups = readable_for_target(scenario, self._target)
        key = {"target": self._target}
        served = dict.fromkeys((topics.ROUTE, topics.COST, topics.NAMELESS_ROUTE, topics.NAMELESS_COST), key)
        super().__init__(planning, self._heard_groups, served, all_kernels)
        self._stopwatch = stopwatch
        # Position of the target.
        self._watch = TargetWatch(self._target, grid, self.counters, leads=False)
        self._untracked = self._target in scenario.untracked
        self._sightings = Sightings(self._mark_filter)
        self._presence = Presence(_PRESENCE_NS, self._mark_filter)
        """Positions of vehicles that may see the target; empty for a target that has a tracker."""
        self._listens = False
        """True if it subscribes to positions and views of vehicles."""
        self._faults: list[str] = []
        """Faults of the strategy's plug-in that are not reported yet."""
        world = StrategyWorld(self._target, grid, scenario.planner)
        self._chosen_by = strategy_of(named_plugin(scenario, "planner.strategy"), world, self._faults.append)
        tree = self._new_tree(self._cost_maps[GROUND])
        if shared_costs is not None:
            tree.share(shared_costs)
        hidden = hidden_target(scenario, self._target, setup.incarnation)
        self._search = TargetSearch(hidden, tree.cost_grid, scenario.time_scale)
        self._planner = self._new_planner(GROUND, self._cost_maps[GROUND], tree)
        """The planner of "ground", which is always there."""
        self._planners = {GROUND: self._planner}
        """Class -> its planner, as long as it has queries; "ground" first."""
        self._begun_ns: dict[str, int] = {}
        self._used_ns: dict[str, int] = {}
        """Classes beside "ground": when the planner was made, which tells it from one that was dropped; and when
        it was needed last."""
        self._obeyed_version = 0
        self._removed = False
        """True if its target was removed: then it serves no queries."""
        self._forced = False
        """True if another than an agent has forced the tree to grow since the last tick."""
        self._served = False
        self._began_ns = 0
        """Time of `start`."""
        self._held: list[tuple[int, Asked]] = []
        """Queries that came while there was nothing to answer from, and when; the oldest first."""
        self.counters.count("marks_merged", 0)
        # A target that is searched for, or was removed, needs none.
        self._member.needs(
            f"a tree of {self._target}", lambda: self._untracked or self._removed or self._planner.tree.ready
        )

    def _new_tree(self, cost_map: CostMap) -> TargetTree:
        return TargetTree(
            cost_map.grid,
            self._scenario.planner,
            cost_map.terrain.climb,
            self._all_kernels,
            has_worker=True,
            chosen_by=self._chosen_by,
            stopwatch=self._stopwatch or (lambda: 0),
        )

    def _new_planner(self, name: str, cost_map: CostMap, tree: TargetTree) -> Planner:
        """The planner of a class. Timestamps of marks and data shared by other processes go to that of "ground"."""
        scenario, is_ground = self._scenario, name == GROUND
        return Planner(
            self._watch,
            self._incarnation,
            scenario.planner,
            tree,
            cost_map,
            self.counters,
            route_cells=scenario.vehicles.route_cells,
            stopwatch=self._stopwatch,
            newest_mark_ns=self._replica.take_newest_stamp_ns if is_ground else lambda: None,
            leads=False,
            target_search=self._search,
            vehicle_class=name,
        )

    def _used(self, name: str, now_ns: int) -> Planner:
        """Returns the planner of a known class that is needed; made if it is missing."""
        planner = self._planners.get(name)
        if planner is None:
            cost_map = self._cost_maps[name]
            planner = self._planners[name] = self._new_planner(name, cost_map, self._new_tree(cost_map))
            planner.lead(self._planner.leads)
            self._pace(planner)
            self._begun_ns[name] = now_ns
            log.info("target %s: a tree for the class %s", self._target, name)
        if name != GROUND:
            self._used_ns[name] = now_ns
        return planner

    def _drop_unused(self, now_ns: int) -> None:
        for name, used_ns in list(self._used_ns.items()):
            if now_ns - used_ns >= UNUSED_NS:
                del self._planners[name], self._used_ns[name], self._begun_ns[name]

    def _must_wait(self, name: str, cells: list[int], now_ns: int) -> bool:
        """Returns True if a query from these cells should wait: no tree answers them yet, but soon."""
        planner = self._planners[name]
        is_new = name in self._begun_ns and now_ns - self._begun_ns[name] < _BEGINS_NS
        return planner.must_wait(cells) or (is_new and planner.begins)

    def start(self, now_ns: int) -> None:
        self._began_ns = now_ns
        if self._untracked:
            self._listen(True)
        else:
            self._bus.collect(topics.POSE, target=self._target)
        self._bus.collect(topics.CHASERS, target=self._target)
        super().start(now_ns)

    def handle(self, event: Event, now_ns: int) -> None:
        if isinstance(event, LinkChanged) and event.up:
            for planner in self._planners.values():
                planner.push_all()
        match event:
            case Asked(request=RouteRequest() | CostRequest()):
                self._held.append((now_ns, event))
                self._answer(now_ns)
            case Heard(message=Sighted() as sighted):
                self._on_sighted(sighted, now_ns)
            case WorkDone(tag=tag, result=GrownTree() as grown, took_ns=took_ns):
                self._on_grown(tag, grown, took_ns, now_ns)
            case WorkDone(tag=tag, result=StrideNetwork() as found):
                if (asked_by := self._asked_by(tag)) is not None:
                    asked_by.tree.take_strides(found)
            case _:
                super().handle(event, now_ns)

    def _on_grown(self, tag: str, grown: GrownTree, took_ns: int, now_ns: int) -> None:
        planner = self._asked_by(tag)
        if planner is not None:
            self._perform(planner, planner.adopt(grown, took_ns, now_ns), now_ns)
        self._answer(now_ns)

    def tick(self, now_ns: int) -> None:
        self._take_collected(now_ns)
        self._take_map(now_ns)
        self._sightings.expire(now_ns)
        self._take_fleet(now_ns)
        self._obey()
        self._lead(self._candidacy.tick(self._planner.tree.ready, now_ns) and not self._removed, now_ns)
        for note in self._watch.drain(now_ns):
            log.info("%s: %s", note.kind, note.text)
            self._member.note(now_ns, note.kind, note.text, note.cell)
        self._drop_unused(now_ns)
        for planner in self._planners.values():
            self._perform(planner, planner.tick(now_ns), now_ns)
        self._order_client.tick(now_ns)
        self._forced = False
        self._answer(now_ns)
        for name in ("marks_merged", "sets_foreign"):
            self.counters.counts[name] = self._replica.counts[name]
        if self._planner.tree.ready and not self._served:
            self._served = True
            log.info("first tree: target %s, map version %d", self._target, self._planner.tree.map_version)
        self._warn_lethal(now_ns)
        self._warn_no_tracker(now_ns)
        self._member.note_faults(self._faults, now_ns)
        self._member.tick(now_ns)

    def _warn_lethal(self, now_ns: int) -> None:
        lethal = self._planner.tree.lethal_target
        if lethal is None or not self._candidacy.leads:
            self._member.alarms.end("target-lethal", self._target, now_ns)
            return
        grid = self._cost_maps[GROUND].grid
        cells = [f"cell:{row},{col}" for row, col in (grid.row_col(each) for each in lethal if each is not None)]
        nearest = f"the nearest cell that can be reached is {cells[1]}" if cells[1:] else "no cell near it is open"
        text = f"no vehicle can reach {self._target} on lethal ground at {cells[0]}; {nearest}"
        self._member.alarms.begin("target-lethal", self._target, text, now_ns, lethal.cell, self._target)

    def _warn_no_tracker(self, now_ns: int) -> None:
        waits = self._candidacy.leads and self._watch.pose is None and not (self._untracked or self._removed)
        if waits and now_ns - self._began_ns >= _AWAITED_NS:
            text = f"no tracker has published {self._target} since its planner started; its vehicles wait"
            self._member.alarms.begin("no-tracker", self._target, text, now_ns, target=self._target)
        else:
            self._member.alarms.end("no-tracker", self._target, now_ns)

    def _take_collected(self, now_ns: int) -> None:
        for heard in self._bus.collected(topics.POSE):
            assert isinstance(heard.message, TargetPose)
            self._watch.on_pose(heard.message, now_ns)
        for heard in self._bus.collected(topics.CHASERS):
            assert isinstance(heard.message, Chasers)
            name = heard.message.vehicle_class
            if self._fault_of(name) is None and (heard.message.ids or name in self._planners):
                self._used(name, now_ns).on_chasers(heard.message, now_ns)

    def _on_sighted(self, sighted: Sighted, now_ns: int) -> None:
        if not self._listens or not self._sightings.receive(sighted, now_ns):
            return  # a tracker knows better
        seen = self._sightings.best(now_ns)
        for each in seen.values():
            self._watch.on_sighting(pose_of(each), now_ns)
        if not seen and 0 <= sighted.cell < self._cost_maps[GROUND].grid.cells:
            self._search.remember(sighted, now_ns)

    def _tag(self, name: str) -> str:
        """Returns the tag of a job for the planner of a class."""
        return f"{name}/{self._begun_ns.get(name, 0)}"

    def _asked_by(self, tag: str) -> Planner | None:
        """The planner that asked for a piece of work; None if it was dropped since: another one of its class has
        begun with the map as it was later."""
        name, _ = tag.split("/")
        return self._planners.get(name) if tag == self._tag(name) else None

    def _take_fleet(self, now_ns: int) -> None:
        """Takes the positions of vehicles, which may see a target without a living tracker."""
        if self._search.tracked:
            self._listen(self._watch.lost(now_ns))
        if not self._listens:
            return
        for heard in self._bus.collected(topics.FLEET):
            assert isinstance(heard.message, Fleet)
            self._presence.receive(heard.message, now_ns)
        self._presence.expire(now_ns)
        self._search.hear_vehicles(*self._presence.columns())

    def _listen(self, listens: bool) -> None:
        """Receives positions and sightings of vehicles, or stops receiving them."""
        if listens == self._listens:
            return
        self._listens = listens
        if listens:
            self._bus.subscribe(topics.SIGHTED, self._post, target=self._target)
            self._bus.collect(topics.FLEET)
        else:
            self._bus.unsubscribe(topics.SIGHTED, target=self._target)
            self._bus.unsubscribe(topics.FLEET)

    def _answer(self, now_ns: int) -> None:
        """Answers queries. If there will be a tree to answer from soon, a query waits for that, but not long.

        A query for one class never waits for the tree of another. Agents come first. After `_AT_ONCE` units of work
        the others wait for the next call. Only one query a tick that is not an agent's may force a growth.
        """
        held, self._held = self._held, []
        spent = 0
        for n, (asked_ns, event) in enumerate(sorted(held, key=lambda each: topics.rank_of(each[1].asker))):
            request = event.request
            assert isinstance(request, RouteRequest | CostRequest)
            name = request.vehicle_class
            fault = self._fault_of(name)
            if fault is not None:
                self._refuse(event, fault)
                continue
            planner = self._used(name, now_ns)
            crowded = len(self._held) + len(held) - n > _MOST_HELD
            may_wait = not crowded and now_ns - asked_ns < _HOLD_NS
            if (may_wait and self._must_wait(name, request.cells, now_ns)) or spent > _AT_ONCE:
                self._held.append((asked_ns, event))
                continue
            spent += (len(request.cells) + 1) * (_ROUTE_COST if isinstance(request, RouteRequest) else 1)
            if isinstance(request, RouteRequest) and request.force and topics.rank_of(event.asker):
                request, self._forced = msgspec.structs.replace(request, force=not self._forced), True
            planner.answer(request, now_ns, partial(self._send, event))

    def _send(self, asked: Asked, answer: Answer) -> None:
        if isinstance(answer, Refusal):
            asked.refuse(answer.reason)
        else:
            asked.answer(answer, target=self._target)
        asked.end()

    def _obey(self) -> None:
        """Applies orders."""
        book, scenario = self._order_client.book, self._scenario
        if book.version == self._obeyed_version:
            return
        self._obeyed_version = book.version
        self._removed = self._target not in book.targets(scenario)
        if any(order.subject in ("group", "target") for order in book):
            heard = readable_for_target(scenario, self._target, lambda group: book.targets_of(group, scenario))
            if heard != self._heard_groups:
                self._heard_groups = heard
                self._replica.read_groups(heard)
        for planner in self._planners.values():
            self._pace(planner)

    def _pace(self, planner: Planner) -> None:
        """Sets a planner's pace as it is ordered."""
        book, scenario = self._order_client.book, self._scenario
        self._search.time_scale = book.setting("time_scale", scenario.time_scale)
        planner.set_pace(
            book.setting("planner.cpu_budget", scenario.planner.cpu_budget),
            book.setting("planner.push_s", scenario.planner.push_s),
        )

    def _obeys(self, order: Obey) -> bool:
        if order.subject is not None:
            return self._obeyed_version == self._order_client.book.version
        # A zone may be for one class alone; trees of all classes must know of it.
        knows_map = all(planner.knows_map for planner in self._planners.values())
        return self._sync.holds(order.author, order.sets, self._now_ns) and knows_map

    def stop(self, now_ns: int) -> None:
        self._candidacy.stop()
        for _, event in self._held:
            self._refuse(event, f"{event.topic.name}: the planner ends")
        if self._planner.leads:
            self._publish_status(self._planner.status(now_ns))
        self._member.publish_stats(now_ns)

    def _lead(self, leads: bool, now_ns: int) -> None:
        if leads != self._leads:
            self._watch.leads = leads
            for planner in self._planners.values():
                planner.lead(leads)
        super()._lead(leads, now_ns)

    def _publish_status(self, status: PlannerStatus) -> None:
        """Publishes the status of "ground", with the vehicles of all classes."""
        following = sum(len(planner.followers) for planner in self._planners.values())
        status = msgspec.structs.replace(status, following=following)
        self._bus.publish(topics.STATUS, status, target=self._target)

    def _perform(self, planner: Planner, actions: list[Action], now_ns: int) -> None:
        name = planner.vehicle_class
        for action in actions:
            match action:
                case Work(job):
                    self._worker.submit(self._tag(name), job, self._post, planner.tree.times.model_ns)
                case PlannerStatus() if name != GROUND:
                    pass  # the planner of "ground" has published the same about the target
                case PushedRoute() as pushed:
                    self._push(pushed)
                case PlannerStatus() as status:
                    self._publish_status(status)
                case Believed() as believed:
                    self._bus.publish(topics.BELIEVED, believed, target=self._target)
