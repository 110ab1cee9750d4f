"""A vehicle as ROS is told of it: where it is, how fast, along which route. Pure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarm.client.observer import SeenVehicle
from swarm.clock import NS_PER_S

_STANDS_NS = NS_PER_S // 2
"""A vehicle of which no other place was told for so long stands."""
_LEAP_M_PER_S = 100.0
"""What moves faster was put elsewhere: it has no speed that anybody could use."""
_PLAN_NS = NS_PER_S
"""A vehicle's route is told at most so often."""
_NO_ROUTE = np.empty((0, 2), np.float64)


class Moving:
    """One vehicle. Its speed is the difference of the last two places that were told, by a clock that
    never leaps: so are all times here.

    id, name        in the swarm, and in ROS
    x_m, y_m, heading_rad  as the swarm has them; a heading of None is told as the last known
    speed_m_per_s   forward; negative backwards
    turn_rad_per_s  clockwise
    route           float64 (n, 2): x, y; what it follows
    route_is_new    it was not told yet
    """

    __slots__ = (
        "_moved_ns",
        "heading_rad",
        "id",
        "name",
        "route",
        "route_is_new",
        "route_told_ns",
        "speed_m_per_s",
        "turn_rad_per_s",
        "x_m",
        "y_m",
    )

    def __init__(self, id: str, name: str, seen: SeenVehicle, now_ns: int) -> None:
        self.id, self.name = id, name
        self.x_m, self.y_m = seen.x_m, seen.y_m
        self.heading_rad = seen.heading_rad
        self.speed_m_per_s = self.turn_rad_per_s = 0.0
        self.route: NDArray[np.float64] = _NO_ROUTE
        self.route_is_new = False
        self.route_told_ns: int | None = None
        self._moved_ns = now_ns

    @property
    def place(self) -> tuple[float, float, float | None]:
        """x, y, heading."""
        return self.x_m, self.y_m, self.heading_rad

    def take(self, seen: SeenVehicle, now_ns: int) -> None:
        """Where it is now."""
        heading_rad = self.heading_rad if seen.heading_rad is None else seen.heading_rad
        if (seen.x_m, seen.y_m, heading_rad) == (self.x_m, self.y_m, self.heading_rad):
            if now_ns - self._moved_ns > _STANDS_NS:
                self.speed_m_per_s = self.turn_rad_per_s = 0.0
            return
        since_s = (now_ns - self._moved_ns) / NS_PER_S
        if since_s > 0:
            self._measure(seen.x_m - self.x_m, seen.y_m - self.y_m, heading_rad, since_s)
        self.x_m, self.y_m, self.heading_rad, self._moved_ns = seen.x_m, seen.y_m, heading_rad, now_ns

    def route_is_due(self, now_ns: int) -> bool:
        """Whether its route is to be told now."""
        return self.route_is_new and (self.route_told_ns is None or now_ns - self.route_told_ns >= _PLAN_NS)

    def follow(self, points_m: NDArray[np.float64]) -> None:
        self.route, self.route_is_new = points_m, True

    def _measure(self, east_m: float, north_m: float, heading_rad: float | None, since_s: float) -> None:
        if heading_rad is None:
            forward_m = math.hypot(east_m, north_m)
        else:
            forward_m = east_m * math.sin(heading_rad) + north_m * math.cos(heading_rad)
        turned_rad = 0.0
        if heading_rad is not None and self.heading_rad is not None:
            turned_rad = (heading_rad - self.heading_rad + math.pi) % math.tau - math.pi
        if math.hypot(east_m, north_m) > _LEAP_M_PER_S * since_s:
            forward_m = turned_rad = 0.0
        # Of two places that were told long apart the first was left at an unknown time: no less than a report ago.
        self.speed_m_per_s, self.turn_rad_per_s = forward_m / since_s, turned_rad / since_s
