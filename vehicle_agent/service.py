"""The agent's shell: its vehicles on the bus."""

from __future__ import annotations

import logging

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.cost_map import CostMap
from shared_map.presence import Presence
from shared_map.replication.filter import MarkFilter, author_of, readable_groups
from shared_map.replication.interest import Interest
from shared_map.replication.replica import MapReplica
from shared_map.replication.sync import MapSync
from shared_map.sightings import Sightings, pose_of
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Asked, AskEnded, Bus, Disappeared, Event, Heard, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import plan_agents
from swarm.errors import ConfigError
from swarm.liveness import Roster
from swarm.runtime.membership import Member
from swarm.runtime.role import RoleSetup
from swarm.wire.fields import column
from swarm.wire.messages.base import Nothing
from swarm.wire.messages.planning import CostReply, CostRequest, PushedRoute, RouteReply, RouteRequest
from swarm.wire.messages.targets import Sighted, TargetPose
from swarm.wire.messages.vehicles import Claims, Fleet, Followed, Grounds, VehicleState
from swarm.wire.topics import CLAIMS, COST, FLEET, FOLLOWED, GROUNDS, POSE, PUSHED_ROUTE, ROUTE, SIGHTED, TRUE_POSE
from vehicle_agent.agent import Agent, AgentAction, AskCosts, AskRoutes, LocalMap
from vehicle_agent.driving.vehicle import Follow, VehicleAction
from vehicle_agent.fleet import FleetReport, directions_of
from vehicle_agent.placement import spawn_cells
from vehicle_agent.sensing.sensor import TruthSensor
from vehicle_agent.sensing.target_detector import Lookout
from vehicle_agent.traffic.resumption import Resumption
from vehicle_agent.traffic.territory import PLOT_CELLS, SharedGround

log = logging.getLogger(__name__)

_SETTLE_NS = NS_PER_S // 5
"""So long a starting agent lets the others learn of it before it asks where everybody stands: from then on they
wait for its word before they enter anything."""
_RESUME_TIMEOUT_S = 2.0
_ASK_AGAIN_NS = NS_PER_S // 10
_ASK_AGAIN_AT_LAST_NS = NS_PER_S
_MOURN_NS = NS_PER_S // 2
"""An agent whose token fell is waited for a little longer: if our own link is cut, word of that may come later."""
_NEAR_CELLS = 4
_GROUND_LEAD_CELLS = 24
"""A plot is asked for so far ahead of its first claim: the answers are there before a vehicle is."""
_GROUNDS_TIMEOUT_S = 1.0
_CLAIMS_IDLE_NS = NS_PER_S // 2
_FIRST_START_NS = 5 * NS_PER_S
_ALONE_NS = 30 * NS_PER_S
"""An agent that starts later in a run than the first and sees no other waits so long before it takes itself to be
alone: more likely it is cut off, and its vehicles do not stand where they began."""


class AgentService:
    """Drives the vehicles of one agent plan, marks what they find, and tells where they are."""

    def __init__(
        self, setup: RoleSetup, terrain: Terrain, truth: NDArray[np.float32], bus: Bus, post: Post
    ) -> None:
        scenario = setup.scenario
        plan = next((plan for plan in plan_agents(scenario) if plan.id == setup.id), None)
        if plan is None:
            ids = ", ".join(plan.id for plan in plan_agents(scenario)[:20])
            raise ConfigError(f"scenario {scenario.name} has no agent {setup.id}; it has {ids}")
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
            publish_hz=scenario.map.publish_hz,
            filter=MarkFilter(grid, readable_groups(scenario, group)),
        )
        near = scenario.map.interest == "near"
        self._sync = MapSync(self._replica, bus, post, scenario.map, setup.role, near=near)
        pace, ground = self._cost_map.pace_s_per_m, self._cost_map.ground_s_per_m
        local = LocalMap(grid, pace, ground, terrain.ground_s_per_m, truth, terrain.climb)
        sensor = TruthSensor(grid, truth, scenario.vehicles.sense_range_m)
        agents = [each.id for each in plan_agents(scenario)]
        self._ground = SharedGround(plan.id, setup.incarnation, grid, agents)
        lead_cells = scenario.vehicles.claim_cells + _GROUND_LEAD_CELLS
        self._plots = Interest(grid, lead_cells, square_cells=PLOT_CELLS)
        self._regions = Interest(grid, lead_cells)
        # What is written must be in sight of what others say about the place.
        reach_m = max(scenario.map.interest_m, 2 * scenario.vehicles.sense_range_m)
        self._map_near = Interest(grid, max(lead_cells, int(reach_m / grid.resolution_m)))
        self._listens_to: frozenset[str] = frozenset()
        lease_ns = int(scenario.network.lease_s * NS_PER_S)
        self._presence = Presence(grid, lease_ns, _NEAR_CELLS * grid.resolution_m, self._replica.filter)
        self._looks_at: frozenset[int] = frozenset()
        self._untracked = scenario.untracked
        self._sightings = Sightings(self._replica.filter)
        self._lookout = Lookout(
            grid,
            self._author,
            group,
            scenario.vehicles.sense_range_m,
            scenario.vehicles.sighting_lasts_s,
        )
        self._agent = Agent(plan, scenario, local, sensor, spawns, setup.incarnation, self._presence, self._ground)
        self._fleet = FleetReport(grid, self._author, group)
        self._resumption: Resumption | None = Resumption(plan.id)
        self._resume_due_ns: int | None = None
        self._resume_tries = 0
        self._roster = Roster()
        self._mourned_ns: dict[str, int] = {}
        self._link_up = True
        self._trust_roster_ns = 0
        self._lease_ns = lease_ns
        self._claims_due_ns = 0
        self._asked_ns: dict[str, int] = {}
        restarted = setup.incarnation - setup.started_ns > _FIRST_START_NS
        self._expects_others = restarted and len(plan_agents(scenario)) > 1
        self._alone_ns = 0

    @property
    def agent(self) -> Agent:
        return self._agent

    def start(self, now_ns: int) -> None:
        self._bus.serve(CLAIMS, self._post)
        self._bus.serve(GROUNDS, self._post, agent=self._setup.id)
        self._bus.watch_alive(self._post, role="agent")
        self._bus.watch_alive(self._post, role="planner")
        self._member.join()
        self._sync.start(now_ns)
        self._bus.subscribe(POSE, self._post)
        if self._untracked:
            self._bus.subscribe(TRUE_POSE, self._post)
            for target in sorted(self._untracked):
                self._bus.subscribe(SIGHTED, self._post, target=target)
        self._bus.subscribe(PUSHED_ROUTE, self._post, agent=self._setup.id)
        self._resume_due_ns = now_ns + _SETTLE_NS
        self._alone_ns = now_ns + _ALONE_NS

    def handle(self, event: Event, now_ns: int) -> None:
        if self._member.handle(event) or self._sync.handle(event, now_ns):
            return
        agent = self._agent
        match event:
            case Heard(message=Claims() as claims):
                agent.hear_claims(claims)
            case Heard(message=Fleet() as fleet):
                self._presence.hear(fleet, now_ns)
            case Heard(topic=topic, message=TargetPose() as pose):
                self._lookout.truth(pose)
                if topic is POSE and pose.target not in self._untracked:
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
            case Replied(message=Claims() as claims):
                if self._resumption is not None:
                    self._resumption.answered(claims)
            case Replied(tag=tag, message=Grounds() as grounds):
                for claims in grounds.words:
                    agent.hear_claims(claims)
                self._ground.answered(grounds, _number(tag))
            case AskEnded(tag=tag, topic=topic) if topic is ROUTE:
                self._asked_ns.pop(tag, None)
                agent.routes_ended(_number(tag), now_ns)
            case AskEnded(tag=tag, topic=topic) if topic is COST:
                agent.costs_ended(_number(tag), now_ns)
            case AskEnded(topic=topic) if topic is CLAIMS:
                self._place_if_known(now_ns)
            case Asked(topic=topic) if topic is CLAIMS:
                self._answer(event)
            case Asked(topic=topic, request=Grounds() as grounds) if topic is GROUNDS:
                self._ground.told(grounds)
                words = agent.rights.words_of(grounds.silent)
                event.answer(msgspec.structs.replace(self._ground.answer(), words=words))
                event.end()
            case Appeared(peer):
                self._roster.appeared(peer)
                if self._resume_due_ns is not None and self._resume_tries and peer.role == "agent":
                    self._resume_tries = 0
                    self._resume_due_ns = min(self._resume_due_ns, now_ns + _ASK_AGAIN_NS)
                self._mourned_ns.pop(peer.id if peer.role == "agent" else "", None)
                self._roster_changed(now_ns)
            case Disappeared(peer):
                self._roster.gone(peer)
                if peer.role == "agent" and not self._roster.is_alive("agent", peer.id):
                    self._mourned_ns[peer.id] = now_ns + _MOURN_NS
                self._roster_changed(now_ns)
            case LinkChanged(up=up, beyond=beyond):
                # Cut off, we hear no wants: nobody enters anything new before the others are heard of again. That a
                # router appeared may be read after our own link has gone, and does not bring it back.
                self._link_up = self._link_up if beyond else up
                self._trust_roster_ns = now_ns + self._lease_ns
                self._ground.ask_anew()
            case _:
                pass

    def tick(self, now_ns: int) -> None:
        self._member.tick(now_ns)
        self._sync.tick(now_ns)
        if self._resumption is not None:
            if self._resume_due_ns is not None and now_ns >= self._resume_due_ns:
                self._resume_due_ns = None
                tag = f"claims-{now_ns}"
                self._bus.ask(CLAIMS, Nothing(), self._post, tag=tag, timeout_s=_RESUME_TIMEOUT_S)
            return
        agent = self._agent
        self._note_map(now_ns)
        if any(due_ns <= now_ns for due_ns in self._mourned_ns.values()):
            self._mourned_ns = {id: due_ns for id, due_ns in self._mourned_ns.items() if due_ns > now_ns}
            self._roster_changed(now_ns)
        self._come_to_terms(now_ns)
        self._presence.expire(now_ns)
        may_enter = self._link_up and now_ns >= self._trust_roster_ns
        if may_enter:
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
        if agent.rights.restless or now_ns >= self._claims_due_ns:
            self._claims_due_ns = now_ns + _CLAIMS_IDLE_NS
            self._bus.publish(CLAIMS, agent.rights.speak(), agent=self._setup.id)
        self._gauge()

    def stop(self, now_ns: int) -> None:
        self._member.publish_stats(now_ns)

    # --- where everybody starts -----------------------------------------------------------------------------

    def _place_if_known(self, now_ns: int) -> None:
        """All have been asked where they stand: place the vehicles, or ask again if somebody has not answered."""
        known = self._resumption
        if known is None:
            return
        agents = self._roster.alive("agent")
        cut_off = not agents and self._expects_others and now_ns < self._alone_ns
        if cut_off or not known.complete(agents):
            # Where many agents start at once on a slow machine, each asks all the others again and again.
            self._resume_due_ns = now_ns + min(_ASK_AGAIN_NS << self._resume_tries, _ASK_AGAIN_AT_LAST_NS)
            self._resume_tries += 1
            return
        self._resumption = None
        self._ground.set_alive(agents)
        self._agent.rights.set_alive(agents)
        self._agent.placed_by(known)
        self._agent.set_planners(self._roster.alive("planner"), now_ns)
        count = len(self._agent.vehicles)
        if known.last_words is None:
            log.info("%d vehicles start", count)
        else:
            log.info("%d vehicles go on where they last stood", count)
            text = f"agent {self._setup.id} is back: {count} vehicles go on where they last stood"
            self._member.note(now_ns, "resumed", text)

    def _come_to_terms(self, now_ns: int) -> None:
        """Tell everybody in which plots we claim cells, and listen to whom that concerns."""
        ground = self._ground
        places = self._agent.places
        ground.wish(self._plots.update(places))
        self._sync.enter(self._map_near.update(places))
        regions = self._regions.update(places)
        for region in sorted(regions - self._looks_at):
            self._bus.subscribe(FLEET, self._post, region=region)
        for region in sorted(self._looks_at - regions):
            self._bus.unsubscribe(FLEET, region=region)  # what was heard there ends with its lease
        self._looks_at = regions
        question = ground.question(now_ns)
        if question is not None:
            self._bus.ask(
                GROUNDS, question, self._post, tag=f"grounds-{question.seq}", timeout_s=_GROUNDS_TIMEOUT_S
            )
        self._agent.rights.forget_the_far()
        if ground.heard_from == self._listens_to:
            return
        for agent in sorted(ground.heard_from - self._listens_to):
            self._bus.subscribe(CLAIMS, self._post, agent=agent)
        for agent in sorted(self._listens_to - ground.heard_from):
            self._bus.unsubscribe(CLAIMS, agent=agent)
        self._listens_to = ground.heard_from

    def _answer(self, asked: Asked) -> None:
        if self._resumption is not None:
            # Present, but nothing is placed yet: sequence 0 takes nobody's claims back.
            present = Claims(
                agent=self._setup.id,
                incarnation=self._setup.incarnation,
                seq=0,
                clock=0,
                holds={},
                wants=[],
                seen={},
            )
            answers = [present]
        else:
            answers = self._agent.rights.answers()
        for claims in answers:
            asked.answer(claims, agent=claims.agent)
        asked.end()

    def _roster_changed(self, now_ns: int) -> None:
        agents = self._roster.alive("agent")
        for id in self._mourned_ns:
            agents.setdefault(id, 0)
        self._ground.set_alive(agents)
        self._agent.rights.set_alive(agents)
        self._agent.set_planners(self._roster.alive("planner"), now_ns)

    # --- targets in sight -----------------------------------------------------------------------------------

    def _tell_sighted(self, now_ns: int) -> None:
        self._sightings.expire(now_ns)
        for sighted in self._lookout.look(self._agent.vehicles.values(), now_ns):
            self.counters.count("targets_sighted")
            self._bus.publish(SIGHTED, sighted, target=sighted.target, author=self._author)
            self._hear_sighted(sighted, now_ns)

    def _hear_sighted(self, sighted: Sighted, now_ns: int) -> None:
        if sighted.target not in self._untracked or not self._sightings.hear(sighted):
            return
        best = self._sightings.best(now_ns).get(sighted.target)  # None where what came late has ended already
        if best is not None:
            self._agent.hear_pose(pose_of(best), now_ns)

    # --- doing what was decided -----------------------------------------------------------------------------

    def _note_map(self, now_ns: int) -> None:
        if self._cost_map.take_dirty():
            self._agent.map_changed(now_ns, look=True)

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
                case Follow():
                    self._publish_followed([action])

    def _publish_followed(self, actions: list[VehicleAction]) -> None:
        for action in actions:
            if isinstance(action, Follow):
                followed = Followed(
                    vehicle=action.vehicle,
                    target=action.target,
                    start=action.cells[0],
                    directions=directions_of(action.cells, self._cost_map.grid.cols),
                    cost_s=action.cost_s,
                    lower_bound_s=action.lower_bound_s,
                )
                self._bus.publish(FOLLOWED, followed, agent=self._setup.id, vehicle=action.vehicle)

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


def _number(tag: str) -> int:
    return int(tag.rpartition("-")[2])
