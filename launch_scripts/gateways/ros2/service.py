"""The process of `gateway ros2`: one session to the swarm, one to ROS, and the gateway between them. Shell only.

Both sides may come and go. Messages to ROS are published without waiting, so a ROS side that hangs costs the swarm
nothing, and misses messages.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from launch_scripts.gateways.ros2.gateway_settings import ROWS, IncomingSettings, Settings
from launch_scripts.gateways.ros2.incoming import Incoming
from launch_scripts.gateways.ros2.map_messages import MapFeed
from launch_scripts.gateways.ros2.outgoing import Channel, Gateway, Health, Say, ToWgs84
from launch_scripts.gateways.ros2.rmw import Endpoint, PeerWatch
from launch_scripts.gateways.ros2.ros_messages import RosMap, RosMessages
from launch_scripts.gateways.ros2.ros_node import Node, Publisher, open_ros
from launch_scripts.gateways.ros2.ros_types import types_of
from shared_map.terrain.store import find_prepared
from swarm.client import Frame, Observer, Swarm, SwarmError
from swarm.errors import ConfigError

log = logging.getLogger(__name__)

TICK_S = 0.02
"""Pause between two turns: a message waits for so long at most. Chosen, not measured."""
_AGAIN_S = 2.0
"""Pause between two attempts to connect. Chosen, not measured."""
_MOST_SEEN = 4096
"""Peers' endpoints that wait to be looked at; the oldest are dropped first."""
_POSITIONS_S = 0.1
"""Ten samples a second, as often as vehicles tell where they are by default: a position is a
tenth of a second old at most."""


def serve(
    settings: Settings, connect: Callable[[], Swarm], runs: Path, say: Say, stopping: Callable[[], bool]
) -> None:
    """Forwards from run to run of a namespace, until it is `stopping`. Raises SwarmError if a side does not answer
    at the start; later both are waited for.

    connect  opens a connection to the swarm
    runs     folder of the runs of this machine, where the terrain may be
    say      receives sentences for people, one at a time
    """
    with open_ros(settings.ros.endpoint) as ros:
        swarm: Swarm | None = connect()
        while swarm is not None:
            with swarm, swarm.observer(every_s=_POSITIONS_S) as observer:
                node = Node(ros, settings.ros.node, types_of(settings.ros.distribution), settings.ros.domain)
                with closing(_Run(settings, node, swarm, observer, runs, say)) as run:
                    while not stopping() and swarm.ended is None:
                        run.turn()
                        time.sleep(TICK_S)
                ended = swarm.ended
            if ended is not None:
                say(f"{ended}")
            swarm = _connect_again(connect, stopping)


def _connect_again(connect: Callable[[], Swarm], stopping: Callable[[], bool]) -> Swarm | None:
    while not stopping():
        try:
            return connect()
        except SwarmError as error:
            log.info("%s", error)
            time.sleep(_AGAIN_S)
    return None


class _Run:
    """The gateway of one run. All is done on one thread."""

    def __init__(
        self, settings: Settings, node: Node, swarm: Swarm, observer: Observer, runs: Path, say: Say
    ) -> None:
        side, grid = settings.ros, swarm.frame.grid
        messages = RosMessages(node.types, RosMap(grid, settings.frames.map))
        forwards = {row.name for row in settings.rows()}
        folder = Path(settings.swarm.terrain) if settings.swarm.terrain else None
        terrain = find_prepared(swarm.run.terrain, folder, runs)
        if terrain is None and "map" in forwards:
            say(
                f"the terrain of the run is not on this machine (no run in {runs} has it): /map holds marks alone; "
                "swarm.terrain in the settings names a folder"
            )
        to_wgs84 = _to_wgs84(swarm.frame, say) if "fix" in forwards else None
        self._swarm, self._observer, self._say = swarm, observer, say
        self._gateway = Gateway(settings, messages, MapFeed(grid, terrain), say, to_wgs84)
        self._node = node
        self._publishers: dict[Channel, Publisher] = {}
        self._declared: frozenset[Channel] = frozenset()
        self._up = {"swarm": True, "ROS": True}
        self._watch = PeerWatch()
        self._seen: deque[Endpoint] = deque(maxlen=_MOST_SEEN)
        self._node.watch("*", lambda seen, there: self._seen.append(seen) if there else None)
        say(
            f"node /{side.node} in domain {side.domain} at {side.endpoint}, {side.distribution}; "
            f"run {swarm.run_id}, scenario {swarm.scenario}"
        )
        serves_map = "map" in forwards and settings.incoming != IncomingSettings()
        map_now = (lambda: self._gateway.whole_map(time.time_ns())) if serves_map else None
        self._incoming = Incoming(node, swarm, settings.incoming, messages, map_now, lambda: observer.vehicles)

    def turn(self) -> None:
        """Performs due work. Nothing here waits for ROS."""
        for side, up in (("swarm", self._swarm.connected), ("ROS", self._node.connected)):
            if up != self._up[side]:
                self._up[side] = up
                self._say(f"the {side} router {'is back' if up else 'is disconnected: waiting for it'}")
        clocks = time.monotonic_ns(), time.time_ns(), self._swarm.now_ns
        puts = self._gateway.tick(*clocks, self._observer, self._health(), self._incoming.robots)
        self._declare(self._gateway.channels)
        for put in puts:
            self._publishers[put.channel].put(put.message)
        self._incoming.tick(time.monotonic_ns())
        while self._seen:
            for sentence in self._watch.sentences(self._seen.popleft(), self._node.endpoints):
                self._say(sentence)

    def close(self) -> None:
        """Takes back all that was declared."""
        self._incoming.close()
        self._node.close()

    def _declare(self, channels: frozenset[Channel]) -> None:
        """Takes topics down that are no more, and puts new ones up."""
        if channels is self._declared:
            return
        self._declared = channels
        for channel in self._publishers.keys() - channels:
            self._node.remove(self._publishers.pop(channel).endpoint)
        for channel in channels - self._publishers.keys():
            self._publishers[channel] = self._node.publisher(channel.topic, ROWS[channel.row])

    def _health(self) -> Health:
        counts = {**self._node.counts}
        for side, counted in (("swarm", self._swarm.counts), ("from_ros", self._incoming.counts)):
            counts |= {f"{side}_{name}": count for name, count in counted.items()}
        return Health(self._swarm.run_id, all(self._up.values()), counts)


def _to_wgs84(frame: Frame, say: Say) -> ToWgs84 | None:
    if frame.crs == "local":
        return None
    try:
        frame.to_wgs84(*frame.centre_m(0))
    except ConfigError as error:
        say(f"there are no fixes: {error}")
        return None
    return frame.to_wgs84
