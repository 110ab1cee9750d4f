"""Arming and modes, with `--arm` only: the wheel is taken once, and whoever takes it from us keeps it."""

from __future__ import annotations

from launch_scripts.gateways.mavlink.autopilots import Kind
from launch_scripts.gateways.mavlink.messages import ARM_DISARM, MISSION_START, NAV_TAKEOFF, Beat, Command
from swarm.clock import NS_PER_S

AGAIN_NS = 2 * NS_PER_S
"""Between commands: a heartbeat that shows their effect comes once a second."""
MOST_COMMANDS = 10
"""In a row without effect. A vehicle that refuses has a reason, which it tells in its own words."""

_MOST_STARTS = 3
"""Some autopilots begin their mission without, and never answer."""


class Wheel:
    """Brings a vehicle into the mode in which it drives for us, armed, and into hold while there is no way.

    Once it has seen the vehicle armed and driving, a mode that it has not set, or a vehicle that is disarmed, is
    somebody's word (a pilot's, or a fail-safe's): from then on it commands nothing.

    mode      in which the vehicle drives for us; None if it has no modes
    takeoff_m  height to which it is told to take off; None: it is not, or its mission says so
    why       it commands nothing any more: half a sentence; empty while it does
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
        """What was commanded last is hold, not driving."""
        self._held = False
        """Hold was commanded since driving was seen."""
        self._commands = 0
        """Sent since one had an effect."""
        self._due_ns = 0

    def drive(self, beat: Beat, height_m: float, now_ns: int) -> Command | None:
        """The next command that brings it to driving; None if it drives, or none is due."""
        self._look(beat, now_ns)
        if self.why or now_ns < self._due_ns:
            return None
        self._holding = False
        return self._send(self._wanted(beat, height_m), now_ns)

    def hold(self, beat: Beat, now_ns: int, *, last: bool = False) -> Command | None:
        """The command that lets it stand, where it drives for us.

        last  it is said now, if it was said before or not
        """
        self._look(beat, now_ns)
        modes = self._kind.modes
        if self.why or not self._taken or modes is None or beat.mode != self.mode or self.mode == modes.hold:
            return None
        if self._holding and now_ns < self._due_ns and not last:
            return None
        self._holding = self._held = True
        return self._send(self._kind.set_mode(modes.hold), now_ns)

    def hear_answered(self, command: int, accepted: bool) -> None:
        if accepted and command == MISSION_START:
            self._starts_left = 0
        if accepted and command == NAV_TAKEOFF:
            self.takeoff_m = None

    def _look(self, beat: Beat, now_ns: int) -> None:
        """Whether the vehicle still is as we left it."""
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

    def _wanted(self, beat: Beat, height_m: float) -> Command | None:
        modes = self._kind.modes
        drives = self.mode is None or beat.mode == self.mode
        if not beat.armed:
            arms = self.mode if modes is None or modes.arms is None else modes.arms
            return Command(ARM_DISARM, (1,)) if arms in (None, beat.mode) else self._kind.set_mode(arms)
        if drives and self.takeoff_m is not None and height_m < 1.0:
            return Command(NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, self.takeoff_m))
        if self.mode is not None and not drives:
            return self._kind.set_mode(self.mode)
        if self._starts_left:
            self._starts_left -= 1
            self._commands = 0
            return Command(MISSION_START)
        return None

    def _send(self, command: Command | None, now_ns: int) -> Command | None:
        if command is None:
            self._commands = 0
            return None
        if self._commands == MOST_COMMANDS:
            self.why = f"it has not obeyed {MOST_COMMANDS} commands"
            return None
        self._commands += 1
        self._due_ns = now_ns + AGAIN_NS
        return command
