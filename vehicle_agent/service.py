"""The shell of an agent: carries messages to its parts, and what they decide to the bus.

Messages that are used at ticks are collected by the bus (`Bus.collect`); all others come as events. Each kind of
message has one handler, named after what it tells.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Asked, AskEnded, Bus, Disappeared, Event, Heard, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import place_job
from swarm.peers import Roster, job_of
from swarm.right_of_way.promise_store import PromiseStore
from swarm.runtime.membership import MemberService
from swarm.runtime.order_book import OrderClient
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.stats import GAPS_OF, GAPS_TO, UNPROVEN_OF, UNPROVEN_TO
from swarm.wire import topics
from swarm.wire.fields import column
from swarm.wire.messages import Message, planning
from swarm.wire.messages.orders import GoalState, GoalStates, Obey
from swarm.wire.messages.traffic import Granted, HostState, Left, Word
from swarm.wire.messages.vehicles import Followed, Obstacle, Removed, RemoveVehicles, SharedCosts, VehicleState
from vehicle_agent.agent import AgentAction, AskRoutes
from vehicle_agent.agent_parts import AgentParts
from vehicle_agent.driving.driven_vehicle import PLACES, Places, goal_of
from vehicle_agent.target_choice import AskCosts

log = logging.getLogger(__name__)

_ANSWER_S = 2.0
"""A planner's answer is waited for at most this time, or for several round trips where the link is slow."""
_TRIPS = 3.0
"""Round trips that an answer may take. Chosen, not measured."""
_LONGEST_ANSWER_S = 8.0
"""Bound on the wait for an answer, which doubles after each that did not come. Chosen, not measured."""
_ROUTES, _COSTS = "route-", "cost-"
"""Tags of what we ask, each with a number."""

_LONGEST_AGE_NS = 10 * NS_PER_S
"""An older report was stamped by a clock that does not agree with ours: no delay is measured by it."""
_GAUGES = [
    *((int(state), f"vehicles_{state.name.lower()}") for state in VehicleState),
    (int(VehicleState.STRANDED), "stranded"),
    (int(VehicleState.LOST), "lost"),
]
"""State of a vehicle -> the gauge that counts vehicles in it."""
_GOALS_APART_NS = NS_PER_S // 2
"""Least time between two messages about goals."""
_COUNTED_FROM_0 = ("reroute_requests", "routes_received", "marks", "blocked_ticks")

M = TypeVar("M", bound=Message)


class AgentService(MemberService):
    """Drives the vehicles of one agent, marks what they find, and publishes where they are.

    agent      the core
    driven     how often it has driven its vehicles
    when_over  called once all vehicles of an added agent have left

    Raises ConfigError if the scenario has no such agent, or too few free cells for its vehicles.
    """

    def __init__(
        self,
        setup: RoleSetup,
        terrain: Terrain,
        truth: NDArray[np.float32],
        bus: Bus,
        post: Post,
        store: PromiseStore,
    ) -> None:
        self._bus, self._post, self._setup = bus, post, setup
        self._parts = parts = AgentParts(setup, terrain, truth, bus, post, store, self._warn)
        self.agent, self._member, self._replica, self._sync = parts.agent, parts.member, parts.replica, parts.sync
        self._maps, self._right_of_way, self._detector = parts.maps, parts.right_of_way, parts.detector
        self._author, self._class = parts.author, self.agent.plan.group.vehicle_class
        for name in _COUNTED_FROM_0:
            self.counters.count(name, 0)
        self._order_client = OrderClient(setup, bus, post, self._obeys, self.agent.goals.book)
        self._places_job = place_job(setup.scenario, self.agent.plan.group.name)
        """The process that plans to places for the group."""
        self._obeyed_version = 0
        self._goals_sent: tuple[list[GoalState], int] = [], 0
        """The states of goals that were published last, and when."""
        self._roster = Roster()
        self._planners_changed = False
        """True if a planner has come or gone, or a target, since the agent was told of them."""
        self._now_ns = self._acted_ns = self.driven = 0
        self._answer_s = _ANSWER_S
        self._shut_in: set[str] = set()
        """Vehicles of which it has been said that obstacles shut them in."""
        self.when_over: Callable[[], None] | None = None
        self._removed: set[str] = set()
        """Vehicles that an operator has let leave in this generation."""
        self._member.needs("the shared map", lambda: self._sync.joined)
        self._member.needs("the orders of this run", lambda: self._order_client.known)
        self._member.needs("places for its vehicles", lambda: self._has_places)

    @property
    def over(self) -> bool:
        """True if all vehicles of an agent that was added have left."""
        spawning = self._parts.spawning
        return spawning is not None and spawning.over and self.agent.holdings.gone

    @property
    def _has_places(self) -> bool:
        """True if each vehicle has a place or has left. Added vehicles enter when there is space."""
        host = self._right_of_way.core.host
        if self._parts.spawning is not None:
            return host.informed
        absent = set(self.agent.plan.vehicle_ids).difference(self.agent.vehicles, self._removed)
        return not absent or host.have_left(absent)

    def start(self, now_ns: int) -> None:
        bus, post, id = self._bus, self._post, self._setup.id
        bus.watch_alive(post, role="planner")
        bus.watch_alive(post, role="places")
        self._right_of_way.start(now_ns)  # peers send a query as soon as they see this token
        self._member.join()
        self._sync.start(now_ns)
        self._order_client.start(now_ns)
        bus.collect(topics.POSE)
        if not self._parts.flies:  # obstacles are on the ground
            bus.collect(topics.OBSTACLE)
        self.agent.obstacles.listen_anew(now_ns)
        if untracked := self._detector.untracked:
            bus.collect(topics.TRUE_POSE)
            for target in sorted(untracked):
                bus.subscribe(topics.SIGHTED, post, target=target)
        bus.collect(topics.PUSHED_ROUTE, agent=id)
        if self._parts.costs is not None:
            bus.collect(topics.SHARED_COSTS, group=self.agent.plan.group.name)
        bus.serve(topics.LEAVE, post, agent=id)

    def handle(self, event: Event, now_ns: int) -> None:
        # Not for links beyond our router: of those anybody may tell, by a token, and no vehicle drives meanwhile.
        if isinstance(event, LinkChanged) and event.up and not event.beyond:
            self.agent.obstacles.listen_anew(now_ns)
        if self._member.on_member_event(event) or self._sync.on_map_event(event, now_ns):
            return
        if isinstance(event, Heard) and isinstance(event.message, Left | Granted | HostState | Word):
            awaited = self._right_of_way.is_awaited(event.message)
            self._place(self._right_of_way.hear(event.message, now_ns))
            if awaited:
                self._act(now_ns)
            return
        if self._right_of_way.on_cells_event(event, now_ns) or self._order_client.on_order_event(event, now_ns):
            return
        match event:
            case Asked(topic=topic, request=RemoveVehicles() as request) if topic is topics.LEAVE:
                event.answer(self._on_leave(request.vehicles), agent=self._setup.id)
                event.end()
            case Heard(message=planning.Sighted() as sighted):
                self._on_sighted(sighted, now_ns)
            case Replied(message=(planning.RouteReply() | planning.PlaceRouteReply()) as reply, took_s=took_s):
                self._answer_s = max(_ANSWER_S, _TRIPS * took_s)
                self._on_routes(event, reply, now_ns)
            case Replied(tag=tag, message=planning.CostReply() as reply, took_s=took_s):
                self._answer_s = max(_ANSWER_S, _TRIPS * took_s)
                self._on_costs(_number(tag), reply, now_ns)
            case AskEnded(tag=tag, failure=failure) if tag.startswith(_ROUTES):
                self._wait_longer(failure)
                self.agent.routes_ended(_number(tag), now_ns)
            case AskEnded(tag=tag, failure=failure) if tag.startswith(_COSTS):
                self._wait_longer(failure)
                self._on_costs_ended(_number(tag), now_ns)
            case Appeared() | Disappeared():
                self._on_planner(event, now_ns)
            case _:
                pass

    def _act(self, now_ns: int) -> None:
        """Acts on messages between two ticks, a few times per driven cell, while many vehicles wait: an act takes
        as long as a tick."""
        acts = self._acted_ns and now_ns - self._acted_ns >= self._parts.act_ns and self.agent.many_wait
        if acts and not self.agent.holdings.replaced:
            self._acted_ns = now_ns
            self.agent.obstacles.tick(now_ns)
            self._take_obstacles(now_ns)  # a process that was stopped acts before its next tick
            self._drive(now_ns)
            self._perform(self.agent.decide(now_ns))
            self._report(Places(self.agent.grid, self.agent.vehicles.values()), now_ns)
            self._right_of_way.tick(self.agent.cell_requests, now_ns)

    def _report(self, places: Places, now_ns: int) -> None:
        """Publishes where the vehicles are, each time that they have driven: between two reports they are where the
        first says."""
        for region, fleet in self._parts.fleet.reports(places, now_ns):
            self._bus.publish(topics.FLEET, fleet, region=region, author=self._author)

    def tick(self, now_ns: int) -> None:
        self._now_ns = self._acted_ns = now_ns
        agent, parts = self.agent, self._parts
        agent.obstacles.tick(now_ns)
        targets = self._order_client.book.targets(self._setup.scenario)
        for pose in self._collected(topics.POSE, planning.TargetPose):
            if pose.target in targets:  # a stranger may name any number of others
                self._on_pose(pose, now_ns)
        for pose in self._collected(topics.TRUE_POSE, planning.TargetPose):
            self._detector.set_truth(pose, now_ns)
        self._member.tick(now_ns)
        self._sync.tick(now_ns)
        for pushed in self._collected(topics.PUSHED_ROUTE, planning.PushedRoute):
            self.counters.count("routes_pushed")
            self._publish_followed(agent.route_pushed(pushed, now_ns))
        if parts.costs is not None:
            for costs in self._collected(topics.SHARED_COSTS, SharedCosts):
                parts.costs.receive(costs, now_ns)
        for placed in self._right_of_way.take_granted(now_ns):
            self._place(placed)
        if parts.spawning is not None:
            parts.spawning.tick(self._right_of_way.core.host.informed, now_ns)
        if agent.holdings.replaced and agent.vehicles:
            self._stand_down(now_ns)
        places = agent.places
        parts.zones.update(places, now_ns, agent.shut_ground)
        agent.set_exit_steps(parts.zones.exit_steps)
        self._obey(now_ns)
        self._set_planners(now_ns)
        agent.map_changed(self._maps.take_dirty(), now_ns, by_others=True)
        if places:
            self._sync.enter(parts.near_marks.update(places))
        self._take_obstacles(now_ns)
        self._drive(now_ns)
        columns = Places(agent.grid, agent.vehicles.values())
        self._publish_sighted(columns, now_ns)
        self._perform(agent.decide(now_ns))
        self.counters.count("blocked_ticks", agent.blocked_ticks)
        self.counters.counts["sets_foreign"] = self._replica.counts["sets_foreign"]
        self._report(columns, now_ns)
        paths, terrain_cell = agent.holdings.paths, agent.grid.terrain_cell
        self._publish_goals(now_ns)
        kept = agent.holdings.keeps + 1
        chasing = [
            (id, vehicle.target, list(map(terrain_cell, paths[id][:kept])))
            for id, vehicle in agent.vehicles.items()
        ]
        for chasers in parts.chasers.reports(chasing, now_ns):
            if chasers.target is None:
                self._bus.publish(topics.SENT, chasers, places=self._places_job, author=self._author)
            else:
                self._bus.publish(topics.CHASERS, chasers, target=chasers.target, author=self._author)
        self._right_of_way.tick(agent.cell_requests, now_ns)
        self._member.note_faults(parts.faults, now_ns)
        states = bytes([vehicle.state for vehicle in agent.vehicles.values()])
        for state, name in _GAUGES:
            self.counters.gauge(name, float(states.count(state)))
        if self.over and self.when_over is not None:
            self.when_over()

    def _wait_longer(self, failure: str | None) -> None:
        """Notes that a query has ended. After a timeout the next query may wait twice as long for its answer."""
        if failure == "timeout":
            self._answer_s = min(2 * self._answer_s, _LONGEST_ANSWER_S)

    def stop(self, now_ns: int) -> None:
        if self._parts.spawning is not None:
            self._on_leave([])  # an orderly end takes its vehicles away; a killed process leaves them
            self._right_of_way.tick(self.agent.cell_requests, now_ns)
        self._member.publish_stats(now_ns)

    def _collected(self, topic: topics.Topic, kind: type[M]) -> Iterator[M]:
        """Returns the messages that the bus has kept on a topic since the last tick."""
        for heard in self._bus.collected(topic):
            assert isinstance(heard.message, kind)
            yield heard.message

    # --- orders and places ----------------------------------------------------------------------------------

    def _obey(self, now_ns: int) -> None:
        """Applies orders."""
        orders, agent = self._order_client, self.agent
        agent.stopped = orders.book.stopped if orders.known else lambda vehicle: True
        if self._obeyed_version != orders.book.version:
            self._obeyed_version = orders.book.version
            self._planners_changed = True
            agent.decide_anew()
            scenario, book = self._setup.scenario, orders.book
            agent.set_targets(book.targets_of(agent.plan.group.name, scenario), now_ns)
            agent.set_pace(
                book.setting("time_scale", scenario.time_scale),
                book.setting("vehicles.reassign_s", scenario.vehicles.reassign_s),
            )
        agent.follow_goals(orders.shared, now_ns)
        orders.tick(now_ns)

    def _obeys(self, order: Obey) -> bool:
        if order.goals:
            return self.agent.goals_taken
        if order.subject is not None:
            return self._obeyed_version == self._order_client.book.version
        return self._sync.holds(order.author, order.sets, self._now_ns)

    def _publish_goals(self, now_ns: int) -> None:
        """Publishes how far vehicles are with their goals, and raises alarms about those which are blocked."""
        agent, since_ns = self.agent, now_ns - self._goals_sent[1]
        if not len(agent.goals.book) or since_ns < _GOALS_APART_NS:
            return
        states = agent.goal_states(self._removed)
        if states == self._goals_sent[0] and since_ns < NS_PER_S:
            return
        self._goals_sent = states, now_ns
        self._bus.publish(
            topics.GOAL_STATES,
            GoalStates(agent=self._setup.id, stamp_ns=now_ns, states=states),
            agent=self._setup.id,
        )
        blocked = {each.name: each for each in states if each.state == "blocked"}
        for name, each in blocked.items():
            self._member.alarms.begin("goal-blocked", name, f"{name} waits: {each.reason}", now_ns, each.cell)
        self._member.alarms.last_of("goal-blocked", blocked, now_ns)

    def _place(self, vehicles: Sequence[str]) -> None:
        """These have found their places."""
        if self._parts.spawning is not None:
            holdings, may_stand = self.agent.holdings, self._parts.spawning.may_stand
            closed = [id for id in vehicles if not may_stand(id, holdings.path(id)[0])]
            self.agent.remove(closed)
            vehicles = [id for id in vehicles if id not in closed]
        if vehicles:
            self.agent.place(vehicles)
            log.info("%d vehicles have their places", len(self.agent.vehicles))

    def _on_leave(self, asked: Sequence[str]) -> Removed:
        """Makes vehicles leave, all if none is named; for those already leaving reports the progress."""
        ours = self.agent.plan.vehicle_ids
        left = [id for id in ours if id in asked or not asked]
        self.agent.remove([id for id in left if id not in self._removed])
        self._removed.update(left)
        if self._parts.spawning is not None:
            self._parts.spawning.remove(left)
        held = sum(self.agent.holdings.is_granted(id) for id in left)
        unknown = sorted(set(asked).difference(ours))
        return Removed(agent=self._setup.id, left=left, unknown=unknown, held=held)

    def _warn(self, kind: str, text: str) -> None:
        self._member.warn(self._now_ns, kind, text)

    def _stand_down(self, now_ns: int) -> None:
        """A later generation of this agent drives the vehicles. While it lives, this one keeps its promises
        only."""
        self.agent.stand_down()
        text = f"agent {self._setup.id} runs elsewhere, too, and that one is younger: this one drives no more"
        log.warning(text)
        self._member.note(now_ns, "replaced", text)

    # --- targets and obstacles ---------------------------------------------------------------------------------

    def _on_pose(self, pose: planning.TargetPose, now_ns: int) -> None:
        """A tracker says where its target is."""
        if pose.target in self._detector.untracked:
            return
        counts = self.agent.take_pose(pose, now_ns)
        if counts is not None:  # for the simulated sensor of targets it is the truth
            self._detector.set_truth(counts, now_ns)
            self._take_target_obstacles(counts, now_ns)

    def _on_sighted(self, sighted: planning.Sighted, now_ns: int) -> None:
        """A vehicle, of ours or of others, has seen a target."""
        pose = self._detector.note_sighting(sighted, now_ns)
        if pose is not None:
            self.agent.see_target(pose, now_ns)
            self._take_target_obstacles(pose, now_ns)

    def _publish_sighted(self, places: Places, now_ns: int) -> None:
        self._detector.lose(self.agent.lost(now_ns), now_ns)
        seen = self._detector.detect(places, now_ns)
        if seen:
            self.counters.count("targets_sighted", len(seen))
        for sighted in (*seen, *self._detector.retold(now_ns)):
            self._bus.publish(topics.SIGHTED, sighted, target=sighted.target, author=self._author)
        for sighted in seen:
            self._on_sighted(sighted, now_ns)

    def _take_target_obstacles(self, pose: planning.TargetPose, now_ns: int) -> None:
        for obstacle in () if self._parts.flies else self._parts.target_obstacles.obstacles_of(pose, now_ns):
            self.agent.obstacles.take_report(obstacle, now_ns)

    def _take_obstacles(self, now_ns: int) -> None:
        obstacles = self.agent.obstacles
        # Of each sender only the newest counts in a tick: however many a stranger sends, the work is bounded.
        reports = sorted(self._collected(topics.OBSTACLE, Obstacle), key=lambda each: each.seq)
        for obstacle in {(each.id, each.incarnation): each for each in reports}.values():
            obstacles.take_report(obstacle, now_ns)
            age_ns = now_ns - obstacle.stamp_ns
            if 0 <= age_ns < _LONGEST_AGE_NS:  # by clocks that agree
                self.counters.observe("obstacle_ms", age_ns / 1e6)
        self.agent.obstacles_moved()
        self.counters.counts["obstacles_refused"] = obstacles.refused
        self.counters.counts["detours"] = self.agent.detours.found
        for text in obstacles.complaints:
            self._warn("obstacle", text)
        obstacles.complaints.clear()
        shut_in = self.agent.shut_in
        for id in sorted(shut_in - self._shut_in):
            cell = self.agent.vehicles[id].terrain_cell
            row, col = self._replica.grid.row_col(cell)
            text = f"{id} waits at row {row}, column {col}: obstacles leave no cell to which it can drive"
            self._warn("shut_in", text)
            self._member.alarms.begin("shut-in", id, text, now_ns, cell)
        self._member.alarms.last_of("shut-in", shut_in, now_ns)
        self._shut_in = set(shut_in)

    # --- driving and planners -------------------------------------------------------------------------------

    def _drive(self, now_ns: int) -> None:
        """Drives cell by cell, and writes findings on each into the map before driving on."""
        agent, learning = self.agent, self._maps.learning
        self.driven += 1
        agent.begin_drive(now_ns)
        while (found := agent.drive()) is not None:
            if len(findings := found.where(self._parts.zones.free(found.cells))):
                self.counters.count("marks", len(findings))
                self._sync.publish(self._replica.write(findings.cells, findings.kinds, findings.paces, now_ns))
                agent.map_changed(self._maps.take_dirty(), now_ns)
        if learning is not None and (measured := learning.tick(agent.take_driven(), now_ns)):
            self._sync.publish(self._replica.write_learned(measured, now_ns))

    def _on_planner(self, event: Appeared | Disappeared, now_ns: int) -> None:
        """A planner has come or gone."""
        self._planners_changed = True
        if isinstance(event, Appeared):
            self._roster.appeared(event.peer)
            if event.peer.role == "planner":
                self._detector.retell(job_of(event.peer.id), now_ns)
        else:
            self._roster.gone(event.peer)

    def _set_planners(self, now_ns: int) -> None:
        """Gives each target its living planner of best rank, once a tick, as anyone can announce names."""
        if self._planners_changed:
            self._planners_changed = False
            alive = self._roster.alive("planner")
            chased = {vehicle.target for vehicle in self.agent.vehicles.values()}
            known = chased.union(self._order_client.book.targets(self._setup.scenario))
            planners = {job_of(id): alive[id] for id in sorted(alive, reverse=True) if job_of(id) in known}
            places = self._roster.alive("places")
            if own := [id for id in sorted(places) if job_of(id) == self._places_job]:
                planners[PLACES] = places[own[0]]
            self.agent.set_planners(planners, now_ns)

    def _on_routes(
        self, replied: Replied, reply: planning.RouteReply | planning.PlaceRouteReply, now_ns: int
    ) -> None:
        self.counters.observe("route_query_ms", replied.took_s * 1e3)
        self.counters.count("routes_received", len(reply.routes))
        self._publish_followed(self.agent.routes_given(_number(replied.tag), reply, now_ns))

    def _on_costs(self, request: int, reply: planning.CostReply, now_ns: int) -> None:
        costs_s = column(reply.cost_to_go_s, "<f4")
        # A target that was never seen has costs while it is searched for.
        known = reply.target_cell is not None or bool(np.isfinite(costs_s).any())
        if known and self.agent.costs_given(request, reply.target, costs_s):
            self._on_costs_ended(request, now_ns)

    def _on_costs_ended(self, request: int, now_ns: int) -> None:
        costs = self.agent.costs_ended(request, now_ns)
        if costs is not None:
            self._bus.publish(topics.SHARED_COSTS, costs, group=costs.group, author=costs.author)

    def _perform(self, actions: list[AgentAction]) -> None:
        """Asks planners what the core wants to know."""
        for action in actions:
            match action:
                case AskRoutes(request, target, vehicles, cells, force, reroutes):
                    tag, timeout_s, goal = f"{_ROUTES}{request}", self._answer_s, goal_of(target)
                    from_here: dict[str, Any] = {
                        "cells": list(cells),
                        "vehicles": list(vehicles),
                        "max_cells": self._setup.scenario.vehicles.route_cells,
                        "vehicle_class": self._class,
                    }
                    if goal is not None:
                        place, job = planning.PlaceRouteRequest(to=goal, **from_here), self._places_job
                        self._member.ask_by_name(
                            topics.PLACE_ROUTE, place, tag=tag, timeout_s=timeout_s, places=job
                        )
                        continue
                    self.counters.count("reroute_requests", reroutes)
                    asking = planning.RouteRequest(force=force, **from_here)
                    self._member.ask_by_name(topics.ROUTE, asking, tag=tag, timeout_s=timeout_s, target=target)
                case AskCosts(request, _, cells):
                    costs = planning.CostRequest(cells=list(cells), vehicle_class=self._class)
                    self._member.ask_by_name(topics.COST, costs, tag=f"{_COSTS}{request}", timeout_s=self._answer_s)

    def _publish_followed(self, begun: Sequence[Followed]) -> None:
        for route in begun:
            vehicle = self.agent.vehicles[route.vehicle]
            if vehicle.searching:
                self.counters.count("followed_searching")  # nothing is to be proven of these
            elif 0 < route.lower_bound_s < math.inf:
                excess = max(route.cost_s / route.lower_bound_s - 1.0, 0.0)
                self.counters.observe("followed_gap_excess", excess)
                if vehicle.goal is None:
                    self.counters.observe_by(GAPS_TO, route.target, excess)
                self.counters.observe_by(GAPS_OF, route.vehicle, excess)
            else:
                self.counters.count("followed_unproven")
                if vehicle.goal is None:
                    self.counters.count_by(UNPROVEN_TO, route.target)
                self.counters.count_by(UNPROVEN_OF, route.vehicle)
            self._bus.publish(topics.FOLLOWED, route, agent=self._setup.id, vehicle=route.vehicle)


def _number(tag: str) -> int:
    """The number at the end of a tag such as route-17."""
    return int(tag.rpartition("-")[2])
