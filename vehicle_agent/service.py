"""The shell of an agent: messages to calls of its cores, and what they return to the bus."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.class_grounds import class_grounds
from shared_map.replication.filter import MarkFilter, author_of, readable_groups
from shared_map.replication.interest import Interest
from shared_map.replication.replica import MapReplica
from shared_map.replication.sync import MapSync
from shared_map.terrain.store import load_homes
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Asked, AskEnded, Bus, Disappeared, Event, Heard, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.agents import AgentPlan, plan_agents
from swarm.config.classes import GROUND, class_named, class_numbers, flies, of_class
from swarm.config.plugin_names import assignment_key
from swarm.errors import ConfigError
from swarm.liveness import Roster, job_of
from swarm.plugins.find import named_plugin
from swarm.runtime.membership import Member
from swarm.runtime.order_client import OrderClient
from swarm.runtime.role import RoleSetup
from swarm.runtime.stats import GAPS_OF, GAPS_TO, UNPROVEN_OF, UNPROVEN_TO
from swarm.wire.fields import column, pack_column
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import (
    CostReply,
    CostRequest,
    PushedRoute,
    RouteReply,
    RouteRequest,
    Sighted,
    TargetPose,
)
from swarm.wire.messages.vehicles import Body, Followed, Removed, RemoveVehicles, SharedCosts, VehicleState
from swarm.wire.routes import directions_of
from swarm.wire.topics import (
    BODY,
    CHASERS,
    COST,
    FLEET,
    FOLLOWED,
    LEAVE,
    POSE,
    PUSHED_ROUTE,
    ROUTE,
    SHARED_COSTS,
    SIGHTED,
    TRUE_POSE,
)
from vehicle_agent.agent import Agent, AgentAction, AskRoutes
from vehicle_agent.agent_maps import AgentMaps
from vehicle_agent.assignment import AskCosts, AssignmentWorld, assigner_of, shares_costs
from vehicle_agent.bodies import Bodies
from vehicle_agent.driving.driven_vehicle import Follow
from vehicle_agent.driving.dynamics import DynamicsWorld, dynamics_of, own_dynamics
from vehicle_agent.driving.positions import Places
from vehicle_agent.group_costs import GroupCosts
from vehicle_agent.known_zones import ZonesAround
from vehicle_agent.placement import entry_cells, spawn_cells
from vehicle_agent.promise_store import PromiseStore
from vehicle_agent.reports import ChasersReport, FleetReport
from vehicle_agent.right_of_way_sync import RightOfWaySync
from vehicle_agent.sensing.sensor import SensorWorld, sensor_of
from vehicle_agent.sensing.target_detector import TargetDetector, UntrackedTargets
from vehicle_agent.spawning import Entering
from vehicle_agent.target_bodies import TargetBodies

log = logging.getLogger(__name__)

_LONGEST_AGE_NS = 10 * NS_PER_S
_GAUGES = [
    *((int(state), f"vehicles_{state.name.lower()}") for state in VehicleState),
    (int(VehicleState.STRANDED), "stranded"),
    (int(VehicleState.LOST), "lost"),
]
"""State of a vehicle -> the gauge that counts vehicles in it."""
_LEAD_CELLS = 24
"""Marks are followed so far ahead of the vehicles at least."""


class AgentService:
    """Drives the vehicles of one agent, marks what they find, and publishes where they are.

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
        scenario = setup.scenario
        plan = _plan_of(setup) if setup.added is None else setup.added.plan
        grid = terrain.grid
        self._class = plan.group.vehicle_class
        grounds = class_grounds(scenario, terrain, truth, load_homes(setup, terrain, truth))
        common, own, as_class = grounds[GROUND], grounds[self._class], of_class(scenario, self._class)
        spawns = spawn_cells(scenario, grid, grounds)
        self._member = Member(setup.info(grid, terrain.digest), bus, post, setup.before)
        self.counters = self._member.counters
        for name in ("reroute_requests", "routes_received", "marks", "blocked_ticks"):
            self.counters.count(name, 0)
        self._bus = bus
        self._post = post
        self._setup = setup
        self._maps = AgentMaps(
            common,
            own,
            learning=scenario.map.learning,
            class_number=class_numbers(scenario).get(self._class, 0),
        )
        group = plan.group.name
        self._author = author_of(group, setup.author)
        self._replica = MapReplica(
            grid,
            self._maps.sink,
            author=self._author,
            group=group,
            filter=MarkFilter(grid, readable_groups(scenario, group)),
        )
        near = scenario.map.interest == "near"
        self._sync = MapSync(self._replica, bus, post, scenario.map, setup.role, near=near, at_ticks=True)
        self._faults: list[str] = []
        """What plug-ins did wrong and nobody has been told yet."""
        world = SensorWorld(grid, truth, as_class.vehicles.sense_range_m, setup.id, scenario.seed)
        sensor = sensor_of(named_plugin(scenario, "vehicles.sensor"), world, self._faults.append)
        self._target_bodies = TargetBodies(scenario, grid)
        self._untracked = UntrackedTargets(scenario.untracked, self._replica.filter)
        self._detector = TargetDetector(
            grid,
            self._author,
            group,
            as_class.vehicles.sense_range_m,
        )
        self._flies = flies(scenario, self._class)
        layer_of = {each.id: flies(scenario, each.group.vehicle_class) for each in plan_agents(scenario)}
        around = {agent: cells for agent, cells in spawns.items() if layer_of[agent] is self._flies}
        self._right_of_way = RightOfWaySync(
            setup,
            grid,
            around,
            store,
            bus,
            post,
            self._place,
            self._warn,
            plan.vehicle_ids,
            int(self._flies),
            spawns.keys() - around.keys(),
        )
        bodies = Bodies(grid, as_class.cost.vehicle_radius_m)
        targets = plan.group.targets or tuple(scenario.target_ids)
        assigned = AssignmentWorld(setup.id, group, targets, scenario.seed, plan.group.pursuers)
        named = named_plugin(scenario, assignment_key(scenario, group))
        assigner = assigner_of(named, assigned, self._faults.append)
        self._group_costs = GroupCosts(self._author, group, setup.id) if shares_costs(assigner) else None
        driven = DynamicsWorld(setup.id, grid, scenario.seed)
        dynamics = own_dynamics(class_named(scenario, self._class), driven) or dynamics_of(
            named_plugin(scenario, "vehicles.dynamics"), driven, self._faults.append
        )
        self._agent = Agent(
            plan,
            as_class,
            self._maps.local,
            sensor,
            self._right_of_way.core.holdings,
            bodies,
            assigner,
            dynamics,
            self._group_costs,
        )
        lead_cells = scenario.vehicles.reserve_cells + _LEAD_CELLS
        # Wherever a vehicle writes marks, its agent has to know what others say of the same cells.
        reach_m = max(scenario.map.interest_m, 2 * as_class.vehicles.sense_range_m)
        self._zones = ZonesAround(self._replica, self._maps)
        self._obedience = OrderClient(setup, bus, post, self._obeys)
        self._near_marks = Interest(grid, max(lead_cells, int(reach_m / grid.resolution_m)))
        self._obeyed_version = 0
        self._roster = Roster()
        self._now_ns = 0
        self.when_over: Callable[[], None] | None = None
        """Called once all vehicles of an added agent have left."""
        self._removed: set[str] = set()
        """Vehicles that an operator has let leave."""
        self._entering: Entering | None = None
        if setup.added is not None:
            cells = entry_cells(setup.added, grid, own.homes, setup.incarnation)
            self._entering = Entering(plan.vehicle_ids, cells, self._agent.holdings, self._agent.is_open)
        self._fleet = FleetReport(self._author, group, self._class)
        self._chasers = ChasersReport(self._author, self._class)
        self._member.needs("the shared map", lambda: self._sync.joined)
        self._member.needs("the orders of this run", lambda: self._obedience.known)
        self._member.needs("places for its vehicles", lambda: self._has_places)

    @property
    def agent(self) -> Agent:
        return self._agent

    @property
    def over(self) -> bool:
        """Whether all vehicles of an agent that was added have left."""
        return self._entering is not None and self._entering.over and self._agent.holdings.gone

    @property
    def _has_places(self) -> bool:
        """Whether all vehicles stand somewhere that have not left. Those that are added enter as there is space."""
        if self._entering is not None:
            return self._right_of_way.core.informed
        return len(self._agent.vehicles.keys() | self._removed) == len(self._agent.plan.vehicle_ids)

    def lacks(self) -> list[str]:
        return self._member.lacks()

    def start(self, now_ns: int) -> None:
        self._bus.watch_alive(self._post, role="planner")
        self._right_of_way.start(now_ns)  # whoever sees our token asks at once what we know
        self._member.join()
        self._sync.start(now_ns)
        self._obedience.start(now_ns)
        self._bus.collect(POSE)
        if not self._flies:  # bodies are on the ground
            self._bus.collect(BODY)
        self._agent.bodies.listen_anew(now_ns)
        if self._untracked.targets:
            self._bus.collect(TRUE_POSE)
            for target in sorted(self._untracked.targets):
                self._bus.subscribe(SIGHTED, self._post, target=target)
        self._bus.collect(PUSHED_ROUTE, agent=self._setup.id)
        if self._group_costs is not None:
            self._bus.collect(SHARED_COSTS, group=self._agent.plan.group.name)
        self._bus.serve(LEAVE, self._post, agent=self._setup.id)

    def handle(self, event: Event, now_ns: int) -> None:
        if isinstance(event, LinkChanged) and event.up:
            self._agent.bodies.listen_anew(now_ns)
        if self._member.handle(event) or self._sync.handle(event, now_ns):
            return
        if self._right_of_way.handle(event, now_ns) or self._obedience.handle(event, now_ns):
            return
        agent = self._agent
        match event:
            case Asked(topic=topic, request=RemoveVehicles() as request) if topic is LEAVE:
                event.answer(self._remove(request.vehicles), agent=self._setup.id)
                event.end()
            case Heard(message=Sighted() as sighted):
                self._hear_sighted(sighted, now_ns)
            case Replied(tag=tag, message=RouteReply() as reply, took_s=took_s):
                self.counters.observe("route_query_ms", took_s * 1e3)
                self.counters.count("routes_received", len(reply.routes))
                self._publish_followed(agent.routes_given(_number(tag), reply, now_ns))
            case Replied(tag=tag, message=CostReply() as reply):
                costs_s = column(reply.cost_to_go_s, "<f4")
                if reply.target_cell is not None or np.isfinite(costs_s).any():  # never seen, and searched for
                    agent.costs_given(_number(tag), reply.target, costs_s)
            case AskEnded(tag=tag, topic=topic) if topic is ROUTE:
                agent.routes_ended(_number(tag), now_ns)
            case AskEnded(tag=tag, topic=topic) if topic is COST:
                told = agent.costs_ended(_number(tag), now_ns)
                if told is not None:
                    self._bus.publish(SHARED_COSTS, told, group=told.group, author=told.author)
            case Appeared(peer):
                self._roster.appeared(peer)
                if peer.role == "planner":
                    self._detector.retell(job_of(peer.id), now_ns)
                agent.set_planners(self._planners(), now_ns)
            case Disappeared(peer):
                self._roster.gone(peer)
                agent.set_planners(self._planners(), now_ns)
            case _:
                pass

    def tick(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._agent.bodies.tick(now_ns)
        for heard in (*self._bus.collected(POSE), *self._bus.collected(TRUE_POSE)):
            self._hear_pose(heard, now_ns)
        self._member.tick(now_ns)
        self._sync.tick(now_ns)
        agent = self._agent
        self._hear_pushed(now_ns)
        if self._group_costs is not None:
            for heard in self._bus.collected(SHARED_COSTS):
                assert isinstance(heard.message, SharedCosts)
                agent.hear_costs(heard.message, now_ns)
        self._right_of_way.hear_granted(now_ns)
        if self._entering is not None:
            self._entering.tick(self._right_of_way.core.informed, now_ns)
        if agent.holdings.replaced and agent.vehicles:
            self._stand_down(now_ns)
        places = agent.places
        self._zones.update(places, now_ns, agent.bodies.standing | agent.seen_lethal)
        agent.set_ways_out(self._zones.ways_out)
        self._obey(now_ns)
        agent.map_changed(self._maps.take_dirty(), now_ns, look=True)
        if places:
            self._sync.enter(self._near_marks.update(places))
        self._hear_bodies(now_ns)
        agent.begin_drive(now_ns)
        while (found := agent.drive()) is not None:
            if len(findings := self._zones.without(found)):
                self.counters.count("marks", len(findings))
                self._sync.publish(self._replica.write(findings.cells, findings.kinds, findings.paces, now_ns))
                agent.map_changed(self._maps.take_dirty(), now_ns)
        learning = self._maps.learning
        if learning is not None and (said := learning.tick(agent.take_driven(), now_ns)):
            self._sync.publish(self._replica.write_learned(said, now_ns))
        columns = Places(self._replica.grid, agent.vehicles.values())
        self._tell_sighted(columns, now_ns)
        self._perform(agent.decide(now_ns))
        self.counters.count("blocked_ticks", agent.blocked_ticks)
        self.counters.counts["sets_foreign"] = self._replica.counts["sets_foreign"]
        for region, fleet in self._fleet.reports(columns, now_ns):
            self._bus.publish(FLEET, fleet, region=region, author=self._author)
        paths = agent.holdings.paths
        chasing = [(id, vehicle.target, paths[id]) for id, vehicle in agent.vehicles.items()]
        for chasers in self._chasers.reports(chasing, now_ns):
            self._bus.publish(CHASERS, chasers, target=chasers.target, author=self._author)
        self._right_of_way.tick(agent.wishes, now_ns)
        self._member.tell_faults(self._faults, now_ns)
        self._gauge()
        if self.over and self.when_over is not None:
            self.when_over()

    def stop(self, now_ns: int) -> None:
        if self._entering is not None:
            self._remove([])  # whoever ends this process takes its vehicles away; one that is killed leaves them
            self._right_of_way.tick(self._agent.wishes, now_ns)
        self._member.publish_stats(now_ns)

    def _obey(self, now_ns: int) -> None:
        """Go by what is ordered."""
        orders, agent = self._obedience, self._agent
        agent.stopped = orders.book.stopped if orders.known else lambda vehicle: True
        if self._obeyed_version != orders.book.version:
            self._obeyed_version = orders.book.version
            scenario, book = self._setup.scenario, orders.book
            agent.set_targets(book.targets_of(agent.plan.group.name, scenario), now_ns)
            agent.set_pace(
                book.setting("time_scale", scenario.time_scale),
                book.setting("vehicles.reassign_s", scenario.vehicles.reassign_s),
            )
        orders.tick(now_ns)

    def _obeys(self, order: Obey) -> bool:
        if order.subject is not None:
            return self._obeyed_version == self._obedience.book.version
        return self._sync.holds(order.author, order.sets, self._now_ns)

    # --- places ---------------------------------------------------------------------------------------------

    def _place(self, vehicles: Sequence[str]) -> None:
        if self._entering is not None:
            holdings, may_stand = self._agent.holdings, self._entering.may_stand
            closed = [id for id in vehicles if not may_stand(id, holdings.path(id)[0])]
            self._agent.remove(closed)
            vehicles = [id for id in vehicles if id not in closed]
        if vehicles:
            self._agent.place(vehicles)
            log.info("%d vehicles have their places", len(self._agent.vehicles))

    def _remove(self, asked: Sequence[str]) -> Removed:
        """Let vehicles leave, all if none is named; of those that have left already say how far it is."""
        ours = self._agent.plan.vehicle_ids
        left = [id for id in ours if id in asked or not asked]
        self._agent.remove([id for id in left if id not in self._removed])
        self._removed.update(left)
        if self._entering is not None:
            self._entering.remove(left)
        held = sum(self._agent.holdings.is_granted(id) for id in left)
        unknown = sorted(set(asked).difference(ours))
        return Removed(agent=self._setup.id, left=left, unknown=unknown, held=held)

    def _warn(self, kind: str, text: str) -> None:
        self._member.warn(self._now_ns, kind, text)

    def _stand_down(self, now_ns: int) -> None:
        """A later life of this agent drives the vehicles. While it lives, this one keeps its promises only."""
        self._agent.stand_down()
        text = f"agent {self._setup.id} runs elsewhere, too, and that one is younger: this one drives no more"
        log.warning(text)
        self._member.note(now_ns, "replaced", text)

    # --- targets in sight -----------------------------------------------------------------------------------

    def _tell_sighted(self, places: Places, now_ns: int) -> None:
        self._untracked.expire(now_ns)
        self._detector.lose(self._agent.lost(now_ns) - self._untracked.targets)
        for sighted in self._detector.look(places, now_ns):
            self.counters.count("targets_sighted")
            self._bus.publish(SIGHTED, sighted, target=sighted.target, author=self._author)
            self._hear_sighted(sighted, now_ns)
        for sighted in self._detector.retold(now_ns):
            self._bus.publish(SIGHTED, sighted, target=sighted.target, author=self._author)

    def _hear_pose(self, heard: Heard, now_ns: int) -> None:
        pose = heard.message
        assert isinstance(pose, TargetPose)
        if heard.topic is TRUE_POSE:
            self._detector.set_truth(pose, now_ns)
        elif pose.target not in self._untracked.targets:
            counts = self._agent.hear_pose(pose, now_ns)
            if counts is not None:  # for the simulated sensor of targets it is the truth
                self._detector.set_truth(counts, now_ns)
                self._hear_target_bodies(counts, now_ns)

    def _hear_pushed(self, now_ns: int) -> None:
        for heard in self._bus.collected(PUSHED_ROUTE):
            assert isinstance(heard.message, PushedRoute)
            self.counters.count("routes_pushed")
            self._publish_followed(self._agent.route_pushed(heard.message, now_ns))

    def _hear_bodies(self, now_ns: int) -> None:
        bodies = self._agent.bodies
        for heard in self._bus.collected(BODY):
            assert isinstance(heard.message, Body)
            bodies.hear(heard.message, now_ns)
            age_ns = now_ns - heard.message.stamp_ns
            if 0 <= age_ns < _LONGEST_AGE_NS:  # by clocks that agree
                self.counters.observe("body_ms", age_ns / 1e6)
        self._agent.bodies_moved()
        self.counters.counts["bodies_refused"] = bodies.refused
        self.counters.counts["detours"] = self._agent.detours.found
        for text in bodies.complaints:
            self._warn("body", text)
        bodies.complaints.clear()

    def _hear_sighted(self, sighted: Sighted, now_ns: int) -> None:
        self._detector.hear(sighted)
        pose = self._untracked.hear(sighted, now_ns)
        if pose is not None:
            self._agent.see_target(pose, now_ns)
            self._hear_target_bodies(pose, now_ns)

    def _hear_target_bodies(self, pose: TargetPose, now_ns: int) -> None:
        for body in () if self._flies else self._target_bodies.bodies_of(pose, now_ns):
            self._agent.bodies.hear(body, now_ns)

    def _planners(self) -> dict[str, int]:
        """Target -> incarnation of its living planner, or of the first of its standbys that lives."""
        alive = self._roster.alive("planner")
        return {job_of(id): alive[id] for id in sorted(alive, reverse=True)}

    # --- doing what was decided -----------------------------------------------------------------------------

    def _perform(self, actions: list[AgentAction]) -> None:
        for action in actions:
            match action:
                case AskRoutes(request, target, vehicles, cells, force, reroutes):
                    self.counters.count("reroute_requests", reroutes)
                    asking = RouteRequest(
                        cells=list(cells),
                        vehicles=list(vehicles),
                        max_cells=self._setup.scenario.vehicles.route_cells,
                        force=force,
                        vehicle_class=self._class,
                    )
                    self._bus.ask(ROUTE, asking, self._post, tag=f"route-{request}", target=target)
                case AskCosts(request, _, cells):
                    costs = CostRequest(cells=list(cells), vehicle_class=self._class)
                    self._bus.ask(COST, costs, self._post, tag=f"cost-{request}")

    def _publish_followed(self, begun: Sequence[Follow]) -> None:
        for route in begun:
            if route.searching:
                self.counters.count("followed_searching")  # nothing is to be proven of these
            elif 0 < route.lower_bound_s < math.inf:
                excess = max(route.cost_s / route.lower_bound_s - 1.0, 0.0)
                self.counters.observe("followed_gap_excess", excess)
                self.counters.observe_by(GAPS_TO, route.target, excess)
                self.counters.observe_by(GAPS_OF, route.vehicle, excess)
            else:
                self.counters.count("followed_unproven")
                self.counters.count_by(UNPROVEN_TO, route.target)
                self.counters.count_by(UNPROVEN_OF, route.vehicle)
            followed = Followed(
                vehicle=route.vehicle,
                target=route.target,
                start=route.cells[0],
                directions=directions_of(route.cells, self._replica.grid.cols),
                cost_s=route.cost_s,
                lower_bound_s=route.lower_bound_s,
                legs=pack_column(route.legs, "<u4"),
            )
            self._bus.publish(FOLLOWED, followed, agent=self._setup.id, vehicle=route.vehicle)

    def _gauge(self) -> None:
        states = bytes([vehicle.state for vehicle in self._agent.vehicles.values()])
        for state, name in _GAUGES:
            self.counters.gauge(name, float(states.count(state)))


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
