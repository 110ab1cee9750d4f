"""The shell of what comes in: finds robots, gives each message to its part, and calls them at ticks."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.graph import Endpoint, Kind, SeenEndpoint
from launch_scripts.gateways.ros2.incoming.drawn_areas import DrawnMarks, DrawnZone
from launch_scripts.gateways.ros2.incoming.moved_targets import MovedTarget
from launch_scripts.gateways.ros2.incoming.order_desk import OrderDesk
from launch_scripts.gateways.ros2.incoming.place_routes import PlaceRoutes
from launch_scripts.gateways.ros2.incoming.places import FrameReader
from launch_scripts.gateways.ros2.incoming.robot import Robot
from launch_scripts.gateways.ros2.incoming.settings import POSE_TYPES, IncomingSettings, Robots
from launch_scripts.gateways.ros2.messages import RosMessages
from launch_scripts.gateways.ros2.names import ros_name
from launch_scripts.gateways.ros2.node import Node
from swarm.client import Swarm
from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of
from swarm.runtime.operator import Acknowledged

log = logging.getLogger(__name__)

TICK_S = 0.02
"""How often `tick` is best called."""
MOST_ROBOTS = 256
_LOOK_NS = NS_PER_S // 2
"""The swarm's own vehicles are looked at so often."""
_MOST_ASKED = 16
_MAP = "nav_msgs/srv/GetMap"
_MOST_NEWS = 1 << 14
_TRIGGER = "std_srvs/srv/Trigger"
Paused = Callable[[], Acknowledged]


class Part(Protocol):
    """A robot, target or area: it takes what has come for it at ticks."""

    def tick(self, now_ns: int) -> None: ...
    def close(self) -> None: ...


class Incoming:
    """All that comes in, until `close`. `tick` is called by one thread, some twenty times a second.

    node      of the ROS side
    swarm     a connection; it is not closed here
    settings  checked
    map       the frame in which ROS has the terrain
    map_now   makes a nav_msgs/OccupancyGrid, on the thread of `tick`; None: nobody can ask for the map
    vehicles  ids of those that the swarm has now
    """

    def __init__(
        self,
        node: Node,
        swarm: Swarm,
        settings: IncomingSettings,
        map: RosMap | None = None,
        map_now: Callable[[], Any] | None = None,
        vehicles: Callable[[], Iterable[str]] = tuple,
    ) -> None:
        self._node, self._swarm, self._settings = node, swarm, settings
        self._map = map or RosMap(swarm.frame.grid)
        self._messages = RosMessages(node.types, self._map)
        self._routes = PlaceRoutes(swarm, settings.goal_targets)
        self._desk = OrderDesk()
        self._robots: dict[str, Robot] = {}
        self._publishers: Counter[str] = Counter()
        """Topic of a robot -> how many publish it, as their tokens say."""
        self._news: deque[tuple[SeenEndpoint, bool]] = deque(maxlen=_MOST_NEWS)
        self._full_said = False
        self._strange: set[str] = set()
        """Robots whose type is of another distribution; said once each."""
        reader = FrameReader(self._map)
        self._targets = [MovedTarget(id, settings.set_pose, node, swarm, reader) for id in settings.targets]
        self._areas = [
            *(DrawnZone(each, node, swarm, self._desk, self._map) for each in settings.zones),
            *(DrawnMarks(each, node, swarm, self._desk, self._map) for each in settings.grids),
        ]
        self._services: list[Endpoint] = []
        self._map_now = map_now
        self._vehicles = vehicles
        self._taken: frozenset[str] = frozenset()
        """Names in ROS of vehicles that agents of the swarm have. What another gateway tells of one looks like a
        robot, and would be a body where the vehicle itself is."""
        self._taken_due_ns = 0
        self._asked: deque[Callable[[Any], None]] = deque(maxlen=_MOST_ASKED)
        """Replies to those who ask for the map."""
        if map_now is not None:
            self._services.append(node.serve("/map_server/map", _MAP, lambda _, reply: self._asked.append(reply)))
        if settings.orders:
            orders = swarm.orders()
            self._serve_order("/swarm/pause", orders.pause)
            self._serve_order("/swarm/hold", orders.pause)
            self._serve_order("/swarm/resume", orders.resume)
        for robots in settings.robots:
            if robots.id is not None:
                self._add(robots.id, robots)
        if settings.robots:
            node.watch(str(node.name.domain), lambda seen, there: self._news.append((seen, there)))

    @property
    def robots(self) -> frozenset[str]:
        """Ids of those that are known, vehicles by now or not."""
        return frozenset(self._robots)

    @property
    def counts(self) -> Mapping[str, int]:
        """What has come in of the robots that are known, and how many of these are vehicles now."""
        found = Counter({"robots": sum(robot.present for robot in self._robots.values())})
        for robot in self._robots.values():
            found.update(robot.counts)
        return found

    @property
    def _parts(self) -> tuple[Part, ...]:
        return (*self._robots.values(), *self._targets, *self._areas)

    def tick(self, now_ns: int) -> None:
        """Take in what has come.

        now_ns  by time.monotonic_ns
        """
        if self._robots and now_ns >= self._taken_due_ns:
            self._taken_due_ns = now_ns + _LOOK_NS
            self._taken = frozenset(ros_name(id) for id in self._vehicles() if agent_of(id) != id)
        for _ in range(len(self._news)):
            self._hear(*self._news.popleft())
        for part in self._parts:
            part.tick(now_ns)
        self._answer_map()
        self._routes.tick()

    def close(self) -> None:
        """Take away all that was declared. The connection and the node stay open."""
        for service in self._services:
            self._node.remove(service)
        for part in self._parts:
            part.close()
        self._robots.clear()
        self._routes.close()
        self._desk.close()

    def _answer_map(self) -> None:
        """All who ask get one map. Of more than `_MOST_ASKED` the oldest get none: their question ends so."""
        if not self._asked or self._map_now is None:
            return
        response = self._node.types.make(f"{_MAP}_Response", map=self._map_now())
        while self._asked:
            self._asked.popleft()(response)

    def _hear(self, seen: SeenEndpoint, there: bool) -> None:
        """An endpoint of somebody has come or gone."""
        if seen.kind is not Kind.PUBLISHER or seen.node == self._node.name.name:
            return  # a gateway like this one tells of vehicles that the swarm has already
        for robots in self._settings.robots:
            id = robots.robot_of(seen.topic)
            if id is None or robots.id is not None or seen.type_name != POSE_TYPES[robots.type]:
                continue
            ours = self._node.types.hash_of(seen.type_name)
            if ours != seen.type_hash:
                if there and id not in self._strange and len(self._strange) < MOST_ROBOTS:
                    self._strange.add(id)
                    log.warning(
                        "robot %s is not taken in: it publishes %s as %s, expected %s (--distribution)",
                        id, seen.topic, seen.type_hash[:20], ours[:20],
                    )  # fmt: skip
                continue
            self._publishers[seen.topic] += 1 if there else -1
            known = self._robots.get(id)
            if self._publishers[seen.topic] > 0 and known is None:
                self._add(id, robots)
            elif self._publishers[seen.topic] <= 0:
                del self._publishers[seen.topic]
                if known is not None and known.topic == seen.topic:
                    self._robots.pop(id).close()
            return

    def _add(self, id: str, robots: Robots) -> None:
        if len(self._robots) >= MOST_ROBOTS:
            if not self._full_said:
                log.warning("robot %s is not taken in: there are %d already", id, MOST_ROBOTS)
            self._full_said = True
            return
        self._robots[id] = Robot(
            id, robots, self._node, self._swarm, self._routes, self._messages, lambda name: name in self._taken
        )

    def _serve_order(self, name: str, order: Paused) -> None:
        """A Trigger which answers when the order is on a keeper's disk, and says who obeys."""
        make = self._node.types.make

        def told(acknowledged: Acknowledged) -> str:
            silent = f", not heard of: {', '.join(acknowledged.silent)}" if acknowledged.silent else ""
            return f"{len(acknowledged.obeyed)} processes obey{silent}"

        def answer(request: Any, reply: Callable[[Any], None]) -> None:
            def respond(done: bool, sentence: str) -> None:
                reply(make(f"{_TRIGGER}_Response", success=done, message=sentence))

            if not self._desk.give(name, lambda: told(order()), respond):
                respond(False, "too many orders wait already")

        self._services.append(self._node.serve(name, _TRIGGER, answer))
