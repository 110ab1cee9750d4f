"""What autopilots have in common with none other: numbers of modes, where missions begin, who wants a stream.

Sources: px4_custom_mode.h of PX4, mode.h of ArduCopter, Rover, ArduPlane and ArduSub, and their pages on guided and
offboard modes.
"""

from __future__ import annotations

from dataclasses import dataclass

from launch_scripts.gateways.mavlink.messages import DO_SET_MODE, Beat, Command

ARDUPILOT, PX4 = 3, 12
_UNKNOWN_TYPE = 0
_DRIVES = frozenset({10, 11})
"""MAV_TYPE of rovers and boats."""
_PLANES = frozenset({1, *range(19, 26)})
"""Fixed wings and what takes off upright and flies on wings."""
_COPTERS = frozenset({2, 3, 4, 13, 14, 15, 29, 35})


@dataclass(frozen=True)
class Modes:
    """The autopilot's own numbers. `arms` is the mode in which it is armed; None: in that in which it drives."""

    mission: int
    guided: int | None
    hold: int
    arms: int | None = None


@dataclass(frozen=True)
class Kind:
    """How one make of vehicle wants to be driven.

    name        for people
    flies       by its MAV_TYPE; None if that says nothing
    modes       None: it has none that we know, and none is ever set
    first_item  of a mission: before it lies home
    streams     guided needs ten setpoints a second, and ends without them
    starts      a mission begins with MISSION_START
    terrain     it can keep a height above the terrain
    """

    name: str
    flies: bool | None
    modes: Modes | None
    first_item: int = 0
    streams: bool = False
    starts: bool = True
    terrain: bool = False

    def set_mode(self, mode: int) -> Command:
        """DO_SET_MODE: PX4 has main and sub-mode in parameters of their own."""
        if self.first_item:
            return Command(DO_SET_MODE, (1, mode))
        return Command(DO_SET_MODE, (1, mode >> 16 & 0xFF, mode >> 24 & 0xFF))


_PX4_MODES = Modes(mission=4 << 16 | 4 << 24, guided=6 << 16, hold=4 << 16 | 3 << 24)
_ROVER = Modes(mission=10, guided=15, hold=15, arms=15)
_COPTER = Modes(mission=3, guided=4, hold=4, arms=4)
_PLANE = Modes(mission=10, guided=None, hold=15, arms=15)


def kind_of(beat: Beat) -> Kind:
    """The kind of vehicle that a heartbeat tells of."""
    flies = None if beat.type == _UNKNOWN_TYPE else beat.type not in _DRIVES
    if beat.autopilot == PX4:
        return Kind("PX4", flies, _PX4_MODES, streams=True, starts=False)
    if beat.autopilot == ARDUPILOT:
        modes = (
            _ROVER if beat.type in _DRIVES
            else _COPTER if beat.type in _COPTERS
            else _PLANE if beat.type in _PLANES
            else None
        )  # fmt: skip
        return Kind("ArduPilot", flies, modes, first_item=1, terrain=True)
    return Kind("an autopilot without modes that are known here", flies, None)
