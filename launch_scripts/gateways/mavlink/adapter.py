"""The core: turns messages of a vehicle and the swarm, and time, into messages to both. No network, no clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress

from msgspec import Struct

from launch_scripts.gateways.mavlink import guidance
from launch_scripts.gateways.mavlink import mavlink_codec as codec
from launch_scripts.gateways.mavlink.arming import Arming, Kind, kind_of
from swarm.client import ConfigError, Frame
from swarm.client.terrain_frame import Point
from swarm.clock import NS_PER_S

BEAT_NS = NS_PER_S
REPORT_NS = NS_PER_S // 10
"""Ten reports a second, as `vehicles.tick_hz` of agents."""
_ASK_NS = 2 * NS_PER_S
"""Interval of requests for positions, while none come. Chosen, not measured."""
_POSITIONS_US = 100_000
"""Interval of positions that is asked for, us: that of reports."""
_SAY_AGAIN_NS = 60 * NS_PER_S
"""The minute of `_MOST_SENTENCES`."""
_MOST_SENTENCES = 64
"""Sentences a minute; a vehicle's own take up a quarter at most."""
_WARN_NS = 4 * NS_PER_S
"""Texts of the vehicle are passed on this often at most: 15 a minute, a quarter of `_MOST_SENTENCES`."""
_MOST_M_PER_S = 340.0
"""The speed of sound, as `MOST_M_PER_S` of obstacles: hosts refuse the report of a faster one."""


class Report(Struct, frozen=True):
    """Position of the vehicle, as `Vehicle.at` has it."""

    x_m: float
    y_m: float
    heading_rad: float | None
    speed_m_per_s: float


class Withdraw(Struct, frozen=True):
    """The vehicle is not known to be anywhere: `Vehicle.leave`."""


class Follow(Struct, frozen=True):
    """The vehicle follows a target from now on: `Vehicle.follow`."""

    target: str


class Unfollow(Struct, frozen=True):
    """The target is given up."""


Action = codec.Outgoing | Report | Withdraw | Follow | Unfollow | str
"""A text is a sentence for the log."""


class Adapter:
    """`hear`, `hear_way` and `hear_swarm` take messages at any rate; `tick` returns due actions.

    The vehicle exists once its heartbeat and a position on the terrain were received. It is lost when either is
    missing for `lost_s` or it leaves the terrain. Gone means: its target is given up, nothing is said to it but
    heartbeats, and its report as an obstacle is withdrawn if it flies. One that drives stays an obstacle where it
    was heard last.

    kind  its type and make, from its first heartbeat; None before
    """

    def __init__(self, frame: Frame, options: guidance.Options) -> None:
        self.kind: Kind | None = None
        self._frame = frame
        self._options = options
        self._beat: codec.Beat | None = None
        self._at: tuple[codec.Position, Point] | None = None
        """The newest position, and its place in the terrain's frame; None outside of it."""
        self._beat_ns = 0
        self._position_ns: int | None = None
        """Time of the last position; None before the first, and again once the vehicle is lost."""
        self._there = False
        self._reported: codec.Position | None = None
        """Newest report to the swarm; None while the vehicle has no position for it."""
        self._way: guidance.Way = ()
        self._swarm_up = True
        self._guide: guidance.Guide | None = None
        """None: the vehicle is not driven."""
        self._arming: Arming | None = None
        """None: another controller arms the vehicle and sets its mode."""
        self._unsent: list[str] = []
        self._sent_this_minute: set[str] = set()
        """Sentences of this minute."""
        self._due_ns = Counter[str]()
        """Time when a thing that is done once a period is due again."""

    # --- what comes -----------------------------------------------------------------------------------------------

    def on_message(self, message: codec.Incoming, now_ns: int) -> None:
        """Takes in a message of the vehicle."""
        match message:
            case codec.Beat():
                self._hear_beat(message, now_ns)
            case codec.Position():
                self._hear_position(message, now_ns)
            case codec.Warned(text=text) if self._is_due("warning", _WARN_NS, now_ns):
                self._unsent.append(f"the vehicle says: {text}")
            case codec.CommandAnswered() if self._arming is not None:
                self._unsent += self._arming.on_command_answer(message)
            case codec.ItemAsked() | codec.MissionAnswered() if isinstance(self._guide, guidance.Missions):
                self._guide.on_mission_message(message)

    def hear_way(self, way: guidance.Way) -> None:
        """Takes in a route to the target that is followed."""
        self._way = way

    def hear_swarm(self, up: bool) -> None:
        """Takes in whether the swarm can be heard."""
        if up != self._swarm_up:
            lost = "the swarm is silent: its routes are followed no more"
            self._unsent.append("the swarm is back" if up else lost)
        self._swarm_up = up

    def _hear_beat(self, beat: codec.Beat, now_ns: int) -> None:
        kind = kind_of(beat)
        if self.kind is None:
            self.kind = kind
            armed = "armed" if beat.armed else "disarmed"
            self._unsent.append(f"found {kind.name}, MAV_TYPE {beat.type}, {armed}")
            if self._options.target is not None:
                try:
                    self._guide, self._arming = guidance.guidance_of(kind, self._frame, self._options)
                except ConfigError as error:
                    self._unsent.append(f"the vehicle is not driven: {error}")
        if kind != self.kind:
            self._unsent.append("another kind of vehicle speaks under the same number: it is ignored")
            return
        self._beat, self._beat_ns = beat, now_ns

    def _hear_position(self, position: codec.Position, now_ns: int) -> None:
        self._at, self._position_ns = None, now_ns
        with suppress(ConfigError):  # it is outside the terrain
            place = self._frame.from_wgs84(position.lat_deg, position.lon_deg)
            self._frame.cell(*place)
            self._at = position, place

    # --- what is due ----------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[Action]:
        """Returns due actions, in order. To be called twenty times a second at least."""
        actions: list[Action] = []
        if self._is_due("heartbeat", BEAT_NS, now_ns):
            actions.append(codec.Heartbeat())
        silent = self._position_ns is None or now_ns - self._position_ns > NS_PER_S
        if self._beat is not None and silent and self._is_due("question", _ASK_NS, now_ns):
            actions.append(codec.Command(codec.SET_MESSAGE_INTERVAL, (codec.GLOBAL_POSITION_INT, _POSITIONS_US)))
        actions += self._come_or_go(now_ns)
        if self._there:
            actions += self._report(now_ns)
            actions += self._drive(now_ns)
            if self._arming is not None and self._arming.why:
                self._unsent.append(f"the vehicle's mode and motors are left alone from now on: {self._arming.why}")
                self._arming = None
        self._unsent += [each for each in actions if isinstance(each, str)]
        return [*(each for each in actions if not isinstance(each, str)), *self._news(now_ns)]

    def stop(self, now_ns: int) -> list[Action]:
        """Returns the final commands to the vehicle: it is to stop, as other vehicles avoid it no more."""
        self._swarm_up = False
        return self._drive(now_ns, last=True) if self._there else []

    def _drive(self, now_ns: int, *, last: bool = False) -> list[Action]:
        """Returns what lets the vehicle follow the way, or stay where it is without one, as far as that is ours.

        last  nothing is said after it
        """
        guide, arming, beat = self._guide, self._arming, self._beat
        if guide is None or beat is None or self._at is None:
            return []
        position, place = self._at
        messages: Sequence[Action]
        commands: Sequence[Action] = []
        if self._way and self._swarm_up:
            messages = guide.lead(self._way, position, place, now_ns)
            if arming is not None and guide.ready(now_ns):
                commands = arming.drive(beat, position.height_m, now_ns)
        else:
            messages = guide.stay(position, now_ns)
            if arming is not None:
                commands = arming.hold(beat, now_ns, last=last)
        return [*messages, *commands]

    def _come_or_go(self, now_ns: int) -> list[Action]:
        why = self._why_gone(now_ns)
        if self._there == (not why):
            return []
        self._there = not why
        if not why:
            self._unsent.append("the vehicle is in the swarm")
            return []
        self._unsent.append(f"{why}: the vehicle is left to its own fail-safe")
        actions: list[Action] = []
        if self._guide is not None:
            self._guide.forget()
            self._way = ()
            actions.append(Unfollow())
        if self._at is None or (self.kind is not None and guidance.flies(self.kind, self._options.altitude_m)):
            actions.append(Withdraw())
        else:
            # Its destination is then unknown.
            actions.append(Report(*self._at[1], None, _speed(self._at[0])))
        # It is back with a place of its own: another vehicle may be the next to speak, and be somewhere else.
        self._at = self._position_ns = self._reported = None
        return actions

    def _why_gone(self, now_ns: int) -> str:
        """Returns why the vehicle is not there; empty if it is."""
        lost_ns = int(self._options.lost_s * NS_PER_S)
        if self._beat is None or now_ns - self._beat_ns > lost_ns:
            return f"no heartbeat for {self._options.lost_s:g} s"
        if self._position_ns is None or now_ns - self._position_ns > lost_ns:
            return f"no position for {self._options.lost_s:g} s"
        return "" if self._at is not None else "it is outside the terrain"

    def _report(self, now_ns: int) -> list[Action]:
        if self._at is None or self._at[0] is self._reported or not self._is_due("report", REPORT_NS, now_ns):
            return []
        position, place = self._at
        first, self._reported = self._reported is None, position
        actions: list[Action] = [Report(*place, position.heading_rad, _speed(position))]
        if first and self._guide is not None and self._options.target is not None:
            actions.append(Follow(self._options.target))
        return actions

    def _news(self, now_ns: int) -> list[str]:
        """Returns new sentences for people, each once a minute."""
        if self._is_due("minute", _SAY_AGAIN_NS, now_ns):
            self._sent_this_minute.clear()
        new = [each for each in dict.fromkeys(self._unsent) if each not in self._sent_this_minute]
        sentences = new[: _MOST_SENTENCES - len(self._sent_this_minute)]
        self._sent_this_minute.update(sentences)
        self._unsent.clear()
        return sentences

    def _is_due(self, what: str, every_ns: int, now_ns: int) -> bool:
        """Returns True once in a period."""
        due = now_ns >= self._due_ns[what]
        if due:
            self._due_ns[what] = now_ns + every_ns
        return due


def _speed(position: codec.Position) -> float:
    return min(position.speed_m_per_s, _MOST_M_PER_S)
