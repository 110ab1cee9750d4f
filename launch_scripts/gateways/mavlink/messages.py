"""What passes between the core and its shell: checked MAVLink messages, and calls of the swarm's client.

Numbers are those of MAVLink's common.xml.
"""

from __future__ import annotations

from dataclasses import dataclass

NAV_WAYPOINT, NAV_LOITER_UNLIM, NAV_TAKEOFF = 16, 17, 22
DO_SET_MODE, MISSION_START, ARM_DISARM, SET_MESSAGE_INTERVAL = 176, 300, 400, 511
GLOBAL_POSITION_INT = 33
ABOVE_HOME, ABOVE_TERRAIN = 6, 11
"""Frames of latitudes and longitudes times 1e7: GLOBAL_RELATIVE_ALT_INT and GLOBAL_TERRAIN_ALT_INT."""
ACCEPTED, IN_PROGRESS = 0, 5


# --- heard of the vehicle -----------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Beat:
    """HEARTBEAT: MAV_AUTOPILOT, MAV_TYPE, whether motors are armed, and the autopilot's own number of its mode."""

    autopilot: int
    type: int
    armed: bool
    mode: int


@dataclass(frozen=True, slots=True)
class Position:
    """GLOBAL_POSITION_INT, with a place on Earth.

    height_m     above home
    heading_rad  clockwise from north; None if the vehicle does not know it
    """

    lat_deg: float
    lon_deg: float
    height_m: float
    speed_m_per_s: float
    heading_rad: float | None


@dataclass(frozen=True, slots=True)
class ItemAsked:
    """MISSION_REQUEST_INT or MISSION_REQUEST, to us."""

    seq: int


@dataclass(frozen=True, slots=True)
class MissionAnswered:
    """MISSION_ACK, to us: MAV_MISSION_RESULT."""

    result: int


@dataclass(frozen=True, slots=True)
class CommandAnswered:
    """COMMAND_ACK: MAV_CMD and MAV_RESULT."""

    command: int
    result: int


@dataclass(frozen=True, slots=True)
class Warned:
    """STATUSTEXT of a warning or worse, without what a terminal would obey."""

    text: str


Incoming = Beat | Position | ItemAsked | MissionAnswered | CommandAnswered | Warned


# --- said to the vehicle ------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Ours, of an onboard controller."""


@dataclass(frozen=True, slots=True)
class Command:
    """COMMAND_LONG with its first parameters; the others are 0."""

    command: int
    params: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class MissionCount:
    """MISSION_COUNT, with which an upload begins."""

    items: int


@dataclass(frozen=True, slots=True)
class MissionItem:
    """MISSION_ITEM_INT.

    frame  `ABOVE_HOME` or `ABOVE_TERRAIN`, which `height_m` is
    """

    seq: int
    command: int
    frame: int
    lat_deg: float
    lon_deg: float
    height_m: float
    current: bool = False


@dataclass(frozen=True, slots=True)
class MissionCurrent:
    """MISSION_SET_CURRENT."""

    seq: int


@dataclass(frozen=True, slots=True)
class MissionCancelled:
    """MISSION_ACK with which we end an upload before the vehicle has it all."""


@dataclass(frozen=True, slots=True)
class Setpoint:
    """SET_POSITION_TARGET_GLOBAL_INT of a position alone.

    height_m  None: the vehicle stays on its ground
    """

    frame: int
    lat_deg: float
    lon_deg: float
    height_m: float | None


Outgoing = Heartbeat | Command | MissionCount | MissionItem | MissionCurrent | MissionCancelled | Setpoint


# --- said to the swarm, and heard of it ---------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Report:
    """Where the vehicle is, as `Vehicle.at` has it."""

    x_m: float
    y_m: float
    heading_rad: float | None
    speed_m_per_s: float


@dataclass(frozen=True, slots=True)
class Withdraw:
    """The vehicle is not known to be anywhere: `Vehicle.leave`."""


@dataclass(frozen=True, slots=True)
class Follow:
    target: str


@dataclass(frozen=True, slots=True)
class Unfollow:
    """The target is given up."""


@dataclass(frozen=True, slots=True)
class Tell:
    """A sentence for the log."""

    sentence: str


Action = Outgoing | Report | Withdraw | Follow | Unfollow | Tell


@dataclass(frozen=True)
class Way:
    """A route of the swarm.

    points_m  (x_m, y_m) in the terrain's frame, in driving order; empty: it leads nowhere
    status    the planner's word, such as "ok" or "unreachable"
    """

    points_m: tuple[tuple[float, float], ...]
    status: str
