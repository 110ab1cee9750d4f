"""Drives a way by guided setpoints."""

from __future__ import annotations

import math

from launch_scripts.gateways.mavlink.autopilots import Kind
from launch_scripts.gateways.mavlink.height import Height
from launch_scripts.gateways.mavlink.messages import Position, Setpoint, Way
from launch_scripts.gateways.mavlink.waypoints import rest
from swarm.client import Frame
from swarm.client.frame import Point
from swarm.clock import NS_PER_S

_STREAM_NS = NS_PER_S // 10
"""PX4 leaves offboard below two a second."""
_REPEAT_NS = NS_PER_S
"""ArduPilot drives to the last one; it is said again, as any message may be lost."""
_STREAMED_FIRST_NS = NS_PER_S
"""PX4 takes offboard only if it has had setpoints for a second."""
_HOLDS = 3
"""Times that a vehicle is told to stay where it is."""


class Setpoints:
    """A setpoint at the next turn of the way, streamed where the autopilot wants a stream. Without a way the stream
    ends (PX4 leaves offboard by its own fail-safe), or the vehicle gets a setpoint where it is."""

    def __init__(self, kind: Kind, frame: Frame, height: Height) -> None:
        self._kind = kind
        self._frame = frame
        self._height = height
        self._began_ns: int | None = None
        """When the stream began; None while there is none."""
        self._due_ns = 0
        self._goal: Point | None = None
        self._holds_left = 0
        self._hold_at = (0.0, 0.0)

    def ready(self, now_ns: int) -> bool:
        """Whether the vehicle may be brought into its guided mode."""
        return not self._kind.streams or (
            self._began_ns is not None and now_ns - self._began_ns >= _STREAMED_FIRST_NS
        )

    def drive(self, way: Way, place: Point, now_ns: int) -> list[Setpoint]:
        goal = self._next_turn(way, place)
        if goal == self._goal and now_ns < self._due_ns:
            return []
        self._goal = goal
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        self._due_ns = now_ns + (_STREAM_NS if self._kind.streams else _REPEAT_NS)
        self._holds_left = 0 if self._kind.streams else _HOLDS
        return [self._at(self._frame.to_wgs84(*goal))]

    def hold(self, position: Position, now_ns: int) -> list[Setpoint]:
        """Let it stay where it was when this is called first."""
        if self._goal is not None:
            self._goal, self._began_ns, self._due_ns = None, None, 0
            self._hold_at = (position.lat_deg, position.lon_deg)
        if not self._holds_left or now_ns < self._due_ns:
            return []
        self._holds_left -= 1
        self._due_ns = now_ns + _REPEAT_NS
        return [self._at(self._hold_at)]

    def forget(self) -> None:
        """The link is lost: nothing is said to the vehicle."""
        self._goal, self._began_ns, self._holds_left = None, None, 0

    def _next_turn(self, way: Way, place: Point) -> Point:
        near_m = self._frame.grid.resolution_m / 2
        left = rest(way.points_m, place, near_m)
        # The first lies half a cell ahead on the line; the vehicle drives straight to the turn behind it.
        return next((point for point in left[1:] if math.dist(point, place) > near_m), left[-1])

    def _at(self, degrees: Point) -> Setpoint:
        return Setpoint(self._height.frame, *degrees, self._height.above_m)
