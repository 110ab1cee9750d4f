"""Shell of the incoming side: finds robots, gives each message to its part, and calls them at ticks."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from launch_scripts.gateways.ros2.gateway_settings import GridSettings, IncomingSettings, Robots, ZoneSettings
from launch_scripts.gateways.ros2.incoming.robot import MOST_ASKED, ROUTE_THREADS, Robot
from launch_scripts.gateways.ros2.incoming.ros_places import FrameReader, closed_cells, corners_of
from launch_scripts.gateways.ros2.rmw import Endpoint, Kind
from launch_scripts.gateways.ros2.ros_messages import RosMessages, ros_name
from launch_scripts.gateways.ros2.ros_node import Input, Node, WorkQueue
from launch_scripts.gateways.ros2.ros_types import LARGEST_MESSAGE_BYTES, RESPONSE
from launch_scripts.gateways.ros2.topic_table import INCOMING, POSE_TYPES, TopicRow
from launch_scripts.plain_text import number_of
from swarm.client import Swarm
from swarm.clock import NS_PER_S
from swarm.config.agent_plan import agent_of

log = logging.getLogger(__name__)

MOST_ROBOTS = 256
"""Robots of one gateway: bounds its memory and the time of a tick. Chosen, not measured."""
_LOOK_NS = NS_PER_S // 2
"""Interval of looks at the swarm's own vehicles."""
_MOST_ASKED = 16
"""All askers get a reply at the next tick, 0.02 s later: more than a few that wait come from a peer that floods,
and each of them is a copy of the map on the network."""
_MOST_NEWS = 1 << 14
"""Endpoints that come or go between two ticks: 64 of each of `MOST_ROBOTS`, when all robots start together."""
_MOST_ORDERS = 8
"""Orders of which one is being obeyed, which takes seconds, while the rest wait; more are refused at once
(docs/design/ros2-gateway.md)."""
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
            self._taken_due_ns = now_ns + _LOOK_NS
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
        """name  of the vehicle in ROS"""
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
                told = orders.resume() if row.name == "resume" else orders.pause()
                silent = f", no reply from: {', '.join(told.silent)}" if told.silent else ""
                respond(True, f"obeyed by {number_of(len(told.obeyed), 'process')}{silent}")

            if not self._orders.give(row.topic, give, lambda why: respond(False, why)):
                respond(False, "too many orders wait already")

        self._node.serve(row.topic, row, answer)
