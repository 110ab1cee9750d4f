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

from launch_scripts.gateways.ros2.gateway import (
    Action,
    Channel,
    Declare,
    Gateway,
    Health,
    Put,
    Remove,
    ToWgs84,
)
from launch_scripts.gateways.ros2.gateway_settings import IncomingSettings, Settings
from launch_scripts.gateways.ros2.incoming.incoming import TICK_S, Incoming
from launch_scripts.gateways.ros2.map_feed import MapFeed, find_terrain
from launch_scripts.gateways.ros2.rmw import Endpoint, PeerWatch
from launch_scripts.gateways.ros2.ros_messages import RosMap
from launch_scripts.gateways.ros2.ros_node import Node, Publisher, RosSession, close_ros, open_ros
from launch_scripts.gateways.ros2.ros_types import Distribution, types_of
from launch_scripts.gateways.ros2.topic_table import ROWS
from swarm.client import Frame, Observer, Swarm, SwarmError, connect
from swarm.config.scenario import NetworkConfig
from swarm.errors import BusError, ConfigError

log = logging.getLogger(__name__)

_LOOK_S = 1.0
"""Links are looked at so often."""
_LONGEST_SLEEP_S = 0.1
_AGAIN_S = 2.0
_MOST_SEEN = 4096
"""Peers' endpoints that wait to be looked at; the oldest are dropped first."""
_POSITIONS_S = 0.1
Say = Callable[[str], None]


class Ros2Service:
    """One gateway, from run to run of a namespace.

    settings  checked
    network   of the swarm, with the gateway's own certificate
    runs      folder of the runs of this machine, where the terrain may be
    say       is told what people should know, a sentence each
    """

    def __init__(self, settings: Settings, network: NetworkConfig, runs: Path, say: Say) -> None:
        self._settings, self._network, self._runs, self._say = settings, network, runs, say
        self._types = types_of(Distribution(settings.ros.distribution))
        self._forwards = {row.name for row in settings.rows()}

    def run(self, stopping: Callable[[], bool]) -> None:
        """Forwards until it is `stopping`. Raises SwarmError if a side does not answer at the start; later both are
        waited for."""
        ros = open_ros(self._settings.ros.endpoint)
        try:
            swarm: Swarm | None = self._connect()
            while swarm is not None:
                with swarm:
                    self._forward(ros, swarm, stopping)
                    ended = swarm.ended
                if ended is not None:
                    self._say(f"{ended}")
                swarm = self._connect_again(stopping)
        finally:
            close_ros(ros)

    def _connect(self) -> Swarm:
        network, tls = self._network, self._network.tls
        files = {} if tls is None else {"ca": tls.ca, "certificate": tls.certificate, "key": tls.key}
        return connect(
            network.connect[0], namespace=network.namespace, timeout_s=network.connect_timeout_s, **files
        )

    def _connect_again(self, stopping: Callable[[], bool]) -> Swarm | None:
        while not stopping():
            try:
                return self._connect()
            except SwarmError as error:
                log.info("%s", error)
                time.sleep(_AGAIN_S)
        return None

    def _forward(self, ros: RosSession, swarm: Swarm, stopping: Callable[[], bool]) -> None:
        """One run, until it is over."""
        side = self._settings.ros
        node = Node(ros, side.node, self._types, side.domain)
        try:
            with swarm.observer(every_s=_POSITIONS_S) as observer:
                gateway = self._gateway(swarm)
                self._say(
                    f"node /{side.node} in domain {side.domain} at {side.endpoint}, "
                    f"{side.distribution}; run {swarm.run_id}, scenario {swarm.scenario}"
                )
                incoming = self._incoming(node, swarm, gateway, observer)
                try:
                    where = {"swarm": self._network.connect[0], "ROS": side.endpoint}
                    _Run(node, swarm, observer, gateway, incoming, where, self._say).go_on(stopping)
                finally:
                    if incoming is not None:
                        incoming.close()
        finally:
            node.close()

    def _incoming(self, node: Node, swarm: Swarm, gateway: Gateway, observer: Observer) -> Incoming | None:
        settings = self._settings
        if settings.incoming == IncomingSettings():
            return None
        map_now = (lambda: gateway.whole_map(time.time_ns())) if "map" in self._forwards else None
        map = RosMap(swarm.frame.grid, settings.frames.map)
        return Incoming(node, swarm, settings.incoming, map, map_now, lambda: observer.vehicles)

    def _gateway(self, swarm: Swarm) -> Gateway:
        settings, grid = self._settings, swarm.frame.grid
        folder = Path(settings.swarm.terrain) if settings.swarm.terrain else None
        terrain = find_terrain(swarm.run.terrain, folder, self._runs)
        if terrain is None and "map" in self._forwards:
            self._say(
                f"the terrain of the run is not on this machine (no run in {self._runs} has it): /map holds marks "
                "alone; swarm.terrain in the settings names a folder"
            )
        map = RosMap(grid, settings.frames.map)
        return Gateway(settings, self._types, map, MapFeed(grid, terrain), self._to_wgs84(swarm.frame))

    def _to_wgs84(self, frame: Frame) -> ToWgs84 | None:
        if frame.crs == "local" or "fix" not in self._forwards:
            return None
        try:
            frame.to_wgs84(*frame.centre_m(0))
        except ConfigError as error:
            self._say(f"there are no fixes: {error}")
            return None
        return frame.to_wgs84


class _Run:
    """One run's turns, on one thread.

    where  the endpoint of each side's router
    """

    def __init__(
        self,
        node: Node,
        swarm: Swarm,
        observer: Observer,
        gateway: Gateway,
        incoming: Incoming | None,
        where: Mapping[str, str],
        say: Say,
    ) -> None:
        self._node, self._swarm, self._gateway, self._incoming = node, swarm, gateway, incoming
        self._observer = observer
        self._where, self._say = where, say
        self._up = dict.fromkeys(where, True)
        self._publishers: dict[Channel, Publisher] = {}
        self._counts: Counter[str] = Counter()
        self._watch = PeerWatch()
        self._seen: deque[Endpoint] = deque(maxlen=_MOST_SEEN)

    def go_on(self, stopping: Callable[[], bool]) -> None:
        """Forwards until another run is in the namespace, or until it is `stopping`."""
        self._node.watch("*", lambda seen, there: self._seen.append(seen) if there else None)
        look_due_s = 0.0
        while not stopping() and self._swarm.ended is None:
            if time.monotonic() >= look_due_s:
                look_due_s = time.monotonic() + _LOOK_S
                self._look("swarm", self._swarm.connected)
                self._look("ROS", self._node.connected)
            now_ns, stamp_ns = time.monotonic_ns(), time.time_ns()
            robots = () if self._incoming is None else self._incoming.robots
            swarm_now_ns, health = self._swarm.now_ns, self._health()
            for action in self._gateway.tick(now_ns, stamp_ns, swarm_now_ns, self._observer, health, robots):
                self._perform(action)
            self._tell_problems()
            due_s = (self._gateway.due_ns - time.monotonic_ns()) / 1e9
            longest_s = _LONGEST_SLEEP_S
            if self._incoming is not None:
                self._incoming.tick(time.monotonic_ns())
                longest_s = TICK_S
            time.sleep(min(max(due_s, 0.001), longest_s))

    def _look(self, side: str, up: bool) -> None:
        """Says when a link goes or comes back."""
        if up != self._up[side]:
            self._up[side] = up
            self._say(f"the {side} router at {self._where[side]} {'is back' if up else 'is gone: waiting for it'}")

    def _perform(self, action: Action) -> None:
        """Nothing here waits for ROS."""
        match action:
            case Put(channel=channel, message=message):
                try:
                    self._publishers[channel].put(message)
                    self._counts["put"] += 1
                except BusError as error:
                    self._counts["put_failed"] += 1
                    log.debug("%s: %s", channel.topic, error)
            case Declare(channels=channels):
                for channel in channels:
                    row = ROWS[channel.row]
                    self._publishers[channel] = self._node.publisher(channel.topic, row.type_name, row.qos)
            case Remove(channels=channels):
                for channel in channels:
                    self._node.remove(self._publishers.pop(channel).endpoint)

    def _health(self) -> Health:
        counts = {**self._counts, **self._node.counts}
        counts |= {f"swarm_{name}": count for name, count in self._swarm.counts.items()}
        if self._incoming is not None:
            counts |= {f"from_ros_{name}": count for name, count in self._incoming.counts.items()}
        return Health(self._swarm.run_id, self._up["swarm"], self._up["ROS"], counts)

    def _tell_problems(self) -> None:
        problems = self._gateway.take_problems()
        if self._seen:
            ours = self._node.endpoints
            while self._seen:
                if (sentence := self._watch.sentence(self._seen.popleft(), ours)) is not None:
                    problems.append(sentence)
        for sentence in problems:
            self._say(sentence)
