"""The bus side of the simulated targets: `TargetWorld` is the core."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from launch_scripts.simulation.world.referee import ALARMS, Broken
from launch_scripts.simulation.world.targets import Action, Captured, TargetWorld
from shared_map.terrain.store import load_homes
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Bus, Disappeared, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.peers import Roster, job_of
from swarm.runtime.election import Candidacy
from swarm.runtime.membership import Member, MemberService
from swarm.runtime.order_book import OrderClient
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.stats import CAPTURES_BY, CAPTURES_OF
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import CostReply, CostRequest, PlannerStatus, TargetPose
from swarm.wire.messages.vehicles import Fleet, Obstacle
from swarm.wire.topics import COST, FLEET, OBSTACLE, POSE, STATUS, TRUE_POSE, Topic

_MOVED_CELLS = 0.25
"""A share of a cell, which trackers of others are asked for, too (docs/vehicle/tracker.md)."""
_AGAIN_NS = NS_PER_S // 2
"""Interval at which a target at rest is published: four times within the lease of a pose, 2 s."""


class PoseThrottle:
    """Passes, of the poses of each tick, those of targets that have entered another cell, have moved by a quarter
    of one, were captured, or were published last more than half a second ago.

    Every agent receives the poses of all targets: at ten per second they were a fifth of all deliveries, though a
    target needs seconds for a cell.
    """

    def __init__(self, resolution_m: float) -> None:
        self._moved_m = _MOVED_CELLS * resolution_m
        self._published: dict[str, TargetPose] = {}

    def is_news(self, pose: TargetPose) -> bool:
        """Returns True if this pose is to be published; if so, later ones are compared with it."""
        last = self._published.get(pose.target)
        if last is not None:
            late = not 0 <= pose.stamp_ns - last.stamp_ns < _AGAIN_NS
            counts = (last.incarnation, last.cell, last.captures, last.jumps)
            changed = counts != (pose.incarnation, pose.cell, pose.captures, pose.jumps)
            if not (late or changed or math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m) >= self._moved_m):
                return False
        self._published[pose.target] = pose
        return True


TICK_HZ = 10.0
"""Ten poses a second are enough for any planner (docs/vehicle/tracker.md). Most of them are not published, as a
target takes seconds for a cell."""
_ASK_NS = NS_PER_S // 2
"""Planners are asked this often where the targets were: twice within `targets.LISTEN_NS`, so one lost question is
no lost target."""
_ASK = "where"


class TargetsService(MemberService):
    """The bus side of `TargetWorld`. Counts `captures, collisions, lethal_entries, poses`; `driven_into`, obstacles
    that vehicles drove into, and `hit_by_obstacles`, the other way round."""

    def __init__(
        self, setup: RoleSetup, terrain: Terrain, truth: NDArray[np.float32], bus: Bus, post: Post
    ) -> None:
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post, setup.before)
        self._scenario = setup.scenario
        self._bus = bus
        self._post = post
        self._ask_due_ns = 0
        self._candidacy = Candidacy(setup, setup.scenario.standbys.targets, TICK_HZ, bus, post)
        self._world = TargetWorld(
            setup.scenario,
            terrain,
            truth,
            setup.incarnation,
            homes=load_homes(setup, terrain, truth),
            leads=self._candidacy.leads,
        )
        self._order_client = OrderClient(setup, bus, post, self._obeys)
        self._obeyed_version: int | None = None
        self._anew, self._began_ns = setup.anew, setup.started_ns
        self._subscribed: set[str] = set()
        """Targets whose poses we subscribe to: those of others, and as one of several of this job all."""
        self._throttle = PoseThrottle(terrain.grid.resolution_m)
        self._planners = Roster()
        self._member.needs("the orders of this run", lambda: self._order_client.known)
        self._member.needs("places of its targets", lambda: self._world.ready)
        for name in ("captures", *ALARMS, "poses"):
            self.counters.count(name, 0)

    def start(self, now_ns: int) -> None:
        self._member.join()
        for topic in (FLEET, OBSTACLE, STATUS):
            self._bus.subscribe(topic, self._post)
        self._bus.watch_alive(self._post, role="planner")
        self._subscribe_targets()
        self._order_client.start(now_ns)
        self._candidacy.start()

    def _subscribe_targets(self) -> None:
        for id, target in self._order_client.book.targets(self._scenario).items():
            if id not in self._subscribed and (not target.is_simulated or self._scenario.standbys.targets):
                self._subscribed.add(id)
                self._bus.subscribe(self._topic(id), self._post, target=id)

    def handle(self, event: Event, now_ns: int) -> None:
        if self._member.on_member_event(event) or self._candidacy.on_election_event(event, now_ns):
            return
        if self._order_client.on_order_event(event, now_ns):
            return
        match event:
            case Heard(message=Fleet() as fleet):
                self._perform(self._world.hear_fleet(fleet, now_ns), now_ns)
            case Heard(message=Obstacle() as obstacle):
                self._world.hear_obstacle(obstacle, now_ns)
            case Heard(message=PlannerStatus() as status):
                self._world.hear_planner(status.target, status.target_cell)
            case Replied(message=CostReply() as reply):
                self._world.hear_planner(reply.target, reply.target_cell)
            case Appeared(peer):
                self._planners.appeared(peer)
            case Disappeared(peer):
                self._planners.gone(peer)
            case Heard(message=TargetPose() as pose):
                self._world.hear_pose(pose, now_ns)

    def tick(self, now_ns: int) -> None:
        leads = self._candidacy.tick(self._world.ready, now_ns)
        if leads != self._world.leads:
            self._world.lead(leads)
            self._candidacy.note_lead(self._member, now_ns)
        if leads and self._world.listening and now_ns >= self._ask_due_ns:
            self._ask_due_ns = now_ns + _ASK_NS
            self._member.ask_by_name(COST, CostRequest(), tag=_ASK)
        self._obey(now_ns)
        planned = {job_of(id) for _, id in self._planners.up()}
        self._perform(self._world.tick(now_ns, planned), now_ns)
        self._member.note_faults(self._world.faults, now_ns)
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._candidacy.stop()
        self._member.publish_stats(now_ns)

    def _obey(self, now_ns: int) -> None:
        """Applies orders. Nothing moves before it is known whether the swarm is paused."""
        orders, version = self._order_client, self._obeyed_version
        if not orders.known:
            self._world.paused = True
        elif version != orders.book.version:
            self._obeyed_version = orders.book.version
            obeyed = self._world.obey(orders.book, self._scenario, now_ns, first=version is None)
            self._perform(obeyed, now_ns)
            if version is None and self._anew:
                self._world.begin_anew()
            self._subscribe_targets()
        orders.tick(now_ns)

    def _obeys(self, order: Obey) -> bool:
        return self._obeyed_version == self._order_client.book.version

    def _topic(self, target: str) -> Topic:
        return TRUE_POSE if target in self._scenario.untracked else POSE

    def _perform(self, actions: list[Action], now_ns: int) -> None:
        for action in actions:
            match action:
                case TargetPose(target=target) if self._throttle.is_news(action):
                    self.counters.count("poses")
                    self._bus.publish(self._topic(target), action, target=target)
                case Captured(target, vehicle, cell):
                    self.counters.count("captures")
                    self.counters.count_by(CAPTURES_OF, target)
                    self.counters.count_by(CAPTURES_BY, vehicle)
                    self._member.note(now_ns, "capture", f"{vehicle} captured {target}", cell, target=target)
                case Obstacle():
                    self._bus.publish(OBSTACLE, action, id=action.id)
                case Broken(count=count, vehicles=vehicles, cell=cell):
                    self.counters.count(count)
                    kind, text = ALARMS[count], action.sentence(self._began_ns)
                    # To the log of who watches now, and to those who come late.
                    self._member.note(now_ns, kind, text, cell)
                    self._member.alarms.happened(kind, vehicles, text, now_ns, cell)
