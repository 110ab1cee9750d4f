"""Areas that ROS draws: polygons as zones, which are ordered, and grids as marks."""

from __future__ import annotations

import logging
from typing import Any

from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.graph import Qos
from launch_scripts.gateways.ros2.incoming.areas import closed_cells, corners_of
from launch_scripts.gateways.ros2.incoming.order_desk import OrderDesk
from launch_scripts.gateways.ros2.incoming.places import FrameReader
from launch_scripts.gateways.ros2.incoming.settings import GridSettings, ZoneSettings
from launch_scripts.gateways.ros2.node import Newest, Node
from swarm.client import ConfigError, Swarm, Vehicle
from swarm.clock import NS_PER_S

log = logging.getLogger(__name__)

_EVERY_NS = NS_PER_S
_MOST_POLYGON_BYTES = 1 << 14


class _Drawn:
    """An area whose newest message is worked on once a second at most, on the thread of orders."""

    def __init__(self, name: str, newest: Newest, desk: OrderDesk) -> None:
        self._topic, self._what = newest.endpoint.topic, f"{name} of {newest.endpoint.topic}"
        self._newest, self._desk = newest, desk
        self._due_ns = 0
        self._held: Any = None
        """What there was no room for yet."""

    def tick(self, now_ns: int) -> None:
        if now_ns < self._due_ns:
            return
        message = self._newest.take() or self._held
        if message is None:
            return
        self._due_ns = now_ns + _EVERY_NS
        given = self._desk.give(self._what, lambda: self._draw(message), self._told)
        self._held = None if given else message

    def _draw(self, message: Any) -> str:
        """Raises SwarmError."""
        raise NotImplementedError

    def _told(self, done: bool, sentence: str) -> None:
        if done:
            log.debug("topic %s: %s", self._topic, sentence)
        else:
            log.warning("topic %s: %s", self._topic, sentence)

    def close(self) -> None:
        self._newest.close()


class DrawnZone(_Drawn):
    """A zone that is drawn by polygons. One whose corners are those of the last is not ordered again, unless the
    zone ends by itself."""

    def __init__(self, settings: ZoneSettings, node: Node, swarm: Swarm, desk: OrderDesk, map: RosMap) -> None:
        super().__init__(
            settings.name,
            node.newest(settings.topic, "geometry_msgs/msg/PolygonStamped", Qos.LATCHED, _MOST_POLYGON_BYTES),
            desk,
        )
        self._settings = settings
        self._orders, self._reader = swarm.orders(), FrameReader(map)
        self._corners: list[tuple[float, float]] | None = None

    def _draw(self, message: Any) -> str:
        settings = self._settings
        corners = corners_of(self._reader, message)
        if isinstance(corners, str):
            raise ConfigError(corners)
        if corners == self._corners and settings.for_s is None:
            return "as before"
        if not corners:
            self._orders.remove_zone(settings.name)
        else:
            self._orders.add_zone(
                corners, name=settings.name, pace_s_per_m=settings.pace_s_per_m, for_s=settings.for_s
            )
        self._corners = corners
        return f"zone {settings.name} has {len(corners)} corners"


class DrawnMarks(_Drawn):
    """Cells that grids close. Those that the next grid does not close are again as the map had them."""

    def __init__(self, settings: GridSettings, node: Node, swarm: Swarm, desk: OrderDesk, map: RosMap) -> None:
        super().__init__(
            settings.name, node.newest(settings.topic, "nav_msgs/msg/OccupancyGrid", Qos.LATCHED), desk
        )
        self._settings = settings
        self._swarm, self._map = swarm, map
        self._author: Vehicle | None = None
        self._closed: set[int] = set()

    def _draw(self, message: Any) -> str:
        settings = self._settings
        cells = closed_cells(self._map, message, settings.occupied)
        if isinstance(cells, str):
            raise ConfigError(cells)
        if self._author is None:  # it has no place: it only marks
            self._author = self._swarm.vehicle(settings.name)
        opened = self._closed.difference(cells)
        if opened:
            self._author.mark(sorted(opened), clear=True)
        new = cells if settings.for_s is not None else sorted(set(cells) - self._closed)
        if new:
            self._author.mark(new, lethal=True, for_s=settings.for_s)
        self._closed = set(cells)
        return f"{len(cells)} cells are closed"

    def close(self) -> None:
        super().close()
        if self._author is not None:
            self._author.leave()
