"""Arming and modes, with `--arm` only: command authority is taken once, and any other controller that takes it
keeps it.

Differences between autopilots are here, too: numbers of modes, first items of missions, and required streams.
Sources: px4_custom_mode.h of PX4, mode.h of ArduCopter, Rover, ArduPlane and ArduSub, and their pages on guided and
offboard modes.
"""

from __future__ import annotations

from dataclasses import dataclass

from launch_scripts.gateways.mavlink import mavlink_codec as codec
from swarm.clock import NS_PER_S

ARDUPILOT, PX4 = 3, 12
"""MAV_AUTOPILOT of MAVLink's common messages."""
_UNKNOWN_TYPE = 0
_DRIVES = frozenset({10, 11})
"""MAV_TYPE of rovers and boats."""
_PLANES = frozenset({1, *range(19, 26)})
"""Fixed wings, and what takes off upright and flies on wings."""
_COPTERS = frozenset({2, 3, 4, 13, 14, 15, 29, 35})

AGAIN_NS = 2 * NS_PER_S
"""Between commands: a heartbeat that shows their effect comes once a second."""
MOST_COMMANDS = 10
"""In a row without effect. A vehicle that refuses has a reason, which it tells in its own words."""
_MOST_STARTS = 3
"""Some autopilots begin their mission without, and never answer."""
_OURS = {
    codec.ARM_DISARM: "be armed",
    codec.DO_SET_MODE: "change its mode",
    codec.MISSION_START: "start",
    codec.NAV_TAKEOFF: "take off",
}
"""Commands whose refusal a person wants to hear of."""


@dataclass(frozen=True)
class Modes:
    """The autopilot's own numbers. `arms` is the mode in which it is armed; None: in that in which it drives."""

    mission: int
    guided: int | None
    hold: int
    arms: int | None = None


@dataclass(frozen=True)
class Kind:
    """Command sequence of one make of vehicle.

    make   MAV_AUTOPILOT
    flies  by its MAV_TYPE; None if that says nothing
    modes  None: it has none that we know, and none is ever set
    """

    make: int
    flies: bool | None
    modes: Modes | None

    @property
    def name(self) -> str:
        return _NAMES.get(self.make, "an autopilot without modes that are known here")

    @property
    def first_item(self) -> int:
        """First item of a mission: before it ArduPilot has home."""
        return int(self.make == ARDUPILOT)

    @property
    def streams(self) -> bool:
        """Guided needs ten setpoints a second, and ends without them."""
        return self.make == PX4

    def set_mode(self, mode: int) -> codec.Command:
        """DO_SET_MODE: PX4 has main and sub-mode in parameters of their own."""
        if self.make == PX4:
            return codec.Command(codec.DO_SET_MODE, (1, mode >> 16 & 0xFF, mode >> 24 & 0xFF))
        return codec.Command(codec.DO_SET_MODE, (1, mode))


_NAMES = {PX4: "PX4", ARDUPILOT: "ArduPilot"}
_MODES = (
    (PX4, frozenset(range(256)), Modes(mission=4 << 16 | 4 << 24, guided=6 << 16, hold=4 << 16 | 3 << 24)),
    (ARDUPILOT, _DRIVES, Modes(mission=10, guided=15, hold=15, arms=15)),
    (ARDUPILOT, _COPTERS, Modes(mission=3, guided=4, hold=4, arms=4)),
    (ARDUPILOT, _PLANES, Modes(mission=10, guided=None, hold=15, arms=15)),
)
"""MAV_AUTOPILOT, MAV_TYPE of vehicles, and their modes."""


def kind_of(beat: codec.Beat) -> Kind:
    """The kind of vehicle which a heartbeat tells of."""
    flies = None if beat.type == _UNKNOWN_TYPE else beat.type not in _DRIVES
    modes = next((of for make, types, of in _MODES if make == beat.autopilot and beat.type in types), None)
    return Kind(beat.autopilot, flies, modes)


class Arming:
    """Brings a vehicle into the mode in which it drives for us, armed, and into hold while there is no way.

    Once it has seen the vehicle armed and driving, a mode that it has not set, or a vehicle that is disarmed, is
    the command of another (a pilot, or a fail-safe): from then on it commands nothing.

    mode       in which the vehicle drives for us; None if it has no modes
    takeoff_m  height for take-off; None: no take-off, or by its mission
    why        it commands nothing any more: half a sentence; empty while it does
    """

    def __init__(self, kind: Kind, mode: int | None, *, starts: bool, takeoff_m: float | None) -> None:
        self.mode = mode
        self.takeoff_m = takeoff_m
        self.why = ""
        self._kind = kind
        self._starts_left = _MOST_STARTS if starts else 0
        """Times that MISSION_START is still said."""
        self._taken = False
        self._holding = False
        """True if the last command was hold, not driving."""
        self._held = False
        """Hold was commanded since driving was seen."""
        self._commands = 0
        """Sent since one had an effect."""
        self._due_ns = 0

    def drive(self, beat: codec.Beat, height_m: float, now_ns: int) -> list[codec.Command]:
        """Returns the next command that brings it to driving; none if it drives, or none is due."""
        self._check_taken(beat, now_ns)
        if self.why or now_ns < self._due_ns:
            return []
        self._holding = False
        return self._send(self._wanted(beat, height_m), now_ns)

    def hold(self, beat: codec.Beat, now_ns: int, *, last: bool = False) -> list[codec.Command]:
        """Returns the command that lets it stand, where it drives for us.

        last  it is said now, if it was said before or not
        """
        self._check_taken(beat, now_ns)
        modes = self._kind.modes
        if self.why or not self._taken or modes is None or beat.mode != self.mode or self.mode == modes.hold:
            return []
        if self._holding and now_ns < self._due_ns and not last:
            return []
        self._holding = self._held = True
        return self._send(self._kind.set_mode(modes.hold), now_ns)

    def on_command_answer(self, answer: codec.CommandAnswered) -> list[str]:
        """Takes in what the vehicle says to a command. Returns sentences about it."""
        if answer.result == codec.ACCEPTED:
            if answer.command == codec.MISSION_START:
                self._starts_left = 0
            if answer.command == codec.NAV_TAKEOFF:
                self.takeoff_m = None
        elif answer.result != codec.IN_PROGRESS and answer.command in _OURS:
            return [f"the vehicle refuses to {_OURS[answer.command]}: MAV_RESULT {answer.result}"]
        return []

    def _check_taken(self, beat: codec.Beat, now_ns: int) -> None:
        """Checks whether the vehicle still is as we left it."""
        modes = self._kind.modes
        if self.why:
            return
        if beat.armed and (self.mode is None or beat.mode == self.mode):
            self._taken = True
            if not self._holding:
                self._held = False
        elif not self._taken:
            return
        elif not beat.armed:
            self.why = "it was disarmed, and not by us"
        elif modes is not None and beat.mode == modes.hold and self._held:
            if self._holding:
                self._commands = 0
        elif now_ns >= self._due_ns:  # before that a command of ours may still be under way
            self.why = f"its mode was changed to {beat.mode}, and not by us"

    def _wanted(self, beat: codec.Beat, height_m: float) -> codec.Command | None:
        modes = self._kind.modes
        if not beat.armed:
            arms = self.mode if modes is None or modes.arms is None else modes.arms
            return codec.Command(codec.ARM_DISARM, (1,)) if arms in (None, beat.mode) else self._kind.set_mode(arms)
        if self.mode in (None, beat.mode) and self.takeoff_m is not None and height_m < 1.0:
            return codec.Command(codec.NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, self.takeoff_m))
        if self.mode is not None and beat.mode != self.mode:
            return self._kind.set_mode(self.mode)
        if self._starts_left:
            self._starts_left -= 1
            self._commands = 0
            return codec.Command(codec.MISSION_START)
        return None

    def _send(self, command: codec.Command | None, now_ns: int) -> list[codec.Command]:
        if command is None:
            self._commands = 0
            return []
        if self._commands == MOST_COMMANDS:
            self.why = f"it has not obeyed {MOST_COMMANDS} commands"
            return []
        self._commands += 1
        self._due_ns = now_ns + AGAIN_NS
        return [command]
