"""The guidance of a vehicle along the swarm's routes, by missions or setpoints.

A guide is chosen once by `guidance_of`. It takes the newest route and the vehicle's place, and returns messages.
Without a way that leads somewhere the vehicle holds, as far as that is ours: by setpoints it gets one where it is,
or none any more. A mission is driven to its end, unless the vehicle's mode becomes hold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from launch_scripts.gateways.mavlink import mavlink_codec as codec
from launch_scripts.gateways.mavlink.arming import ARDUPILOT, PX4, Arming, Kind
from swarm.client import ConfigError, Frame
from swarm.client.route import along, between
from swarm.client.terrain_frame import Point
from swarm.clock import NS_PER_S

MOST_POINTS = 60
"""Limit of one mission: further points are uploaded when half of it is driven. Uploads take a round trip an
item."""
_STRAIGHT = 1e-9
"""Sine of the angle up to which three places lie on a line: rounding alone."""
_NEXT_NS = 3 * NS_PER_S
"""From one mission to the next: a target that moves changes its routes several times a second."""
_AFTER_FAILURE_NS = 5 * NS_PER_S
"""Pause after a mission that a vehicle did not take. Chosen, not measured."""
_ON_GROUND_M = 2.0
"""Height over home below which an aircraft counts as on the ground. Chosen, not measured."""
RETRY_NS = NS_PER_S * 3 // 2
MOST_TRIES = 5
"""The protocol demands both: a word is said again after 1.5 s without an answer, five times in all."""
_MOST_ASKED = 8
"""A vehicle may ask so often for each item, on average: a broken one does not keep us at one mission for ever."""
_STREAM_NS = NS_PER_S // 10
"""PX4 leaves offboard below two setpoints a second."""
_STREAMED_FIRST_NS = NS_PER_S
"""PX4 takes offboard only if it has had setpoints for a second."""
_REPEAT_NS = NS_PER_S
"""ArduPilot drives to the last setpoint; it is said again, as any message may be lost."""
_HOLDS = 3
"""Repetitions of the command to hold."""


@dataclass(frozen=True)
class Options:
    """Requested state of the vehicle.

    target      id of a target, or a place, to which it follows routes; None: it is avoided, and no more
    drive       how it is driven there
    arm         it may be armed, and its mode changed
    altitude_m  of one that flies
    above       what the altitude is above
    lost_s      after this time without a heartbeat or a position the link counts as lost
    id          who it is in the swarm; None: `mav` and its number on the link
    group, radius_m, vehicle_class  as `Swarm.vehicle` has them
    """

    target: str | None = None
    drive: Literal["mission", "guided"] = "mission"
    arm: bool = False
    altitude_m: float | None = None
    above: Literal["home", "terrain"] = "home"
    lost_s: float = 5.0
    id: str | None = None
    group: str = "all"
    radius_m: float = 1.0
    vehicle_class: str = "ground"


Way = tuple[Point, ...]
"""A route of the swarm: (x_m, y_m) in the terrain's frame, in driving order; empty: it leads nowhere."""


def flies(kind: Kind, altitude_m: float | None) -> bool:
    """Returns True if a vehicle flies: one of unknown type does if an altitude is given."""
    return altitude_m is not None if kind.flies is None else kind.flies


def guidance_of(kind: Kind, frame: Frame, options: Options) -> tuple[Guide, Arming | None]:
    """Returns what guides a kind of vehicle by the options, and its arming; None if another controller arms it.
    Raises ConfigError if it cannot be driven so."""
    aloft, guided, modes = flies(kind, options.altitude_m), options.drive == "guided", kind.modes
    height_m = options.altitude_m if aloft else None
    if aloft and height_m is None:
        raise ConfigError("it flies without an altitude: give --altitude M, as the swarm publishes no heights")
    above = codec.ABOVE_TERRAIN if aloft and options.above == "terrain" else codec.ABOVE_HOME
    if above == codec.ABOVE_TERRAIN and kind.make != ARDUPILOT:
        raise ConfigError(f"{kind.name} takes no heights above terrain: give --above home")
    if guided and (modes is None or modes.guided is None):
        raise ConfigError(f"{kind.name} has no guided mode here; give --drive mission")
    guide = (Setpoints if guided else Missions)(kind, frame, above, height_m)
    if not options.arm:
        return guide, None
    mode = None if modes is None else modes.guided if guided else modes.mission
    # PX4 starts its missions by their mode, and climbs to the height of its setpoints.
    takeoff_m = height_m if guided and not kind.streams else None
    return guide, Arming(kind, mode, starts=kind.make != PX4 and not guided, takeoff_m=takeoff_m)


class _Guide:
    """Common part of missions and setpoints.

    above     MAVLink frame constant for `height_m`: above home or above terrain
    height_m  None: the vehicle stays on its ground
    """

    def __init__(self, kind: Kind, frame: Frame, above: int, height_m: float | None) -> None:
        self._kind, self._frame, self._above, self._height_m = kind, frame, above, height_m


# --- missions -----------------------------------------------------------------------------------------------------


class Upload:
    """One mission on its way to a vehicle: MISSION_COUNT until it asks, then the items that it asks for, until it
    answers.

    accepted  the vehicle has it all
    why       it has failed: half a sentence; empty while it has not
    """

    def __init__(self, items: Sequence[codec.MissionItem]) -> None:
        self.items = items
        self.accepted = False
        self.why = ""
        self._next: codec.MissionCount | codec.MissionItem = codec.MissionCount(len(items))
        """The next message, or the last one."""
        self._due_ns: int | None = None
        """Time when it is said (again); None: at once."""
        self._tries = self._asked = 0

    def on_mission_message(self, message: codec.ItemAsked | codec.MissionAnswered) -> None:
        """Takes in that the vehicle asks for an item, or answers to all."""
        if self.accepted or self.why:
            return
        match message:
            case codec.ItemAsked(seq=seq):
                self._asked += 1
                if not 0 <= seq < len(self.items):
                    return  # of a mission before; it asks again
                if self._asked > _MOST_ASKED * len(self.items):
                    self.why = f"asked {self._asked} times for {len(self.items)} items"
                self._next, self._due_ns, self._tries = self.items[seq], None, 0
            case codec.MissionAnswered(result=result) if result != codec.ACCEPTED:
                self.why = f"refused it with MAV_MISSION_RESULT {result}"
            case codec.MissionAnswered():
                # One of a mission before, while the last item of this one was not asked for, says nothing of it.
                self.accepted = isinstance(self._next, codec.MissionItem) and self._next.seq == len(self.items) - 1

    def tick(self, now_ns: int) -> codec.MissionCount | codec.MissionItem | None:
        """Returns the messages to send now."""
        if self.accepted or self.why or (self._due_ns is not None and now_ns < self._due_ns):
            return None
        if self._tries == MOST_TRIES:
            self.why = f"did not answer {MOST_TRIES} times"
            return None
        self._tries += 1
        self._due_ns = now_ns + RETRY_NS
        return self._next


class Missions(_Guide):
    """Uploads the rest of a way as a mission, one at a time, whenever the way has changed."""

    _upload: Upload | None = None
    """The mission on its way to the vehicle."""
    _seen: Way = ()
    """The way that was uploaded."""
    _sent: Sequence[Point] = ()
    """Points of the newest upload."""
    _cut = False
    """The way goes on behind them."""
    _accepted = False
    """The vehicle has a mission that leads along a way."""
    _due_ns = 0

    def forget(self) -> None:
        """Forgets the vehicle's mission after the link was lost."""
        self._upload, self._seen, self._accepted = None, (), False

    def on_mission_message(self, message: codec.ItemAsked | codec.MissionAnswered) -> None:
        """Takes in that the vehicle asks for an item, or answers."""
        if self._upload is not None:
            self._upload.on_mission_message(message)

    def ready(self, now_ns: int) -> bool:
        """Returns True if the vehicle may be brought into the mode in which it follows our commands."""
        return self._accepted

    def stay(self, position: codec.Position, now_ns: int) -> Sequence[codec.Outgoing]:
        """Returns the messages to send now that there is no route any more."""
        under_way = self._upload is not None
        self.forget()
        return [codec.MissionCancelled()] if under_way else []

    def lead(self, way: Way, position: codec.Position, place: Point, now_ns: int) -> Sequence[codec.Outgoing | str]:
        """Returns the messages that make the vehicle follow a route, with sentences for people."""
        upload = self._upload
        if upload is None:
            if now_ns < self._due_ns or not self._is_news(way, place):
                return []
            left = rest(way, place, self._frame.grid.resolution_m)
            self._seen, self._sent, self._cut = way, left[:MOST_POINTS], len(left) > MOST_POINTS
            self._due_ns = now_ns + _NEXT_NS
            upload = self._upload = Upload(self._items(position))
        message = upload.tick(now_ns)
        if not upload.accepted and not upload.why:
            return [] if message is None else [message]
        self._upload = None
        if upload.accepted:
            self._accepted = True
            return [codec.MissionCurrent(self._kind.first_item)]
        self._seen = ()
        self._due_ns = now_ns + _AFTER_FAILURE_NS
        return [f"a mission of {len(upload.items)} items has failed: the vehicle {upload.why}"]

    def _is_news(self, way: Way, place: Point) -> bool:
        if way != self._seen:
            return True
        return self._cut and math.dist(place, self._sent[-1]) < math.dist(place, self._sent[0])

    def _items(self, position: codec.Position) -> list[codec.MissionItem]:
        here, first = (position.lat_deg, position.lon_deg), self._kind.first_item
        items = [(codec.NAV_WAYPOINT, here)] * first
        items += [(codec.NAV_WAYPOINT, self._frame.to_wgs84(*point)) for point in self._sent]
        if self._height_m is not None:
            # A plane flies home at the end of a mission, if nothing tells it to stay.
            items[-1] = codec.NAV_LOITER_UNLIM, items[-1][1]
            if position.height_m < _ON_GROUND_M:
                items.insert(first, (codec.NAV_TAKEOFF, here))
        return [
            codec.MissionItem(seq, command, self._above, *degrees, self._height_m or 0.0, current=seq == first)
            for seq, (command, degrees) in enumerate(items)
        ]


# --- setpoints ----------------------------------------------------------------------------------------------------


class Setpoints(_Guide):
    """Puts a setpoint at the next turn of the way, streamed where the autopilot wants a stream. Without a way the
    stream ends (PX4 leaves offboard by its own fail-safe), or the vehicle gets a setpoint where it is."""

    _began_ns: int | None = None
    """Time when the stream began; None while there is none."""
    _due_ns = 0
    _goal: Point | None = None
    _holds_left = 0
    _hold_at = (0.0, 0.0)
    """(latitude, longitude)"""

    def forget(self) -> None:
        """Same as for missions."""
        self._goal, self._began_ns, self._holds_left = None, None, 0

    def ready(self, now_ns: int) -> bool:
        streamed = self._began_ns is not None and now_ns - self._began_ns >= _STREAMED_FIRST_NS
        return not self._kind.streams or streamed

    def lead(self, way: Way, position: codec.Position, place: Point, now_ns: int) -> Sequence[codec.Outgoing | str]:
        near_m = self._frame.grid.resolution_m / 2
        left = rest(way, place, near_m)
        # The first lies half a cell ahead on the line; the vehicle drives straight to the turn behind it.
        goal = next((point for point in left[1:] if math.dist(point, place) > near_m), left[-1])
        if goal == self._goal and now_ns < self._due_ns:
            return []
        self._goal = goal
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        self._due_ns = now_ns + (_STREAM_NS if self._kind.streams else _REPEAT_NS)
        self._holds_left = 0 if self._kind.streams else _HOLDS
        return [codec.Setpoint(self._above, *self._frame.to_wgs84(*goal), self._height_m)]

    def stay(self, position: codec.Position, now_ns: int) -> Sequence[codec.Outgoing]:
        if self._goal is not None:
            self._goal, self._began_ns, self._due_ns = None, None, 0
            self._hold_at = (position.lat_deg, position.lon_deg)
        if not self._holds_left or now_ns < self._due_ns:
            return []
        self._holds_left -= 1
        self._due_ns = now_ns + _REPEAT_NS
        return [codec.Setpoint(self._above, *self._hold_at, self._height_m)]


Guide = Missions | Setpoints


# --- the few points of a route that an autopilot gets -------------------------------------------------------------


def turns(points: Sequence[Point]) -> list[Point]:
    """Returns the points in which a line turns, with its ends, each once: they lead over the same ground."""
    kept: list[Point] = []
    for point in points:
        if kept and math.dist(kept[-1], point) == 0:
            continue
        if len(kept) > 1 and _straight(kept[-2], kept[-1], point):
            kept.pop()
        kept.append(point)
    return kept


def rest(points: Sequence[Point], place: Point, lead_m: float) -> list[Point]:
    """Returns the remainder of a line from a location: the point of it that lies `lead_m` after the nearest, and
    the turns behind that. Its end at least, unless the line is empty."""
    if len(points) < 2:
        return list(points)
    at, share = along(points, place, lead_m)
    if at + 2 == len(points) and share == 1.0:
        return [points[-1]]
    return turns([between(points[at], points[at + 1], share), *points[at + 1 :]])


def _straight(a: Point, b: Point, c: Point) -> bool:
    ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1]
    long = math.hypot(ux, uy) * math.hypot(vx, vy)
    return abs(ux * vy - uy * vx) <= _STRAIGHT * long and ux * vx + uy * vy > 0
