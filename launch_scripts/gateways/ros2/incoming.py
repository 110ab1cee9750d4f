"""Incoming side from ROS: robots, goals, targets, areas and services.

`Incoming` is the shell: it finds robots, gives each message to its part, and calls all parts at ticks. Each topic
is an `Input` (`ros_node`): the newest message alone is kept until a tick, so that a flood costs no more than one
message, and why it is refused is said once.
A robot of ROS is a vehicle of the swarm: its place comes in, its routes and goals go out.
`ros_places` makes checked places and areas of messages; what it refuses is a ConfigError with a sentence. Requests
that may wait (an order until it is obeyed, a route until its planner replies) are done by a `WorkQueue`, which is
bounded.
"""

from __future__ import annotations

import logging
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from launch_scripts.gateways.ros2.gateway_settings import (
    INCOMING,
    POSE_TYPES,
    ROBOT,
    GridSettings,
    IncomingSettings,
    Robots,
    TopicRow,
    ZoneSettings,
)
from launch_scripts.gateways.ros2.rmw import Endpoint, Kind
from launch_scripts.gateways.ros2.ros_messages import Level, RosMessages, ros_name
from launch_scripts.gateways.ros2.ros_node import Input, Node, WorkQueue
from launch_scripts.gateways.ros2.ros_places import FrameReader, Place, RobotTrack, closed_cells, corners_of
from launch_scripts.gateways.ros2.ros_types import LARGEST_MESSAGE_BYTES, RESPONSE
from launch_scripts.plain_text import number_of
from swarm.client import ConfigError, Route, Stream, Swarm, SwarmError, Vehicle
from swarm.clock import NS_PER_S
from swarm.config.scenario import agent_of

log = logging.getLogger(__name__)

_PATIENCE_S = 5.0
"""A planner that starts, or grows the tree of a new goal, answers within this time on the demo's terrain."""
MOST_ASKED = 64
"""Questions for routes that wait; further ones are refused. Chosen, not measured."""
ROUTE_THREADS = 16
"""A route takes milliseconds; only one whose planner is busy or missing takes as long as `_PATIENCE_S`."""
_MOST_POSTED = 64
"""Results that wait for the gateway's thread; the oldest are dropped first. Chosen, not measured."""
_TARGET_FRAMES = "targets/"
"""A goal in the frame "targets/ID" is the target itself, wherever it is."""


class Robot:
    """Made when a robot is found, closed when it has left. One thread calls `tick`, and owns all state; what
    answers on others is posted to it.

    routes    asks for routes on its threads, for all robots
    topic     where it says where it is
    is_taken  whether a vehicle of the swarm's own is called so in ROS
    """

    def __init__(
        self,
        id: str,
        robots: Robots,
        node: Node,
        swarm: Swarm,
        routes: WorkQueue,
        messages: RosMessages,
        is_taken: Callable[[str], bool] = lambda name: False,
    ) -> None:
        def own(topic: str) -> str:
            return topic.replace(ROBOT, id)

        self.id, self.topic = id, own(robots.topic)
        self._robots, self._node, self._swarm, self._routes, self._messages = robots, node, swarm, routes, messages
        self._is_taken = is_taken
        self._reader = FrameReader(messages.map, own(robots.frame), robots.offset_m, robots.turn_rad)
        self._track = RobotTrack(self._reader, robots.lease_s)
        self._vehicle: Vehicle | None = None
        self._followed: Stream[Route] | None = None
        """Routes to the target or the place that it follows."""
        self._goal: int | None = None
        """Cell of the place to which it was sent; None while it has no goal of its own."""
        self._goal_cell: int | None = None
        """Cell of the last published goal_pose."""
        self._posted: deque[Callable[[], None]] = deque(maxlen=_MOST_POSTED)
        """Work for the next tick."""
        pose = replace(INCOMING["robot"], type_name=POSE_TYPES[robots.type], hz=robots.hz)
        certificate, get_plan = INCOMING["certificate"], INCOMING["get_plan"]
        self._poses = Input(node, self.topic, pose, self._hear_pose)
        self._goals = Input(node, own(robots.goal), INCOMING["goal"], self._hear_goal)
        self._plan = node.publisher(own(robots.plan), INCOMING["robot_plan"])
        self._certificate = node.publisher(own(certificate.topic), certificate)
        self._goal_out = node.publisher(own(robots.goal), INCOMING["robot_goal"])
        self._service = node.serve(own(get_plan.topic), get_plan, self._answer_plan)

    @property
    def present(self) -> bool:
        """True if it is a vehicle of the swarm now."""
        return self._vehicle is not None

    @property
    def refused(self) -> int:
        return self._poses.refused + self._goals.refused

    def tick(self, now_ns: int) -> None:
        """Tells the swarm where it is, if that was said; ends its life if it was not for too long."""
        while self._posted:
            self._posted.popleft()()
        self._poses.tick(now_ns)
        if self._track.gone(now_ns):
            self._leave()
        self._goals.tick(now_ns)
        while self._followed is not None and (route := self._followed.next(0.0)) is not None:
            self._hear_route(route)

    def close(self) -> None:
        """Removes the robot from the swarm, and its endpoints from the ROS graph."""
        self._leave()
        for each in (self._poses, self._goals, self._plan, self._certificate, self._goal_out):
            self._node.remove(each.endpoint)
        self._node.remove(self._service)

    # --- where it is --------------------------------------------------------------------------------------------

    def _hear_pose(self, message: Any, now_ns: int) -> None:
        """Raises SwarmError."""
        place, robots = self._track.on_reading(message, now_ns), self._robots
        if self._is_taken(self.id):  # which may be seen late: the swarm's vehicles come after the connection
            self._leave()
            raise ConfigError(
                f"robot {self.id} is not taken in: the swarm has a vehicle that ROS knows by this name; is "
                "its topic that of another gateway?"
            )
        first = self._vehicle is None
        if self._vehicle is None:
            self._vehicle = self._swarm.vehicle(
                self.id, group=robots.group, radius_m=robots.radius_m, lease_s=robots.lease_s,
                vehicle_class=robots.vehicle_class,
            )  # fmt: skip
            log.info("robot %s of ROS is a vehicle: %s", self.id, self.topic)
        self._vehicle.at(place.x_m, place.y_m, heading_rad=place.heading_rad, speed_m_per_s=place.speed_m_per_s)
        at_goal = self._vehicle.cell == self._goal
        if at_goal:
            log.info("robot %s is at its goal", self.id)
            self._end_goal()
        if first or at_goal:
            self._follow(robots.target)

    def _leave(self) -> None:
        self._end_goal()
        if self._vehicle is not None:
            log.info("robot %s of ROS is no vehicle any more: no messages on %s", self.id, self.topic)
            self._vehicle.leave()
            self._vehicle = None

    # --- where it goes ------------------------------------------------------------------------------------------

    def _follow(self, target: str | None) -> None:
        """Follows a target, or a place as commands have it. Raises SwarmError."""
        if target and self._vehicle is not None:
            self._followed = self._vehicle.follow(target)

    def _end_goal(self) -> None:
        """It follows nothing any more."""
        self._goal = self._followed = None
        if self._vehicle is not None:
            self._vehicle.unfollow()

    def _hear_goal(self, message: Any, now_ns: int) -> None:
        """Raises SwarmError if it cannot have this goal: then it has none, as its plan says."""
        before, frame = self._goal, self._swarm.frame
        self._end_goal()
        try:
            if self._vehicle is None:
                raise ConfigError(f"robot {self.id} has not said where it is, so it gets no goal")
            if (target := _target_frame(message)) is not None:
                self._follow(target)
            else:
                place = self._reader.pose(message.header, message.pose)
                goal = frame.cell(place.x_m, place.y_m)
                self._follow("cell:{},{}".format(*frame.grid.row_col(goal)))
                self._goal = goal
                if goal != before:  # no robot goes on by the plan to another goal
                    self._plan.put(self._messages.path(time.time_ns(), ()))
        except SwarmError as error:
            self._put_plan(str(error))
            self._follow(self._robots.target)
            raise

    def _hear_route(self, route: Route) -> None:
        if self._vehicle is None:
            return
        self._put_plan(route)
        end = route.cells[-1] if route.ok and route.remaining_s == 0 else None
        if self._goal is None and end is not None and end != self._goal_cell:
            self._goal_cell = end
            place = self._swarm.frame.centre_m(end)
            self._goal_out.put(self._messages.pose_stamped(time.time_ns(), *place))

    def _put_plan(self, found: Route | str) -> None:
        path, certificate = plan_of(self._messages, self.id, found)
        self._plan.put(path)
        self._certificate.put(certificate)

    # --- questions ----------------------------------------------------------------------------------------------

    def _answer_plan(self, request: Any, reply: Callable[[bytes], None]) -> None:
        """On a thread of ROS: never waits, always replies."""
        swarm = self._swarm
        how: dict[str, Any] = {"vehicle_class": self._robots.vehicle_class, "timeout_s": _PATIENCE_S}

        def answer(found: Route | str) -> None:
            path, certificate = plan_of(self._messages, self.id, found)
            reply(path)
            self._posted.append(lambda: self._certificate.put(certificate))

        def find() -> None:
            """Asks for the route to a target, wherever it is, or to a place."""
            if isinstance(goal, str):
                answer(swarm.route_soon(goal, start.x_m, start.y_m, **how).result())
            else:
                answer(swarm.route((start.x_m, start.y_m), (goal.x_m, goal.y_m), **how))

        what = "start"
        try:
            start = self._start_of(request.start)
            what = "goal"
            goal = _target_frame(request.goal) or self._reader.pose(request.goal.header, request.goal.pose)
        except ConfigError as error:
            answer(f"{what}: {error}")
            return
        if not self._routes.give("a question for a route", find, answer):
            answer(f"{MOST_ASKED} questions wait already")

    def _start_of(self, start: Any) -> Place:
        """Returns the start of a plan: the stated one, or without a frame the position of the robot. Raises
        ConfigError."""
        if start.header.frame_id:
            return self._reader.pose(start.header, start.pose)
        if (place := self._track.place) is None:
            raise ConfigError(f"robot {self.id} has not said where it is: give a start with a frame")
        return place


def plan_of(messages: RosMessages, robot: str, route: Route | str) -> tuple[bytes, Any]:
    """A route, or a reason why there is none, as two messages of one stamp.

    Returns CDR of a nav_msgs/Path, without poses where there is no route. A response of GetPlan, which is nothing
    but a path, has the same bytes. The other is a diagnostic_msgs/DiagnosticStatus: what the route takes, and what
    no route is below.
    """
    stamp_ns = time.time_ns()
    points = () if isinstance(route, str) or not (route.ok or route.searching) else route.points_m
    path = messages.path(stamp_ns, points)
    name, stamp = f"plan of {robot}", f"{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S:09d}"
    if isinstance(route, str):
        return path, messages.diagnostic(name, Level.ERROR, route, {"plan_stamp_s": stamp})
    gap = route.cost_s / route.lower_bound_s if 0 < route.lower_bound_s < math.inf else 1.0
    values = {
        "plan_stamp_s": stamp,
        "target": route.target,
        "cost_s": f"{route.cost_s:.6g}",
        "lower_bound_s": f"{route.lower_bound_s:.6g}",
        "cost_over_lower_bound": f"{gap:.6g}" if route.ok else "",
        "remaining_s": f"{route.remaining_s:.6g}",
    }
    return path, messages.diagnostic(name, Level.OK if route.ok else Level.WARN, route.status, values)


def _target_frame(message: Any) -> str | None:
    frame: str = message.header.frame_id.strip("/")
    return frame.removeprefix(_TARGET_FRAMES) if frame.startswith(_TARGET_FRAMES) else None


MOST_ROBOTS = 256
"""Robots of one gateway: bounds its memory and the time of a tick. Chosen, not measured."""
_REFRESH_NS = NS_PER_S // 2
"""Interval at which ids are read of the swarm's own vehicles."""
_MOST_ASKED = 16
"""All askers get a reply at the next tick, 0.02 s later: more than a few that wait come from a peer that floods,
and each of them is a copy of the map on the network."""
_MOST_NEWS = 1 << 14
"""Endpoints that come or go between two ticks: 64 of each of `MOST_ROBOTS`, when all robots start together."""
_MOST_ORDERS = 8
"""Orders of which one is being obeyed, which takes seconds, while the rest wait; more are refused at once."""
_TRACKER = "ros2"
"""Name of the tracker that the gateway is: its next start takes its targets over at once."""


class Incoming:
    """Handles all incoming topics and services, until `close`. `tick` is called by one thread, some twenty times a
    second.

    node      of the ROS side
    swarm     a connection; it is not closed here
    settings  checked
    messages  of the ROS side's types, in the frame in which it has the terrain
    map_now   makes a nav_msgs/OccupancyGrid, on the thread of `tick`; None: the map is not served
    vehicles  ids of those that the swarm has now
    """

    def __init__(
        self,
        node: Node,
        swarm: Swarm,
        settings: IncomingSettings,
        messages: RosMessages,
        map_now: Callable[[], Any] | None = None,
        vehicles: Callable[[], Iterable[str]] = tuple,
    ) -> None:
        self._node, self._swarm, self._settings, self._messages = node, swarm, settings, messages
        self._reader = FrameReader(messages.map)
        self._routes = WorkQueue("ros2-routes", ROUTE_THREADS, MOST_ASKED)
        self._orders = WorkQueue("ros2-orders", 1, _MOST_ORDERS)
        """An order waits until it is obeyed, and the next one for it."""
        self.robots: dict[str, Robot] = {}
        """By id: those that are known, vehicles by now or not."""
        self._publishers: Counter[str] = Counter()
        """Topic of a robot -> how many publish it, as their tokens say."""
        self._news: deque[tuple[Endpoint, bool]] = deque(maxlen=_MOST_NEWS)
        self._refused_robots: set[str] = set()
        """Robots that were said not to be taken in."""
        self._map_now, self._vehicles = map_now, vehicles
        self._taken: frozenset[str] = frozenset()
        """Names in ROS of vehicles that agents of the swarm have. A vehicle published by another gateway looks like
        a robot, and would be an obstacle at the position of the vehicle itself."""
        self._taken_due_ns = 0
        self._sendable: set[str] = set()
        """Names in ROS of vehicles whose goals are taken from there."""
        self._asked: deque[Callable[[Any], None]] = deque(maxlen=_MOST_ASKED)
        """Replies to those who ask for the map."""
        self._inputs = [
            *map(self._target_input, settings.targets),
            *map(self._zone_input, settings.zones),
            *map(self._grid_input, settings.grids),
        ]
        if map_now is not None:
            row = INCOMING["map_server"]
            node.serve(row.topic, row, lambda _, reply: self._asked.append(reply))
        for name in ("pause", "hold", "resume") if settings.orders else ():
            self._serve_order(INCOMING[name])
        for robots in settings.robots:
            if robots.id is not None:
                self._add(robots.id, robots)
        if settings.robots:
            node.watch(str(node.name.domain), lambda seen, there: self._news.append((seen, there)))

    @property
    def counts(self) -> Mapping[str, int]:
        """Returns the number of robots that are vehicles now, and counts of refused messages of known robots."""
        robots = self.robots.values()
        return {"robots": sum(each.present for each in robots), "refused": sum(each.refused for each in robots)}

    def tick(self, now_ns: int) -> None:
        """Processes received messages.

        now_ns  by time.monotonic_ns
        """
        if (self.robots or self._settings.orders) and now_ns >= self._taken_due_ns:
            self._taken_due_ns = now_ns + _REFRESH_NS
            taken = {ros_name(id): id for id in self._vehicles() if agent_of(id) != id}
            self._taken = frozenset(taken)
            for name in taken.keys() - self._sendable if self._settings.orders else ():
                self._sendable.add(name)
                self._inputs.append(self._goal_input(name, taken[name]))
        for _ in range(len(self._news)):
            self._on_endpoint(*self._news.popleft())
        for robot in self.robots.values():
            robot.tick(now_ns)
        for each in self._inputs:
            each.tick(now_ns)
        if self._asked and self._map_now is not None:
            # All askers get one map. Of more than _MOST_ASKED the oldest get none: their query ends.
            made = INCOMING["map_server"].type_name + RESPONSE
            response = self._node.types.make(made, map=self._map_now())
            while self._asked:
                self._asked.popleft()(response)

    def close(self) -> None:
        """Answers what waits. All declarations and reports end with the node and the connection."""
        self._routes.close()
        self._orders.close()

    # --- robots ---------------------------------------------------------------------------------------------------

    def _on_endpoint(self, seen: Endpoint, there: bool) -> None:
        """Handles an endpoint that has appeared or disappeared."""
        if seen.kind is not Kind.PUBLISHER or seen.node.name == self._node.name.name:
            return  # a gateway like this one tells of vehicles that the swarm has already
        for robots in self._settings.robots:
            id = robots.robot_of(seen.topic)
            if id is None or robots.id is not None or seen.type_name != POSE_TYPES[robots.type]:
                continue
            ours = self._node.types.hash_of(seen.type_name)
            if ours != seen.type_hash:
                if there:
                    hash = seen.type_hash[:20]
                    self._warn(id, f"it publishes {seen.topic} as {hash}, expected {ours[:20]} (--distribution)")
                continue
            self._publishers[seen.topic] += 1 if there else -1
            known = self.robots.get(id)
            if self._publishers[seen.topic] > 0 and known is None:
                self._add(id, robots)
            elif self._publishers[seen.topic] <= 0:
                del self._publishers[seen.topic]
                if known is not None and known.topic == seen.topic:
                    self.robots.pop(id).close()
            return

    def _add(self, id: str, robots: Robots) -> None:
        if len(self.robots) >= MOST_ROBOTS:
            self._warn(id, f"there are {MOST_ROBOTS} already")
            return
        self.robots[id] = Robot(
            id, robots, self._node, self._swarm, self._routes, self._messages, lambda name: name in self._taken
        )

    def _warn(self, robot: str, why: str) -> None:
        if robot not in self._refused_robots and len(self._refused_robots) < MOST_ROBOTS:
            self._refused_robots.add(robot)
            log.warning("robot %s is not taken in: %s", robot, why)

    # --- targets and areas ----------------------------------------------------------------------------------------

    def _target_input(self, id: str) -> Input:
        """A person who clicks once in RViz puts a target somewhere: it stays there while the gateway lives."""
        target = self._swarm.target(id, tracker=_TRACKER)

        def take(message: Any, _: int) -> None:
            place = self._reader.pose(message.header, message.pose)
            target.at(place.x_m, place.y_m)

        return Input(self._node, self._settings.set_pose_of(id), INCOMING["set_pose"], take)

    def _goal_input(self, name: str, vehicle: str) -> Input:
        """The name is that of the vehicle in ROS."""
        orders, row = self._swarm.orders(), INCOMING["vehicle_goal"]

        def take(message: Any, _: int) -> None:
            place = self._reader.pose(message.header, message.pose)
            orders.send(vehicle, [f"xy:{place.x_m},{place.y_m}"])

        return Input(self._node, row.topic.format(vehicle=name), row, take, queue=self._orders)

    def _zone_input(self, zone: ZoneSettings) -> Input:
        """A polygon whose corners are those of the last is not ordered again, unless the zone ends by itself."""
        orders = self._swarm.orders()
        before: list[tuple[float, float]] | None = None

        def take(message: Any, _: int) -> None:
            nonlocal before
            corners = corners_of(self._reader, message)
            if corners == before and zone.for_s is None:
                return
            if corners:
                orders.add_zone(corners, name=zone.name, pace_s_per_m=zone.pace_s_per_m, for_s=zone.for_s)
            else:
                orders.remove_zone(zone.name)
            before = corners

        return Input(self._node, zone.topic, INCOMING["zone"], take, queue=self._orders)

    def _grid_input(self, grid: GridSettings) -> Input:
        """Cells which the next grid does not close are again as the map had them."""
        author = self._swarm.vehicle(grid.name)  # it has no place: it only marks
        closed: set[int] = set()

        def take(message: Any, _: int) -> None:
            nonlocal closed
            cells = set(closed_cells(self._messages.map, message, grid.occupied))
            if opened := closed - cells:
                author.mark(sorted(opened), clear=True)
            if new := cells if grid.for_s is not None else cells - closed:
                author.mark(sorted(new), lethal=True, for_s=grid.for_s)
            closed = cells

        how: dict[str, Any] = {"most_bytes": LARGEST_MESSAGE_BYTES, "queue": self._orders}
        return Input(self._node, grid.topic, INCOMING["grid"], take, **how)

    # --- services -------------------------------------------------------------------------------------------------

    def _serve_order(self, row: TopicRow) -> None:
        """A Trigger which answers when the order is on a keeper's disk, and says who obeys."""
        orders = self._swarm.orders()

        def answer(request: Any, reply: Callable[[Any], None]) -> None:
            def respond(done: bool, sentence: str) -> None:
                reply(self._node.types.make(row.type_name + RESPONSE, success=done, message=sentence))

            def give() -> None:
                reply = orders.resume() if row.name == "resume" else orders.pause()
                silent = f", no reply from: {', '.join(reply.silent)}" if reply.silent else ""
                respond(True, f"obeyed by {number_of(len(reply.obeyed), 'process')}{silent}")

            if not self._orders.give(row.topic, give, lambda why: respond(False, why)):
                respond(False, "too many orders wait already")

        self._node.serve(row.topic, row, answer)
