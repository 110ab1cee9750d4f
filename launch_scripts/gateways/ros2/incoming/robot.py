"""One robot of ROS as a vehicle of the swarm: its place in, its routes and goals out."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from launch_scripts.gateways.ros2.gateway_settings import Robots
from launch_scripts.gateways.ros2.incoming.ros_places import FrameReader, Place, Track
from launch_scripts.gateways.ros2.ros_messages import Level, RosMessages
from launch_scripts.gateways.ros2.ros_node import Input, Node, WorkQueue
from launch_scripts.gateways.ros2.topic_table import INCOMING, POSE_TYPES, ROBOT
from swarm.client import ConfigError, Route, Stream, Swarm, SwarmError, Vehicle
from swarm.clock import NS_PER_S

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
        self._track = Track(self._reader, robots.lease_s)
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
        """Takes it away, with all that was declared for it."""
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
