"""The shell of an agent: messages to calls of its cores, and what they return to the bus."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.cost_map import CostMap
from shared_map.presence import Presence
from shared_map.replication.filter import MarkFilter, author_of, readable_groups
from shared_map.replication.replica import MapReplica
from shared_map.replication.sync import MapSync
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Asked, AskEnded, Bus, Disappeared, Event, Heard, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.agents import AgentPlan, plan_agents
from swarm.errors import ConfigError
from swarm.runtime.membership import Member
from swarm.runtime.role import RoleSetup
from swarm.wire.fields import column
from swarm.wire.messages.base import Nothing
from swarm.wire.messages.planning import CostReply, CostRequest, PushedRoute, RouteReply, RouteRequest
from swarm.wire.messages.targets import Sighted, TargetPose
from swarm.wire.messages.vehicles import (
    Fleet,
    Followed,
    Reservations,
    TerritoryReply,
    TerritoryRequest,
    VehicleState,
)
from swarm.wire.topics import (
    COST,
    FLEET,
    FOLLOWED,
    POSE,
    PUSHED_ROUTE,
    RESERVATIONS,
    ROUTE,
    SIGHTED,
    TERRITORY,
    TRUE_POSE,
)
from vehicle_agent.agent import Agent, AgentAction, AskRoutes, LocalMap
from vehicle_agent.assignment import AskCosts
from vehicle_agent.driving.vehicle import Follow
from vehicle_agent.fleet import FleetReport, directions_of
from vehicle_agent.placement import spawn_cells
from vehicle_agent.sensing.sensor import TruthSensor
from vehicle_agent.sensing.target_detector import TargetDetector, UntrackedTargets
from vehicle_agent.traffic.live_peers import LivePeers
from vehicle_agent.traffic.neighbourhood import Neighbourhood
from vehicle_agent.traffic.resumption import Resumption
from vehicle_agent.traffic.territory import Territory

log = logging.getLogger(__name__)

_RESUME_TIMEOUT_S = 2.0
_NEAR_CELLS = 4
"""Bucket of the presence index: about the radius in which traffic looks for other vehicles."""
_TERRITORY_TIMEOUT_S = 1.0


class AgentService:
    """Drives the vehicles of one agent, marks what they find, and publishes where they are.

    Raises ConfigError if the scenario has no such agent, or too few free cells for its vehicles.
    """

    def __init__(
        self, setup: RoleSetup, terrain: Terrain, truth: NDArray[np.float32], bus: Bus, post: Post
    ) -> None:
        scenario = setup.scenario
        plan = _plan_of(setup)
        grid = terrain.grid
        spawns = spawn_cells(scenario, grid, terrain.pace_s_per_m, truth)
        self._member = Member(setup.info(grid, terrain.digest), bus, post)
        self.counters = self._member.counters
        for name in ("reroute_requests", "routes_received", "marks", "blocked_ticks"):
            self.counters.count(name, 0)
        self._bus = bus
        self._post = post
        self._setup = setup
        self._cost_map = CostMap(terrain)
        group = plan.group.name
        self._author = author_of(group, setup.author)
        self._replica = MapReplica(
            grid,
            self._cost_map,
            author=self._author,
            group=group,
            filter=MarkFilter(grid, readable_groups(scenario, group)),
        )
        near = scenario.map.interest == "near"
        self._sync = MapSync(self._replica, bus, post, scenario.map, setup.role, near=near)
        pace, ground = self._cost_map.pace_s_per_m, self._cost_map.ground_s_per_m
        local = LocalMap(grid, pace, ground, terrain.ground_s_per_m, truth, terrain.climb)
        sensor = TruthSensor(grid, truth, scenario.vehicles.sense_range_m)
        territory = Territory(plan.id, setup.incarnation, grid, list(spawns))
        lease_ns = int(scenario.network.lease_s * NS_PER_S)
        self._presence = Presence(grid, lease_ns, _NEAR_CELLS * grid.resolution_m, self._replica.filter)
        self._untracked = UntrackedTargets(scenario.untracked, self._replica.filter)
        self._detector = TargetDetector(
            grid,
            self._author,
            group,
            scenario.vehicles.sense_range_m,
        )
        self._agent = Agent(plan, scenario, local, sensor, spawns, setup.incarnation, self._presence, territory)
        self._neighbourhood = Neighbourhood(grid, scenario, self._agent.rights, territory)
        self._peers = LivePeers(lease_ns)
        self._fleet = FleetReport(grid, self._author, group)
        since_run_ns = setup.incarnation - setup.started_ns
        self._resumption: Resumption | None = Resumption(plan.id, spawns, grid.cells, since_run_ns)
        """None once the vehicles are placed."""
        self._asked_ns: dict[str, int] = {}
        """Tag of each open route request -> when it was sent."""

    @property
    def agent(self) -> Agent:
        return self._agent

    def start(self, now_ns: int) -> None:
        self._bus.serve(RESERVATIONS, self._post)
        self._bus.serve(TERRITORY, self._post, agent=self._setup.id)
        self._bus.watch_alive(self._post, role="agent")
        self._bus.watch_alive(self._post, role="planner")
        self._member.join()
        self._sync.start(now_ns)
        self._bus.subscribe(POSE, self._post)
        if self._untracked.targets:
            self._bus.subscribe(TRUE_POSE, self._post)
            for target in sorted(self._untracked.targets):
                self._bus.subscribe(SIGHTED, self._post, target=target)
        self._bus.subscribe(PUSHED_ROUTE, self._post, agent=self._setup.id)
        if self._resumption is not None:
            self._resumption.start(now_ns)

    def handle(self, event: Event, now_ns: int) -> None:
        if self._member.handle(event) or self._sync.handle(event, now_ns):
            return
        agent = self._agent
        match event:
            case Heard(message=Reservations() as reservations):
                agent.rights.hear(reservations)
            case Heard(message=Fleet() as fleet):
                self._presence.hear(fleet, now_ns)
            case Heard(topic=topic, message=TargetPose() as pose):
                self._detector.set_truth(pose, now_ns)
                if topic is POSE and pose.target not in self._untracked.targets:
                    agent.hear_pose(pose, now_ns)
            case Heard(message=Sighted() as sighted):
                self._hear_sighted(sighted, now_ns)
            case Heard(message=PushedRoute() as pushed):
                self.counters.count("routes_pushed")
                self._publish_followed(agent.route_pushed(pushed, now_ns))
            case Replied(tag=tag, message=RouteReply() as reply):
                self._observe_query(tag, now_ns)
                self.counters.count("routes_received", len(reply.routes))
                self._publish_followed(agent.routes_given(_number(tag), reply, now_ns))
            case Replied(tag=tag, message=CostReply() as reply) if reply.target_cell is not None:
                agent.costs_given(_number(tag), reply.target, column(reply.cost_to_go_s, "<f4"))
            case Replied(message=Reservations() as reservations):
                if self._resumption is not None:
                    self._resumption.answered(reservations)
            case Replied(tag=tag, message=TerritoryReply() as answer):
                self._neighbourhood.answered(answer, _number(tag))
            case AskEnded(tag=tag, topic=topic) if topic is ROUTE:
                self._asked_ns.pop(tag, None)
                agent.routes_ended(_number(tag), now_ns)
            case AskEnded(tag=tag, topic=topic) if topic is COST:
                agent.costs_ended(_number(tag), now_ns)
            case AskEnded(topic=topic) if topic is RESERVATIONS:
                self._place_if_known(now_ns)
            case Asked(topic=topic) if topic is RESERVATIONS:
                self._answer(event)
            case Asked(topic=topic, request=TerritoryRequest() as question) if topic is TERRITORY:
                event.answer(self._neighbourhood.answer(question))
                event.end()
            case Appeared(peer):
                self._peers.appeared(peer)
                if self._resumption is not None and peer.role == "agent":
                    self._resumption.agent_appeared(now_ns)
                self._peers_changed(now_ns)
            case Disappeared(peer):
                self._peers.disappeared(peer, now_ns)
                self._peers_changed(now_ns)
            case LinkChanged(up=up, beyond=beyond):
                self._peers.link_changed(up, beyond, now_ns)
                self._neighbourhood.link_changed()
            case _:
                pass

    def tick(self, now_ns: int) -> None:
        self._member.tick(now_ns)
        self._sync.tick(now_ns)
        if self._resumption is not None:
            if self._resumption.ask_now(now_ns):
                tag = f"reservations-{now_ns}"
                self._bus.ask(RESERVATIONS, Nothing(), self._post, tag=tag, timeout_s=_RESUME_TIMEOUT_S)
            return
        agent = self._agent
        if self._cost_map.take_dirty():
            agent.map_changed(now_ns, look=True)
        if self._peers.expire(now_ns):
            self._peers_changed(now_ns)
        self._follow(now_ns)
        self._presence.expire(now_ns)
        if self._peers.trusted(now_ns):
            agent.rights.grant()
        agent.begin_drive(now_ns)
        while (findings := agent.drive(now_ns)) is not None:
            if len(findings):
                self.counters.count("marks", len(findings))
                self._sync.publish(self._replica.write(findings.cells, findings.kinds, findings.paces, now_ns))
                agent.map_changed(now_ns)
        self._tell_sighted(now_ns)
        self._perform(agent.decide(now_ns), now_ns)
        self.counters.count("blocked_ticks", agent.blocked_ticks)
        self.counters.counts["sets_foreign"] = self._replica.counts["sets_foreign"]
        for region, fleet in self._fleet.reports(agent.vehicles.values(), now_ns):
            self._presence.hear(fleet, now_ns)
            self._bus.publish(FLEET, fleet, region=region, author=self._author)
        if agent.rights.message_due(now_ns):
            self._bus.publish(RESERVATIONS, agent.rights.next_message(), agent=self._setup.id)
        self._gauge()

    def stop(self, now_ns: int) -> None:
        self._member.publish_stats(now_ns)

    # --- which agents and where -------------------------------------------------------------------------------

    def _place_if_known(self, now_ns: int) -> None:
        """The question for reservations has ended: place the vehicles if enough is known."""
        if self._resumption is None:
            return
        agents = self._peers.agents_up
        placement = self._resumption.question_ended(agents, now_ns)
        if placement is None:
            return
        self._resumption = None
        self._neighbourhood.set_alive(agents)
        self._agent.place(placement)
        self._agent.set_planners(self._peers.planners, now_ns)
        count = len(self._agent.vehicles)
        how = "go on where they last stood" if placement.resumed else "start"
        log.info("%d vehicles %s", count, how)
        if placement.resumed:
            self._member.note(now_ns, "resumed", f"agent {self._setup.id} is back: {count} vehicles {how}")

    def _follow(self, now_ns: int) -> None:
        """Subscribe to what concerns our vehicles where they are now, and ask about new territory."""
        following = self._neighbourhood.follow(self._agent.places, now_ns)
        self._sync.enter(following.map_regions)
        for region in following.presence.begin:
            self._bus.subscribe(FLEET, self._post, region=region)
        for region in following.presence.end:
            self._bus.unsubscribe(FLEET, region=region)  # what was heard there ends with its lease
        if following.question is not None:
            tag = f"territory-{following.question.seq}"
            self._bus.ask(TERRITORY, following.question, self._post, tag=tag, timeout_s=_TERRITORY_TIMEOUT_S)
        for agent in following.reservations.begin:
            self._bus.subscribe(RESERVATIONS, self._post, agent=agent)
        for agent in following.reservations.end:
            self._bus.unsubscribe(RESERVATIONS, agent=agent)

    def _answer(self, asked: Asked) -> None:
        rights = self._agent.rights
        for reservations in rights.answers() if self._resumption is None else [rights.unplaced()]:
            asked.answer(reservations, agent=reservations.agent)
        asked.end()

    def _peers_changed(self, now_ns: int) -> None:
        self._neighbourhood.set_alive(self._peers.agents)
        self._agent.set_planners(self._peers.planners, now_ns)

    # --- targets in sight -----------------------------------------------------------------------------------

    def _tell_sighted(self, now_ns: int) -> None:
        self._untracked.expire(now_ns)
        for sighted in self._detector.look(self._agent.vehicles.values(), now_ns):
            self.counters.count("targets_sighted")
            self._bus.publish(SIGHTED, sighted, target=sighted.target, author=self._author)
            self._hear_sighted(sighted, now_ns)

    def _hear_sighted(self, sighted: Sighted, now_ns: int) -> None:
        pose = self._untracked.hear(sighted, now_ns)
        if pose is not None:
            self._agent.set_pose(pose, now_ns)

    # --- doing what was decided -----------------------------------------------------------------------------

    def _perform(self, actions: list[AgentAction], now_ns: int) -> None:
        for action in actions:
            match action:
                case AskRoutes(request, target, vehicles, cells, force, reroutes):
                    self.counters.count("reroute_requests", reroutes)
                    asking = RouteRequest(
                        cells=list(cells),
                        vehicles=list(vehicles),
                        max_cells=self._setup.scenario.vehicles.route_cells,
                        force=force,
                    )
                    tag = f"route-{request}"
                    self._asked_ns[tag] = now_ns
                    self._bus.ask(ROUTE, asking, self._post, tag=tag, target=target)
                case AskCosts(request, _, cells):
                    costs = CostRequest(cells=list(cells))
                    self._bus.ask(COST, costs, self._post, tag=f"cost-{request}")

    def _publish_followed(self, begun: Sequence[Follow]) -> None:
        for route in begun:
            followed = Followed(
                vehicle=route.vehicle,
                target=route.target,
                start=route.cells[0],
                directions=directions_of(route.cells, self._cost_map.grid.cols),
                cost_s=route.cost_s,
                lower_bound_s=route.lower_bound_s,
            )
            self._bus.publish(FOLLOWED, followed, agent=self._setup.id, vehicle=route.vehicle)

    def _observe_query(self, tag: str, now_ns: int) -> None:
        asked_ns = self._asked_ns.pop(tag, None)
        if asked_ns is not None:
            self.counters.observe("route_query_ms", (now_ns - asked_ns) / 1e6)

    def _gauge(self) -> None:
        states = [vehicle.state for vehicle in self._agent.vehicles.values()]
        for state in VehicleState:
            self.counters.gauge(f"vehicles_{state.name.lower()}", float(states.count(state)))
        self.counters.gauge("stranded", float(states.count(VehicleState.STRANDED)))
        self.counters.gauge("lost", float(states.count(VehicleState.LOST)))


def _plan_of(setup: RoleSetup) -> AgentPlan:
    plans = plan_agents(setup.scenario)
    plan = next((plan for plan in plans if plan.id == setup.id), None)
    if plan is None:
        ids = ", ".join(plan.id for plan in plans[:20])
        raise ConfigError(f"scenario {setup.scenario.name} has no agent {setup.id}; it has {ids}")
    return plan


def _number(tag: str) -> int:
    """The number at the end of a tag such as route-17."""
    return int(tag.rpartition("-")[2])
