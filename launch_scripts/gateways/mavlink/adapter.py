"""The core: what a vehicle and the swarm say, and time, become what is said to both. No network, no clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from launch_scripts.gateways.mavlink.autopilots import Kind, kind_of
from launch_scripts.gateways.mavlink.driver import Driver
from launch_scripts.gateways.mavlink.height import Above, flies, height_of
from launch_scripts.gateways.mavlink.messages import (
    GLOBAL_POSITION_INT,
    SET_MESSAGE_INTERVAL,
    Action,
    Beat,
    Command,
    CommandAnswered,
    Follow,
    Heartbeat,
    Incoming,
    ItemAsked,
    MissionAnswered,
    Position,
    Report,
    Tell,
    Unfollow,
    Warned,
    Way,
    Withdraw,
)
from swarm.client import ConfigError, Frame
from swarm.client.frame import Point
from swarm.clock import NS_PER_S

BEAT_NS = NS_PER_S
REPORT_NS = NS_PER_S // 10
_ASK_NS = 2 * NS_PER_S
_POSITIONS_US = 100_000
_SAY_AGAIN_NS = 60 * NS_PER_S
_MOST_SAID = 64
"""Sentences a minute; a vehicle's own take up a quarter at most."""
_WARN_NS = 4 * NS_PER_S
_MOST_M_PER_S = 340.0
Drive = Literal["mission", "guided"]


@dataclass(frozen=True)
class Wishes:
    """What is wanted of the vehicle.

    target      it follows routes to it; None: it is avoided, and no more
    drive       how it is driven there
    arm         it may be armed, and its mode changed
    altitude_m  of one that flies
    above       what the altitude is above
    lost_s      after so long without a heartbeat or a position the link counts as lost
    """

    target: str | None = None
    drive: Drive = "mission"
    arm: bool = False
    altitude_m: float | None = None
    above: Above = "home"
    lost_s: float = 5.0


class Adapter:
    """`hear`, `hear_way` and `hear_swarm` take what comes, as often as it comes; `tick` returns what is due.

    The vehicle is there once its heartbeat and a place on the terrain were heard, and is gone when either is silent
    for `lost_s` or it leaves the terrain. Gone means: its target is given up, nothing is said to it but heartbeats,
    and its body is withdrawn if it flies. One that drives stands where it was heard last, as far as anybody knows:
    its body stays.

    kind  what was first heard of it; None before
    """

    def __init__(self, frame: Frame, wishes: Wishes) -> None:
        self.kind: Kind | None = None
        self._frame = frame
        self._wishes = wishes
        self._beat: Beat | None = None
        self._position: Position | None = None
        self._place: Point | None = None
        """Of the newest position, in the terrain's frame; None outside of it."""
        self._beat_ns = self._position_ns = 0
        """When they were heard."""
        self._there = False
        self._reported: Position | None = None
        """The newest that was told to the swarm; None while the vehicle is nowhere for it."""
        self._way: Way | None = None
        self._swarm_up = True
        self._driver: Driver | None = None
        self._tells: list[str] = []
        self._said_ns: dict[str, int] = {}
        """Sentence -> when it was told last."""
        self._beat_due_ns = self._report_due_ns = self._ask_due_ns = self._warn_due_ns = 0

    # --- what comes -----------------------------------------------------------------------------------------------

    def hear(self, message: Incoming, now_ns: int) -> None:
        match message:
            case Beat():
                self._hear_beat(message, now_ns)
            case Position():
                self._hear_position(message, now_ns)
            case ItemAsked(seq=seq) if self._driver is not None:
                self._driver.hear_asked(seq)
            case MissionAnswered(result=result) if self._driver is not None:
                self._driver.hear_mission_answered(result)
            case CommandAnswered() if self._driver is not None:
                self._tells += self._driver.hear_command_answered(message)
            case Warned(text=text) if now_ns >= self._warn_due_ns:
                self._warn_due_ns = now_ns + _WARN_NS
                self._tells.append(f"the vehicle says: {text}")

    def hear_way(self, way: Way) -> None:
        """A route of the target that is followed."""
        self._way = way

    def hear_swarm(self, up: bool) -> None:
        """Whether the swarm can be heard."""
        if up != self._swarm_up:
            self._tells.append(
                "the swarm is back" if up else "the swarm is not heard: its routes are followed no more"
            )
        self._swarm_up = up

    def _hear_beat(self, beat: Beat, now_ns: int) -> None:
        kind = kind_of(beat)
        if self.kind is None:
            self.kind, self._driver = kind, self._driver_of(kind)
            armed = "armed" if beat.armed else "disarmed"
            self._tells.append(f"found {kind.name}, MAV_TYPE {beat.type}, {armed}")
        if kind != self.kind:
            self._tells.append("another kind of vehicle speaks under the same number: it is ignored")
            return
        self._beat, self._beat_ns = beat, now_ns

    def _driver_of(self, kind: Kind) -> Driver | None:
        wishes = self._wishes
        if wishes.target is None:
            return None
        height = height_of(kind, wishes.altitude_m, wishes.above)
        if isinstance(height, str):
            self._tells.append(f"the vehicle is not driven: {height}")
            return None
        if wishes.drive == "guided" and (kind.modes is None or kind.modes.guided is None):
            self._tells.append(
                f"the vehicle is not driven: {kind.name} has no guided mode here; give --drive mission"
            )
            return None
        return Driver(kind, self._frame, height, wishes.drive, wishes.arm)

    def _hear_position(self, position: Position, now_ns: int) -> None:
        try:
            place = self._frame.from_wgs84(position.lat_deg, position.lon_deg)
            self._frame.cell(*place)
        except ConfigError:
            self._place = None
            self._tells.append("the vehicle is outside the terrain")
        else:
            self._place = place
        self._position, self._position_ns = position, now_ns

    # --- what is due ----------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[Action]:
        """What is due now, in order. To be called twenty times a second at least."""
        actions: list[Action] = []
        if now_ns >= self._beat_due_ns:
            self._beat_due_ns = now_ns + BEAT_NS
            actions.append(Heartbeat())
        actions += self._ask_positions(now_ns)
        actions += self._come_or_go(now_ns)
        if self._there and self._beat is not None and self._position is not None and self._place is not None:
            actions += self._report(self._position, self._place, now_ns)
            if self._driver is not None:
                way = self._way if self._swarm_up else None
                actions += self._driver.tick(way, self._beat, self._position, self._place, now_ns)
        return self._told(actions, now_ns)

    def stop(self, now_ns: int) -> list[Action]:
        """The last words to the vehicle: it is to stop, as nobody avoids it any more."""
        self._swarm_up = False
        if not self._there or self._driver is None or self._beat is None or self._position is None:
            return []
        return self._driver.hold(self._beat, self._position, now_ns, last=True)

    def _ask_positions(self, now_ns: int) -> list[Action]:
        silent = self._position is None or now_ns - self._position_ns > NS_PER_S
        if self._beat is None or not silent or now_ns < self._ask_due_ns:
            return []
        self._ask_due_ns = now_ns + _ASK_NS
        return [Command(SET_MESSAGE_INTERVAL, (GLOBAL_POSITION_INT, _POSITIONS_US))]

    def _come_or_go(self, now_ns: int) -> list[Action]:
        why = self._why_gone(now_ns)
        if not why and not self._there:
            self._there = True
            self._tells.append("the vehicle is in the swarm")
            return []
        if not why or not self._there:
            return []
        self._there = False
        self._tells.append(f"{why}: the vehicle is left to its own fail-safe")
        actions: list[Action] = []
        if self._driver is not None:
            self._driver.forget()
            self._way = None
            actions.append(Unfollow())
        if self._place is None or (self.kind is not None and flies(self.kind, self._wishes.altitude_m)):
            actions.append(Withdraw())
        elif self._position is not None:
            # Where to it may have gone nobody knows.
            actions.append(Report(*self._place, None, self._speed(self._position)))
        # It is back with a place of its own: another vehicle may be the next to speak, and be somewhere else.
        self._position = self._reported = None
        return actions

    def _why_gone(self, now_ns: int) -> str:
        """Why the vehicle is not there; empty if it is."""
        lost_ns = int(self._wishes.lost_s * NS_PER_S)
        if self._beat is None or now_ns - self._beat_ns > lost_ns:
            return f"no heartbeat for {self._wishes.lost_s:g} s"
        if self._position is None or now_ns - self._position_ns > lost_ns:
            return f"no position for {self._wishes.lost_s:g} s"
        return "" if self._place is not None else "it is outside the terrain"

    def _report(self, position: Position, place: Point, now_ns: int) -> list[Action]:
        if position is self._reported or now_ns < self._report_due_ns:
            return []
        self._report_due_ns = now_ns + REPORT_NS
        first, self._reported = self._reported is None, position
        actions: list[Action] = [Report(*place, position.heading_rad, self._speed(position))]
        if first and self._driver is not None and self._wishes.target is not None:
            actions.append(Follow(self._wishes.target))
        return actions

    def _speed(self, position: Position) -> float:
        return min(position.speed_m_per_s, _MOST_M_PER_S)

    def _told(self, actions: list[Action], now_ns: int) -> list[Action]:
        """With each sentence of the last minute told once."""
        sentences = [*self._tells, *(each.sentence for each in actions if isinstance(each, Tell))]
        self._tells = []
        told: list[Action] = [each for each in actions if not isinstance(each, Tell)]
        if sentences:
            self._said_ns = {each: ns for each, ns in self._said_ns.items() if now_ns - ns < _SAY_AGAIN_NS}
        for sentence in sentences:
            if sentence not in self._said_ns and len(self._said_ns) < _MOST_SAID:
                self._said_ns[sentence] = now_ns
                told.append(Tell(sentence))
        return told
