"""What ROS is told of a swarm: its state and the time in, messages to put out. Core: no bus, no clock.

Each topic of the table has its rate; what comes late is left out, never made up for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from launch_scripts.gateways.ros2.actions import Action, Channel, Declare, Put
from launch_scripts.gateways.ros2.diagnostics import Health, diagnostics_of
from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.grids import occupancy_grid
from launch_scripts.gateways.ros2.map_feed import MapFeed
from launch_scripts.gateways.ros2.map_topics import MapTopics
from launch_scripts.gateways.ros2.messages import RosMessages
from launch_scripts.gateways.ros2.settings import Settings
from launch_scripts.gateways.ros2.target_topics import TargetTopics
from launch_scripts.gateways.ros2.topics import Direction, TopicRow
from launch_scripts.gateways.ros2.types import RosTypes
from launch_scripts.gateways.ros2.vehicle_topics import BARE, ToWgs84, VehicleTopics
from swarm.client.observer import SeenTarget, SeenVehicle
from swarm.clock import NS_PER_S
from swarm.wire.messages.map_data import MarkSet

_STEP_HZ = 10.0
"""What has no rate of its own is looked at so often."""
_MAP_HZ = 1.0


class View(Protocol):
    """What is seen of the swarm: `swarm.client.Observer`."""

    @property
    def vehicles(self) -> Mapping[str, SeenVehicle]: ...
    @property
    def targets(self) -> Mapping[str, SeenTarget]: ...
    def take_routes(self) -> Mapping[str, list[tuple[float, float]]]: ...
    def take_mark_sets(self) -> list[MarkSet]: ...


class Gateway:
    """What one gateway tells of one run.

    settings  what is forwarded, and as what
    map       the frame in which places are told
    feed      the shared map
    to_wgs84  (latitude, longitude) of a place of the terrain; None where there are none
    """

    def __init__(
        self, settings: Settings, types: RosTypes, map: RosMap, feed: MapFeed, to_wgs84: ToWgs84 | None = None
    ) -> None:
        self._problems: list[str] = []
        rows = {row.name: row for row in settings.rows() if row.direction is Direction.OUT}
        if to_wgs84 is None:
            rows.pop("fix", None)
        self._rows = rows
        self._bare = settings.frames.bare
        self._feed = feed
        self._messages = RosMessages(types, map)
        problem = self._problems.append
        self._vehicles = VehicleTopics(rows, self._messages, settings.vehicles, self._bare, to_wgs84, problem)
        self._targets = TargetTopics(rows, self._messages, problem)
        self._map = MapTopics(rows, self._messages, feed)
        self._due_ns = dict.fromkeys(rows, 0)
        self._begun = False

    @property
    def due_ns(self) -> int:
        """When `tick` has something to do again, by the clock that never leaps."""
        return min(self._due_ns.values(), default=0)

    def whole_map(self, stamp_ns: int) -> Any:
        """nav_msgs/OccupancyGrid of the map as it is known now."""
        return occupancy_grid(self._messages, stamp_ns, self._feed.occupancy(self._feed.grid.window))

    def take_problems(self) -> list[str]:
        """Sentences for people since the last call."""
        taken = list(self._problems)
        self._problems.clear()
        return taken

    def tick(self, now_ns: int, stamp_ns: int, swarm_now_ns: int, view: View, health: Health) -> list[Action]:
        """What is to be done now, in order.

        now_ns        by a clock that never leaps, by which all rates are kept
        stamp_ns      by the clock of this machine, since 1970, which stamps what ROS hears
        swarm_now_ns  by the swarm's clocks, by which marks expire
        """
        due = {name for name, at_ns in self._due_ns.items() if now_ns >= at_ns}
        if not due:
            return []
        for name in due:
            self._due_ns[name] = _next_ns(self._rows[name], now_ns)
        vehicles, targets = view.vehicles, view.targets
        actions = [
            *self._begin(),
            *self._vehicles.follow(vehicles, now_ns, stamp_ns),
            *self._targets.follow(targets),
        ]
        for id, points_m in view.take_routes().items():
            self._vehicles.route(id, points_m)
        actions += self._vehicles.tell(due, now_ns, stamp_ns)
        actions += self._targets.tell(due, targets, stamp_ns)
        if due & {"map", "map_updates", "markers"}:
            self._feed.merge(view.take_mark_sets(), now_ns, swarm_now_ns)
            actions += self._map.tell(due, self._vehicles.told, now_ns, stamp_ns, swarm_now_ns)
        if "diagnostics" in due:
            told = diagnostics_of(self._messages, vehicles, targets, health, self._feed.knows_ground)
            channel = Channel("diagnostics", self._rows["diagnostics"].topic)
            actions.append(Put(channel, self._messages.diagnostics(stamp_ns, told)))
        return actions

    def _begin(self) -> list[Action]:
        """Topics that are there from the first tick on."""
        if self._begun:
            return []
        self._begun = True
        return [
            Declare(
                tuple(
                    Channel(name, row.topic)
                    for name, row in self._rows.items()
                    if row.per is None and not (self._bare and name in BARE)
                )
            )
        ]


def _next_ns(row: TopicRow, now_ns: int) -> int:
    """The next multiple of its period: topics of one rate stay together, and no delay adds up."""
    hz = row.hz or (_MAP_HZ if row.name == "map" else _STEP_HZ)
    period_ns = int(NS_PER_S / hz)
    return (now_ns // period_ns + 1) * period_ns
