"""Drives a way by missions: which one the vehicle has, and when it gets the next."""

from __future__ import annotations

import math

from launch_scripts.gateways.mavlink.autopilots import Kind
from launch_scripts.gateways.mavlink.height import Height
from launch_scripts.gateways.mavlink.messages import (
    NAV_LOITER_UNLIM,
    NAV_TAKEOFF,
    NAV_WAYPOINT,
    MissionCancelled,
    MissionCount,
    MissionCurrent,
    MissionItem,
    Position,
    Tell,
    Way,
)
from launch_scripts.gateways.mavlink.upload import State, Upload
from launch_scripts.gateways.mavlink.waypoints import MOST_POINTS, is_end_of, rest
from swarm.client import Frame
from swarm.client.frame import Point
from swarm.clock import NS_PER_S

_NEXT_NS = 3 * NS_PER_S
"""From one mission to the next: a target that moves changes its routes several times a second."""
_AFTER_FAILURE_NS = 5 * NS_PER_S
_ON_GROUND_M = 2.0


class Missions:
    """Uploads the rest of a way as a mission, one at a time, whenever that is not what the vehicle has already.

    accepted  whether the vehicle has a mission that leads along a way
    """

    def __init__(self, kind: Kind, frame: Frame, height: Height) -> None:
        self.accepted = False
        self._kind = kind
        self._frame = frame
        self._height = height
        self._upload: Upload | None = None
        self._looked_at: Way | None = None
        """The way that was uploaded, or whose end it is."""
        self._sent: list[Point] = []
        """Points of the newest upload."""
        self._cut = False
        """The way goes on behind them."""
        self._due_ns = 0

    def forget(self) -> None:
        """The link is lost: nobody knows what the vehicle has."""
        self._upload, self._looked_at, self.accepted = None, None, False

    def cancel(self) -> list[MissionCancelled]:
        """There is no way any more, and what the vehicle has leads nowhere."""
        under_way = self._upload is not None
        self.forget()
        return [MissionCancelled()] if under_way else []

    def hear_asked(self, seq: int) -> None:
        if self._upload is not None:
            self._upload.hear_asked(seq)

    def hear_answered(self, result: int) -> None:
        if self._upload is not None:
            self._upload.hear_answered(result)

    def drive(
        self, way: Way, position: Position, place: Point, now_ns: int
    ) -> list[MissionCount | MissionItem | MissionCurrent | Tell]:
        """What is to be said now so that the vehicle has the rest of a way from where it is."""
        if self._upload is None and now_ns >= self._due_ns and self._is_news(way, place):
            left = rest(way.points_m, place, self._frame.grid.resolution_m)
            if self._looked_at is not way and self.accepted and not self._cut and is_end_of(left, self._sent):
                self._looked_at = way
            else:
                self._begin(way, left, position, now_ns)
        return self._go_on(now_ns)

    def _is_news(self, way: Way, place: Point) -> bool:
        if way is not self._looked_at:
            return True
        return self._cut and math.dist(place, self._sent[-1]) < math.dist(place, self._sent[0])

    def _begin(self, way: Way, left: list[Point], position: Position, now_ns: int) -> None:
        self._sent, self._cut = left[:MOST_POINTS], len(left) > MOST_POINTS
        self._looked_at = way
        self._due_ns = now_ns + _NEXT_NS
        self._upload = Upload(self._items(position))

    def _go_on(self, now_ns: int) -> list[MissionCount | MissionItem | MissionCurrent | Tell]:
        upload = self._upload
        if upload is None:
            return []
        said = upload.tick(now_ns)
        if said is not None:
            return [said]
        if upload.state is State.UNDER_WAY:
            return []
        self._upload = None
        if upload.state is State.ACCEPTED:
            self.accepted = True
            return [MissionCurrent(self._kind.first_item)]
        self._looked_at = None
        self._due_ns = now_ns + _AFTER_FAILURE_NS
        return [Tell(f"a mission of {len(upload.items)} items has failed: the vehicle {upload.why}")]

    def _items(self, position: Position) -> list[MissionItem]:
        frame, height_m = self._height.frame, self._height.above_m or 0.0
        last = len(self._sent) - 1
        stays = self._height.flies  # a plane flies home at the end of a mission, if nothing tells it to stay
        here = (position.lat_deg, position.lon_deg)
        items: list[tuple[int, tuple[float, float]]] = [(NAV_WAYPOINT, here)] * self._kind.first_item
        if self._height.flies and position.height_m < _ON_GROUND_M:
            items.append((NAV_TAKEOFF, here))
        for number, point in enumerate(self._sent):
            command = NAV_LOITER_UNLIM if stays and number == last else NAV_WAYPOINT
            items.append((command, self._frame.to_wgs84(*point)))
        return [
            MissionItem(seq, command, frame, *degrees, height_m, current=seq == self._kind.first_item)
            for seq, (command, degrees) in enumerate(items)
        ]
