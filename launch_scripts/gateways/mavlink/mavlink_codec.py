"""MAVLink's messages as checked values, and the bytes of a link from and to them.

Received bytes are hostile until they have passed `Wire.read`. Other vehicles and ground stations on the link are
not heard. Numbers are those of MAVLink's common.xml.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

from msgspec import Struct
from pymavlink.dialects.v20 import common

SYSID, COMPID = 245, 191
"""Ours: a system which is no vehicle, and its onboard computer."""
AUTOPILOT = 1
"""MAV_COMP_ID_AUTOPILOT1."""
NAV_WAYPOINT, NAV_LOITER_UNLIM, NAV_TAKEOFF = 16, 17, 22
DO_SET_MODE, MISSION_START, ARM_DISARM, SET_MESSAGE_INTERVAL = 176, 300, 400, 511
GLOBAL_POSITION_INT = 33
"""The numbers of MAV_CMD above, and of a message, are those of MAVLink's common messages."""
ABOVE_HOME, ABOVE_TERRAIN = 6, 11
"""Frames of latitudes and longitudes times 1e7: GLOBAL_RELATIVE_ALT_INT and GLOBAL_TERRAIN_ALT_INT."""
ACCEPTED, IN_PROGRESS = 0, 5
"""MAV_RESULT."""
_NO_AUTOPILOT = common.MAV_AUTOPILOT_INVALID
"""MAV_AUTOPILOT of what flies nothing, such as a camera."""
_POSITION_ONLY, _PLACE_ONLY = 0x0DF8, 0x0DFC
"""Type masks of a setpoint: the fields that are ignored. The second ignores the height, too."""
_NOT_KNOWN = 65535
"""Heading that a vehicle does not know (GLOBAL_POSITION_INT.hdg)."""
_SIGNING_EPOCH_S = 1_420_070_400
"""2015-01-01, from which signatures count in units of 10 us."""
_LONGEST_REST = 512
"""The bytes that are kept of an unfinished message. A whole one has 280."""


# --- heard of the vehicle -----------------------------------------------------------------------------------------


class Beat(Struct, frozen=True):
    """HEARTBEAT: MAV_AUTOPILOT, MAV_TYPE, whether motors are armed, and the autopilot's own number of its mode."""

    autopilot: int
    type: int
    armed: bool
    mode: int


class Position(Struct, frozen=True):
    """GLOBAL_POSITION_INT, with a place on Earth.

    height_m     above home
    heading_rad  clockwise from north; None if the vehicle does not know it
    """

    lat_deg: float
    lon_deg: float
    height_m: float
    speed_m_per_s: float
    heading_rad: float | None


class ItemAsked(Struct, frozen=True):
    """MISSION_REQUEST_INT or MISSION_REQUEST, to us."""

    seq: int


class MissionAnswered(Struct, frozen=True):
    """MISSION_ACK, to us: MAV_MISSION_RESULT."""

    result: int


class CommandAnswered(Struct, frozen=True):
    """COMMAND_ACK: MAV_CMD and MAV_RESULT."""

    command: int
    result: int


class Warned(Struct, frozen=True):
    """STATUSTEXT of a warning or worse, without the signs which a terminal would obey."""

    text: str


Incoming = Beat | Position | ItemAsked | MissionAnswered | CommandAnswered | Warned


# --- said to the vehicle ------------------------------------------------------------------------------------------


class Heartbeat(Struct, frozen=True):
    """Ours, of an onboard controller."""


class Command(Struct, frozen=True):
    """COMMAND_LONG with its first parameters; the others are 0."""

    command: int
    params: tuple[float, ...] = ()


class MissionCount(Struct, frozen=True):
    """MISSION_COUNT, with which an upload begins."""

    items: int


class MissionItem(Struct, frozen=True):
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


class MissionCurrent(Struct, frozen=True):
    """MISSION_SET_CURRENT."""

    seq: int


class MissionCancelled(Struct, frozen=True):
    """MISSION_ACK with which we end an upload before the vehicle has it all."""


class Setpoint(Struct, frozen=True):
    """SET_POSITION_TARGET_GLOBAL_INT of a position alone.

    height_m  None: the vehicle stays on its ground
    """

    frame: int
    lat_deg: float
    lon_deg: float
    height_m: float | None


Outgoing = Heartbeat | Command | MissionCount | MissionItem | MissionCurrent | MissionCancelled | Setpoint


class _Parser(common.MAVLink):  # type: ignore[misc]
    """pymavlink's parser with one fault repaired: a forged signature of a late time shut out the vehicle, whose own
    times are earlier."""

    def check_signature(self, msgbuf: bytearray, src_system: int, src_component: int) -> bool:
        before = dict(self.signing.stream_timestamps)
        good = bool(super().check_signature(msgbuf, src_system, src_component))
        if not good:
            self.signing.stream_timestamps = before
        return good


class Wire:
    """One link's MAVLink.

    sysid   of the vehicle; None: the first autopilot that is heard
    key     32 bytes: messages are signed, and messages without its signature are rejected; None: no signatures
    now_s   Unix time, from which signatures count up
    """

    def __init__(self, sysid: int | None, key: bytes | None, now_s: float) -> None:
        self.vehicle = sysid
        """The system number of the vehicle, once it is known."""
        self._sent: list[bytes] = []
        self._mav = _Parser(SimpleNamespace(write=self._sent.append), srcSystem=SYSID, srcComponent=COMPID)
        self._mav.robust_parsing = True
        if key is not None:
            signing = self._mav.signing
            signing.secret_key, signing.link_id, signing.sign_outgoing = key, 0, True
            signing.timestamp = int((now_s - _SIGNING_EPOCH_S) * 1e5)

    def read(self, data: bytes, *, whole: bool) -> list[Incoming]:
        """Returns the vehicle's messages in what a link has brought.

        whole  no message continues in the next piece, as in a datagram
        """
        try:
            found = self._mav.parse_buffer(data) or []
        except Exception:  # of a parser that meets any bytes
            found, whole = [], True
        # pymavlink forgets what it has read only where a message ends with the bytes that came.
        left = self._mav.buf[self._mav.buf_index :]
        self._mav.buf = bytearray() if whole or len(left) > _LONGEST_REST else left
        self._mav.buf_index = 0
        return [checked for each in found if self._is_vehicles(each) and (checked := _read(each)) is not None]

    def _is_vehicles(self, message: Any) -> bool:
        sysid = message.get_srcSystem()
        if message.get_srcComponent() != AUTOPILOT or sysid in (0, SYSID):
            return False
        beats = message.get_type() == "HEARTBEAT"
        if self.vehicle is None and beats and message.autopilot != _NO_AUTOPILOT:
            self.vehicle = sysid
        return bool(sysid == self.vehicle)

    def write(self, message: Outgoing) -> bytes:
        """Returns a message to the vehicle as bytes; none while no vehicle is known, except for a heartbeat."""
        mav, to = self._mav, (self.vehicle, AUTOPILOT)
        if isinstance(message, Heartbeat):
            mav.heartbeat_send(common.MAV_TYPE_ONBOARD_CONTROLLER, _NO_AUTOPILOT, 0, 0, common.MAV_STATE_ACTIVE)
        elif self.vehicle is None:
            return b""
        match message:
            case Command(command=command, params=params):
                given = (*map(float, params), *[0.0] * (7 - len(params)))
                mav.command_long_send(*to, command, 0, *given)
            case MissionCount(items=items):
                mav.mission_count_send(*to, items)
            case MissionItem(height_m=height_m, current=current):
                how = message.seq, message.frame, message.command, int(current), 1, 0.0, 0.0, 0.0, math.nan
                mav.mission_item_int_send(*to, *how, *_degrees7(message), height_m)
            case MissionCurrent(seq=seq):
                mav.mission_set_current_send(*to, seq)
            case MissionCancelled():
                mav.mission_ack_send(*to, common.MAV_MISSION_OPERATION_CANCELLED)
            case Setpoint(frame=frame, height_m=height_m):
                mask = _PLACE_ONLY if height_m is None else _POSITION_ONLY
                where = *_degrees7(message), height_m or 0.0
                mav.set_position_target_global_int_send(0, *to, frame, mask, *where, *[0.0] * 8)
        return self._sent.pop()


def _degrees7(place: MissionItem | Setpoint) -> tuple[int, int]:
    return round(place.lat_deg * 1e7), round(place.lon_deg * 1e7)


def _read(message: Any) -> Incoming | None:
    """Returns a message as the core has it; None of what makes no sense, is not to us, or is not heard."""
    match message.get_type():
        case "HEARTBEAT" if message.autopilot != _NO_AUTOPILOT:
            armed = bool(message.base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED)
            return Beat(message.autopilot, message.type, armed, message.custom_mode)
        case "GLOBAL_POSITION_INT":
            return _position(message)
        case "MISSION_REQUEST_INT" | "MISSION_REQUEST" if _is_of_our_mission(message):
            return ItemAsked(message.seq)
        case "MISSION_ACK" if _is_of_our_mission(message):
            return MissionAnswered(message.type)
        case "COMMAND_ACK" if message.target_system in (0, SYSID):
            return CommandAnswered(message.command, message.result)
        case "STATUSTEXT" if message.severity <= common.MAV_SEVERITY_WARNING:
            text = message.text if isinstance(message.text, str) else message.text.decode("ascii", "replace")
            printable = "".join(letter for letter in text if " " <= letter <= "~").strip()
            return Warned(printable) if printable else None
    return None


def _position(message: Any) -> Position | None:
    lat_deg, lon_deg = message.lat / 1e7, message.lon / 1e7
    # Without a fix autopilots say 0, 0.
    if abs(lat_deg) > 90 or abs(lon_deg) > 180 or (message.lat, message.lon) == (0, 0):
        return None
    heading_rad = None if message.hdg == _NOT_KNOWN else math.radians(message.hdg / 100 % 360)
    speed_m_per_s = math.hypot(message.vx, message.vy) / 100
    return Position(lat_deg, lon_deg, message.relative_alt / 1e3, speed_m_per_s, heading_rad)


def _is_of_our_mission(message: Any) -> bool:
    """Another station may upload a mission on the same link, and fences and rally points are none of ours."""
    return (message.target_system, message.target_component, message.mission_type) == (SYSID, COMPID, 0)
