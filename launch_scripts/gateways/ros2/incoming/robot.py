"""One robot of ROS as a vehicle of the swarm: its place in, its routes and goals out."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from launch_scripts.gateways.ros2.graph import Qos
from launch_scripts.gateways.ros2.incoming.place_routes import PlaceRoutes
from launch_scripts.gateways.ros2.incoming.places import FrameReader, Place
from launch_scripts.gateways.ros2.incoming.plan_messages import CERTIFICATE_TYPE, certificate_of, path_of
from launch_scripts.gateways.ros2.incoming.settings import POSE_TYPES, ROBOT, Robots
from launch_scripts.gateways.ros2.incoming.tracks import Track
from launch_scripts.gateways.ros2.messages import RosMessages
from launch_scripts.gateways.ros2.node import Node, Publisher
from swarm.client import BusError, ConfigError, Route, Swarm, SwarmError, Vehicle
from swarm.clock import NS_PER_S

log = logging.getLogger(__name__)

_MOST_POSE_BYTES = 1 << 14
_GOAL_NS = NS_PER_S // 10
"""A robot is given no more than one goal in so long; of several the newest counts."""
TARGET_FRAMES = "targets/"
"""A goal in the frame "targets/ID" is the target itself, wherever it is."""


class Robot:
    """Made when a robot is found, closed when it is gone.

    topic     where it says where it is
    is_taken  whether a vehicle of the swarm's own is called so in ROS
    """

    def __init__(
        self,
        id: str,
        robots: Robots,
        node: Node,
        swarm: Swarm,
        routes: PlaceRoutes,
        messages: RosMessages,
        is_taken: Callable[[str], bool] = lambda name: False,
    ) -> None:
        self.id, self.topic = id, robots.topic_of(id)
        self.counts: Counter[str] = Counter()
        self._robots, self._node, self._swarm, self._routes, self._messages = robots, node, swarm, routes, messages
        self._is_taken = is_taken
        self._reader = FrameReader.of(robots, id, messages.map)
        self._track = Track(self._reader, robots.lease_s, robots.hz, self._say)
        self._vehicle: Vehicle | None = None
        self._goal: tuple[str, int] | None = None
        """Target that is lent for its goal, and its cell; None while it has no goal of its own."""
        self._said: str | None = None
        """What was said last of messages that are refused; said once until one is not."""
        self._goal_ns = -_GOAL_NS
        self._goal_cell: int | None = None
        """Of the goal_pose that was put last."""
        self._lock = threading.RLock()
        """Held while any of the above is read or changed: threads of ROS, the swarm and the gateway come here."""
        self._poses = node.newest(self.topic, POSE_TYPES[robots.type], Qos.SENSOR, _MOST_POSE_BYTES)
        self._plan = node.publisher(self._own(robots.plan), "nav_msgs/msg/Path", Qos.LATCHED)
        self._certificate = node.publisher(f"/{id}/plan_certificate", CERTIFICATE_TYPE, Qos.LATCHED)
        goal = self._own(robots.goal)
        self._goal_out = node.publisher(goal, "geometry_msgs/msg/PoseStamped")
        self._goals = node.newest(goal, "geometry_msgs/msg/PoseStamped", most_bytes=_MOST_POSE_BYTES)
        self._goals.wake = self._take_goal
        self._service = node.serve(f"/{id}/get_plan", "nav_msgs/srv/GetPlan", self._answer_plan)

    @property
    def present(self) -> bool:
        """Whether it is a vehicle of the swarm now."""
        return self._vehicle is not None

    def tick(self, now_ns: int) -> None:
        """Tell the swarm where it is, if that was said; end its life if it was not for too long."""
        with self._lock:
            self._hear_pose(now_ns)
            if self._track.gone(now_ns):
                self._leave()
        self._take_goal()

    def close(self) -> None:
        """Take it away, with all that was declared for it."""
        with self._lock:
            self._leave()
        self._poses.close()
        self._goals.close()
        for endpoint in (self._plan, self._certificate, self._goal_out):
            self._node.remove(endpoint.endpoint)
        self._node.remove(self._service)

    # --- where it is --------------------------------------------------------------------------------------------

    def _hear_pose(self, now_ns: int) -> None:
        if self._track.due(now_ns) and (message := self._poses.take()) is not None:
            self.counts["poses"] += 1
            place = self._track.hear(message, now_ns)
            if place is not None:
                self._tell(place)

    def _tell(self, place: Place) -> None:
        robots = self._robots
        try:
            if self._is_taken(self.id):  # which may be seen late: the swarm's vehicles come after the connection
                self._leave()
                raise ConfigError(
                    f"robot {self.id} is not taken in: the swarm has a vehicle that ROS knows by this name; is "
                    "its topic that of another gateway?"
                )
            if self._vehicle is None:
                self._vehicle = self._swarm.vehicle(
                    self.id, group=robots.group, radius_m=robots.radius_m, lease_s=robots.lease_s,
                    vehicle_class=robots.vehicle_class,
                )  # fmt: skip
                self._vehicle.on_route(self._hear_route)
                log.info("robot %s of ROS is a vehicle: %s", self.id, self.topic)
            first = not self.counts["told"]
            self._vehicle.at(place.x_m, place.y_m, heading_rad=place.heading_rad, speed_m_per_s=place.speed_m_per_s)
            self.counts["told"] += 1
            self._said = None
            if first:
                self._follow_target()
            elif self._goal is not None and self._vehicle.cell == self._goal[1]:
                log.info("robot %s is at its goal", self.id)
                self._end_goal()
                self._follow_target()
        except SwarmError as error:
            self._say(str(error))

    def _leave(self) -> None:
        self._end_goal()
        self.counts["told"] = 0
        if self._vehicle is not None:
            log.info("robot %s of ROS is no vehicle any more: nothing is heard on %s", self.id, self.topic)
            self._vehicle.leave()
            self._vehicle = None

    def _say(self, sentence: str) -> None:
        self.counts["refused"] += 1
        if sentence != self._said:
            self._said = sentence
            log.warning("topic %s: %s", self.topic, sentence)

    # --- where it goes ------------------------------------------------------------------------------------------

    def _follow_target(self) -> None:
        if self._robots.target and self._vehicle is not None:
            try:
                self._vehicle.follow(self._robots.target)
            except SwarmError as error:
                self._say(str(error))

    def _end_goal(self) -> None:
        if self._goal is not None:
            self._routes.give_back(self._goal[0])
            self._goal = None
        if self._vehicle is not None:
            self._vehicle.unfollow()

    def _take_goal(self) -> None:
        """On a thread of ROS as soon as a goal comes, else at a tick."""
        with self._lock:
            now_ns = time.monotonic_ns()
            if now_ns - self._goal_ns < _GOAL_NS:
                return
            message = self._goals.take()
            if message is None:
                return
            self._goal_ns = now_ns
            self.counts["goals"] += 1
            self._hear_pose(now_ns)  # which may have come just before
            fault = self._go(message)
            if fault is not None:
                log.warning("topic %s: %s", self._goals.endpoint.topic, fault)
                self._put_plan(fault)
                self._follow_target()

    def _go(self, message: Any) -> str | None:
        """Give it a goal. Returns why it cannot have this one: then it has none, as its plan says."""
        self._end_goal()
        if self._vehicle is None or self._track.place is None:
            return f"robot {self.id} has not said where it is, so it gets no goal"
        try:
            if (target := _target_frame(message)) is not None:
                self._vehicle.follow(target)
                return None
            goal = self._reader.pose(message.header, message.pose)
            return goal if isinstance(goal, str) else self._go_to(goal, self._vehicle, self._track.place)
        except SwarmError as error:
            self._end_goal()
            return str(error)

    def _go_to(self, goal: Place, vehicle: Vehicle, start: Place) -> str | None:
        """As `_go`. Raises SwarmError."""
        lent = self._routes.lend(goal)
        if lent is None:
            return self._routes.none_free
        self._goal = lent, self._swarm.frame.cell(goal.x_m, goal.y_m)
        self._routes.to_lent(lent, start, self._robots.vehicle_class, self._hear_first)
        vehicle.follow(lent)
        return None

    def _hear_first(self, found: Route | str) -> None:
        """The first route to its goal, asked for at once; newer ones are pushed."""
        if isinstance(found, str):
            log.warning("topic %s: %s", self._goals.endpoint.topic, found)
            self._put_plan(found)
        else:
            self._hear_route(found)

    def _hear_route(self, route: Route) -> None:
        """On the thread of the swarm's connection."""
        with self._lock:
            goal = self._goal
            if self._vehicle is None or (goal is not None and (route.target, route.target_cell) != goal):
                return
            end = route.cells[-1] if route.ok and route.remaining_s == 0 else None
            moved = goal is None and end is not None and end != self._goal_cell
            if moved:
                self._goal_cell = end
        self._put_plan(route)
        if moved and end is not None:
            x_m, y_m = self._swarm.frame.centre_m(end)
            self._put(self._goal_out, self._messages.pose_stamped(time.time_ns(), x_m, y_m))

    def _put_plan(self, route: Route | str) -> None:
        stamp_ns = time.time_ns()
        path = path_of(self._messages.map, stamp_ns, route)
        certificate = certificate_of(self._messages, stamp_ns, self.id, route)
        self.counts["plans"] += 1
        self._put(self._plan, path)
        self._put(self._certificate, certificate)

    def _put(self, publisher: Publisher, message: Any) -> None:
        """From any thread, one at a time. What a lost link does not take is counted."""
        with self._lock:
            try:
                publisher.put_packed(message) if isinstance(message, bytes) else publisher.put(message)
            except BusError:
                self.counts["put_failed"] += 1

    # --- questions ----------------------------------------------------------------------------------------------

    def _answer_plan(self, request: Any, reply: Any) -> None:
        """On a thread of ROS: never waits, always replies."""

        def answer(found: Route | str) -> None:
            stamp_ns = time.time_ns()
            reply(path_of(self._messages.map, stamp_ns, found))
            self._put(self._certificate, certificate_of(self._messages, stamp_ns, self.id, found))

        self.counts["questions"] += 1
        start = self._start_of(request.start)
        if isinstance(start, str):
            answer(start)
        elif (target := _target_frame(request.goal)) is not None:
            self._routes.to_target(target, start, self._robots.vehicle_class, answer)
        else:
            goal = self._reader.pose(request.goal.header, request.goal.pose)
            if isinstance(goal, str):
                answer(f"goal: {goal}")
            else:
                self._routes.to_place(goal, start, self._robots.vehicle_class, answer)

    def _start_of(self, start: Any) -> Place | str:
        """Where a plan begins: where it says, or without a frame where the robot is."""
        if start.header.frame_id:
            found = self._reader.pose(start.header, start.pose)
            return f"start: {found}" if isinstance(found, str) else found
        with self._lock:
            self._hear_pose(time.monotonic_ns())
            return self._track.place or f"robot {self.id} has not said where it is: give a start with a frame"

    def _own(self, topic: str) -> str:
        return topic.replace(ROBOT, self.id)


def _target_frame(message: Any) -> str | None:
    frame: str = message.header.frame_id.strip("/")
    return frame.removeprefix(TARGET_FRAMES) if frame.startswith(TARGET_FRAMES) else None
