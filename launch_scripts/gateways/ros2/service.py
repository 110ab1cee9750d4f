"""The process of `swarm ros2`: one session to the swarm, one to ROS, and the gateway between them. Shell only.

Both sides may come and go. What ROS hears is put without waiting, so a ROS side that hangs costs the swarm nothing,
and misses messages.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path

from launch_scripts.gateways.ros2.actions import Action, Channel, Declare, Put, Remove
from launch_scripts.gateways.ros2.diagnostics import Health
from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.gateway import Gateway, View
from launch_scripts.gateways.ros2.graph import SeenEndpoint
from launch_scripts.gateways.ros2.incoming.incoming import TICK_S, Incoming
from launch_scripts.gateways.ros2.incoming.settings import IncomingSettings
from launch_scripts.gateways.ros2.map_feed import MapFeed
from launch_scripts.gateways.ros2.node import Node, Publisher, RosSession, close_ros, open_ros
from launch_scripts.gateways.ros2.peers import PeerWatch
from launch_scripts.gateways.ros2.run_terrain import find_terrain
from launch_scripts.gateways.ros2.settings import Settings
from launch_scripts.gateways.ros2.topics import ROWS
from launch_scripts.gateways.ros2.types import Distribution, types_of
from launch_scripts.gateways.ros2.vehicle_topics import ToWgs84
from swarm.client import Observer, Swarm, SwarmError, connect
from swarm.client.frame import Frame
from swarm.client.observer import SeenTarget, SeenVehicle
from swarm.config.scenario import NetworkConfig
from swarm.errors import BusError, ConfigError
from swarm.wire.messages.map_data import MarkSet

log = logging.getLogger(__name__)

_LOOK_S = 1.0
"""Links are looked at so often."""
_LONGEST_SLEEP_S = 0.1
_AGAIN_S = 2.0
_MOST_SEEN = 4096
"""Peers' endpoints that wait to be looked at; the oldest are dropped first."""
_POSITIONS_S = 0.1
Say = Callable[[str], None]


class Sides:
    """Both links as far as is known; says when one goes or comes back."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._up = {"swarm": True, "ROS": True}

    def look(self, side: str, up: bool, where: str) -> None:
        if up != self._up[side]:
            self._up[side] = up
            self._say(f"the {side} router at {where} {'is back' if up else 'is gone: waiting for it'}")

    def up(self, side: str) -> bool:
        return self._up[side]


class WithoutRobots:
    """What an observer sees, without the robots of ROS: these tell ROS themselves where they are."""

    def __init__(self, view: View, incoming: Incoming) -> None:
        self._view, self._incoming = view, incoming

    @property
    def vehicles(self) -> Mapping[str, SeenVehicle]:
        robots = self._incoming.robots
        return {id: each for id, each in self._view.vehicles.items() if id not in robots}

    @property
    def targets(self) -> Mapping[str, SeenTarget]:
        return self._view.targets

    def take_routes(self) -> Mapping[str, list[tuple[float, float]]]:
        return self._view.take_routes()

    def take_mark_sets(self) -> list[MarkSet]:
        return self._view.take_mark_sets()


class RosOut:
    """The publishers of a node, by channel. Nothing here waits for ROS."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publishers: dict[Channel, Publisher] = {}
        self.counts: Counter[str] = Counter()

    def perform(self, action: Action) -> None:
        match action:
            case Put(channel=channel, message=message):
                publisher = self._publishers[channel]
                try:
                    if isinstance(message, bytes):
                        publisher.put_packed(message)
                    else:
                        publisher.put(message)
                except BusError as error:
                    self.counts["put_failed"] += 1
                    log.debug("%s: %s", channel.topic, error)
                else:
                    self.counts["put"] += 1
            case Declare(channels=channels):
                for channel in channels:
                    row = ROWS[channel.row]
                    self._publishers[channel] = self._node.publisher(channel.topic, row.type_name, row.qos)
            case Remove(channels=channels):
                for channel in channels:
                    self._node.remove(self._publishers.pop(channel).endpoint)


class Ros2Service:
    """One gateway, from run to run of a namespace.

    settings  checked
    network   of the swarm, with the gateway's own certificate
    runs      folder of the runs of this machine, where the terrain may be
    say       is told what people should know, a sentence each
    """

    def __init__(self, settings: Settings, network: NetworkConfig, runs: Path, say: Say) -> None:
        self._settings = settings
        self._network = network
        self._runs = runs
        self._say = say
        self._types = types_of(Distribution(settings.ros.distribution))

    def run(self, until_s: float | None = None, stopping: Callable[[], bool] = lambda: False) -> None:
        """Forward until a time of `time.monotonic`, or until it is `stopping`. Raises BusError if one of the sides
        does not answer at the start; after that both are waited for."""

        def over() -> bool:
            return stopping() or (until_s is not None and time.monotonic() >= until_s)

        ros = open_ros(self._settings.ros.endpoint)
        try:
            swarm = self._connect()
            while True:
                try:
                    with swarm:
                        self._forward(ros, swarm, over)
                except _RunOverError:
                    self._say(f"{swarm.ended}")
                if over():
                    return
                swarm = self._connect_again(over)
        finally:
            close_ros(ros)

    def _connect(self) -> Swarm:
        network, tls = self._network, self._network.tls
        files = {} if tls is None else {"ca": tls.ca, "certificate": tls.certificate, "key": tls.key}
        return connect(
            network.connect[0], namespace=network.namespace, timeout_s=network.connect_timeout_s, **files
        )

    def _connect_again(self, over: Callable[[], bool]) -> Swarm:
        while True:
            try:
                return self._connect()
            except SwarmError as error:
                if over():
                    raise
                log.info("%s", error)
                time.sleep(_AGAIN_S)

    def _forward(self, ros: RosSession, swarm: Swarm, over: Callable[[], bool]) -> None:
        """One run. Raises _RunOverError when another one is in its place."""
        settings = self._settings
        node = Node(ros, settings.ros.node, self._types, settings.ros.domain)
        try:
            with swarm.observer(every_s=_POSITIONS_S) as observer:
                gateway = self._gateway(swarm)
                self._say(
                    f"node /{settings.ros.node} in domain {settings.ros.domain} at {settings.ros.endpoint}, "
                    f"{settings.ros.distribution}; run {swarm.run_id}, scenario {swarm.scenario}"
                )
                incoming = self._incoming(node, swarm, gateway, observer)
                try:
                    _Loop(self, node, swarm, observer, gateway, incoming, self._say).run(over)
                finally:
                    if incoming is not None:
                        incoming.close()
        finally:
            node.close()

    def _incoming(self, node: Node, swarm: Swarm, gateway: Gateway, observer: Observer) -> Incoming | None:
        settings = self._settings
        if settings.incoming == IncomingSettings():
            return None
        map = RosMap(swarm.frame.grid, settings.frames.map)
        has_map = any(row.name == "map" for row in settings.rows())
        map_now = (lambda: gateway.whole_map(time.time_ns())) if has_map else None
        return Incoming(node, swarm, settings.incoming, map, map_now, lambda: observer.vehicles)

    def _gateway(self, swarm: Swarm) -> Gateway:
        settings, grid = self._settings, swarm.frame.grid
        folder = Path(settings.swarm.terrain) if settings.swarm.terrain else None
        terrain = find_terrain(swarm.run.terrain, folder, self._runs)
        if terrain is None and any(row.name == "map" for row in settings.rows()):
            self._say(
                f"the terrain of the run is not on this machine (no run in {self._runs} has it): /map holds marks "
                "alone; swarm.terrain in the settings names a folder"
            )
        map = RosMap(grid, settings.frames.map)
        return Gateway(settings, self._types, map, MapFeed(grid, terrain), self._to_wgs84(swarm.frame))

    def _to_wgs84(self, frame: Frame) -> ToWgs84 | None:
        if frame.crs == "local" or all(row.name != "fix" for row in self._settings.rows()):
            return None
        try:
            frame.to_wgs84(*frame.centre_m(0))
        except ConfigError as error:
            self._say(f"there are no fixes: {error}")
            return None
        return frame.to_wgs84

    @property
    def where(self) -> tuple[str, str]:
        """Endpoints of the swarm's router and of ROS's."""
        return self._network.connect[0], self._settings.ros.endpoint


class _RunOverError(Exception):
    """Another run is in the namespace."""


class _Loop:
    """One run's turns, on one thread."""

    def __init__(
        self,
        service: Ros2Service,
        node: Node,
        swarm: Swarm,
        observer: Observer,
        gateway: Gateway,
        incoming: Incoming | None,
        say: Say,
    ) -> None:
        self._where = service.where
        self._node, self._swarm, self._gateway, self._incoming = node, swarm, gateway, incoming
        self._view: View = observer if incoming is None else WithoutRobots(observer, incoming)
        self._say = say
        self._sides = Sides(say)
        self._out = RosOut(node)
        self._watch = PeerWatch()
        self._seen: deque[SeenEndpoint] = deque(maxlen=_MOST_SEEN)
        self._look_due_s = 0.0

    def run(self, over: Callable[[], bool]) -> None:
        self._node.watch("*", lambda seen, there: self._seen.append(seen) if there else None)
        while not over():
            if time.monotonic() >= self._look_due_s:
                self._look_due_s = time.monotonic() + _LOOK_S
                self._look()
            now_ns, stamp_ns = time.monotonic_ns(), time.time_ns()
            for action in self._gateway.tick(now_ns, stamp_ns, self._swarm.now_ns, self._view, self._health()):
                self._out.perform(action)
            self._tell()
            due_s = (self._gateway.due_ns - time.monotonic_ns()) / 1e9
            if self._incoming is not None:
                self._incoming.tick(time.monotonic_ns())
            longest_s = _LONGEST_SLEEP_S if self._incoming is None else TICK_S
            time.sleep(min(max(due_s, 0.001), longest_s))

    def _look(self) -> None:
        swarm_at, ros_at = self._where
        self._sides.look("swarm", self._swarm.connected, swarm_at)
        self._sides.look("ROS", self._node.connected, ros_at)
        if self._swarm.ended is not None:
            raise _RunOverError

    def _health(self) -> Health:
        counts = {
            **self._out.counts,
            **self._node.counts,
            **{f"swarm_{k}": v for k, v in self._swarm.counts.items()},
            **({} if self._incoming is None else {f"from_ros_{k}": v for k, v in self._incoming.counts.items()}),
        }
        return Health(self._swarm.run_id, self._sides.up("swarm"), self._sides.up("ROS"), counts)

    def _tell(self) -> None:
        problems = self._gateway.take_problems()
        ours = None
        while self._seen:
            ours = self._node.endpoints if ours is None else ours
            if (sentence := self._watch.sentence(self._seen.popleft(), ours)) is not None:
                problems.append(sentence)
        for sentence in problems:
            self._say(sentence)
