"""Bytes of a link become checked messages of one vehicle, and messages become bytes.

Whatever comes is hostile until it has passed here. Other vehicles and ground stations on the link are not heard.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

from launch_scripts.gateways.mavlink.messages import (
    Beat,
    Command,
    CommandAnswered,
    Heartbeat,
    Incoming,
    ItemAsked,
    MissionAnswered,
    MissionCancelled,
    MissionCount,
    MissionCurrent,
    MissionItem,
    Outgoing,
    Position,
    Setpoint,
    Warned,
)
from swarm.errors import ConfigError

SYSID, COMPID = 245, 191
"""Ours: a system that is no vehicle, its onboard computer."""
AUTOPILOT = 1
"""MAV_COMP_ID_AUTOPILOT1."""
_INVALID_AUTOPILOT = 8
_ONBOARD_CONTROLLER, _ACTIVE = 18, 4
_ARMED = 128
_WARNING = 4
_CANCELLED = 15
_POSITION_ONLY, _PLACE_ONLY = 0x0DF8, 0x0DFC
"""Type masks of a setpoint: what is ignored; the second ignores the height, too."""
_NOT_KNOWN = 65535
_SIGNING_EPOCH_S = 1_420_070_400
"""2015-01-01, from which signatures count in units of 10 us."""
_LONGEST_REST = 512
"""Bytes of an unfinished message; a whole one has 280."""


def pymavlink() -> Any:
    """The dialect "common" of MAVLink 2. Raises ConfigError without pymavlink."""
    try:
        from pymavlink.dialects.v20 import common
    except ModuleNotFoundError as error:
        raise ConfigError("swarm mavlink needs pymavlink: pip install 'terrain-swarm[mavlink]'") from error
    return common


class Wire:
    """One link's MAVLink.

    sysid   of the vehicle; None: the first autopilot that is heard
    key     32 bytes: what is said is signed, and what is not signed by it is not heard; None: no signatures
    now_s   Unix time, from which signatures count up

    counts  of messages refused: unreadable, of others, without sense
    """

    def __init__(self, sysid: int | None, key: bytes | None, now_s: float) -> None:
        self._common = pymavlink()
        self._sent = io.BytesIO()
        self._mav = _parser(self._common)(self._sent, srcSystem=SYSID, srcComponent=COMPID)
        self._mav.robust_parsing = True
        if key is not None:
            signing = self._mav.signing
            signing.secret_key, signing.link_id, signing.sign_outgoing = key, 0, True
            signing.timestamp = int((now_s - _SIGNING_EPOCH_S) * 1e5)
        self._sysid = sysid
        self.counts = {"unreadable": 0, "of_others": 0, "senseless": 0}

    @property
    def vehicle(self) -> int | None:
        """The number of the vehicle, once it is known."""
        return self._sysid

    # --- in -------------------------------------------------------------------------------------------------------

    def read(self, data: bytes, *, whole: bool) -> list[Incoming]:
        """The vehicle's messages in what a link has brought.

        whole  no message goes on in what comes next, as in a datagram
        """
        try:
            found = self._mav.parse_buffer(data) or []
        except Exception:  # of a parser that meets any bytes
            self.counts["unreadable"] += 1
            found, whole = [], True
        self._trim(whole)
        heard = (self._checked(each) for each in found)
        return [each for each in heard if each is not None]

    def _trim(self, whole: bool) -> None:
        """Forget what was read, which pymavlink does only where a message ends with the bytes that came."""
        left = self._mav.buf[self._mav.buf_index :]
        self._mav.buf = bytearray() if whole or len(left) > _LONGEST_REST else left
        self._mav.buf_index = 0

    def _checked(self, message: Any) -> Incoming | None:
        kind = message.get_type()
        if kind == "BAD_DATA" or kind.startswith("UNKNOWN"):
            self.counts["unreadable"] += 1
            return None
        if not self._is_vehicles(message, kind):
            self.counts["of_others"] += 1
            return None
        read = _READ.get(kind)
        if read is None:
            return None
        try:
            return read(message)
        except ValueError:
            self.counts["senseless"] += 1
            return None

    def _is_vehicles(self, message: Any, kind: str) -> bool:
        sysid = message.get_srcSystem()
        if message.get_srcComponent() != AUTOPILOT or sysid in (0, SYSID):
            return False
        if self._sysid is None and kind == "HEARTBEAT" and message.autopilot != _INVALID_AUTOPILOT:
            self._sysid = sysid
        return bool(sysid == self._sysid)

    # --- out ------------------------------------------------------------------------------------------------------

    def write(self, message: Outgoing) -> bytes:
        """A message to the vehicle, as bytes; none while no vehicle is known, but for a heartbeat."""
        if self._sysid is None and not isinstance(message, Heartbeat):
            return b""
        self._mav.send(self._packed(message, self._sysid or 0))
        data = self._sent.getvalue()
        self._sent.seek(0)
        self._sent.truncate()
        return data

    def _packed(self, message: Outgoing, to: int) -> Any:
        common = self._common
        match message:
            case Heartbeat():
                return common.MAVLink_heartbeat_message(
                    _ONBOARD_CONTROLLER, _INVALID_AUTOPILOT, 0, 0, _ACTIVE, mavlink_version=3
                )
            case Command(command=command, params=params):
                given = (*map(float, params), *[0.0] * (7 - len(params)))
                return common.MAVLink_command_long_message(to, AUTOPILOT, command, 0, *given)
            case MissionCount(items=items):
                return common.MAVLink_mission_count_message(to, AUTOPILOT, items, 0)
            case MissionItem():
                return common.MAVLink_mission_item_int_message(
                    to, AUTOPILOT, message.seq, message.frame, message.command, int(message.current), 1,
                    0.0, 0.0, 0.0, math.nan, _degrees7(message.lat_deg), _degrees7(message.lon_deg),
                    message.height_m, 0,
                )  # fmt: skip
            case MissionCurrent(seq=seq):
                return common.MAVLink_mission_set_current_message(to, AUTOPILOT, seq)
            case MissionCancelled():
                return common.MAVLink_mission_ack_message(to, AUTOPILOT, _CANCELLED, 0)
            case Setpoint(height_m=height_m):
                return common.MAVLink_set_position_target_global_int_message(
                    0, to, AUTOPILOT, message.frame, _PLACE_ONLY if height_m is None else _POSITION_ONLY,
                    _degrees7(message.lat_deg), _degrees7(message.lon_deg), height_m or 0.0, *[0.0] * 8,
                )  # fmt: skip


def _parser(common: Any) -> Any:
    """pymavlink's, mended: a forged signature of a late time shut out the vehicle, whose own times are earlier."""

    class Parser(common.MAVLink):  # type: ignore[misc]
        def check_signature(self, msgbuf: bytearray, src_system: int, src_component: int) -> bool:
            before = dict(self.signing.stream_timestamps)
            good = bool(super().check_signature(msgbuf, src_system, src_component))
            if not good:
                self.signing.stream_timestamps = before
            return good

    return Parser


def _degrees7(degrees: float) -> int:
    return round(degrees * 1e7)


# --- what each message must be, or ValueError ---------------------------------------------------------------------


def _beat(message: Any) -> Beat:
    if message.autopilot == _INVALID_AUTOPILOT:
        raise ValueError("no autopilot")
    return Beat(message.autopilot, message.type, bool(message.base_mode & _ARMED), message.custom_mode)


def _position(message: Any) -> Position:
    lat_deg, lon_deg = message.lat / 1e7, message.lon / 1e7
    # Without a fix autopilots say 0, 0.
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180) or (message.lat == 0 and message.lon == 0):
        raise ValueError("no place on Earth")
    heading_rad = None if message.hdg == _NOT_KNOWN else math.radians(message.hdg / 100 % 360)
    speed_m_per_s = math.hypot(message.vx, message.vy) / 100
    return Position(lat_deg, lon_deg, message.relative_alt / 1e3, speed_m_per_s, heading_rad)


def _item_asked(message: Any) -> ItemAsked:
    _check_to_us(message)
    return ItemAsked(message.seq)


def _mission_answered(message: Any) -> MissionAnswered:
    _check_to_us(message)
    return MissionAnswered(message.type)


def _check_to_us(message: Any) -> None:
    """Another station may upload a mission on the same link, and fences and rally points are none of ours."""
    if message.target_system != SYSID or message.target_component != COMPID or message.mission_type != 0:
        raise ValueError("not to us")


def _command_answered(message: Any) -> CommandAnswered:
    if message.target_system not in (0, SYSID):
        raise ValueError("not to us")
    return CommandAnswered(message.command, message.result)


def _warned(message: Any) -> Warned:
    text = message.text if isinstance(message.text, str) else message.text.decode("ascii", "replace")
    shown = "".join(letter for letter in text if " " <= letter <= "~").strip()
    if message.severity > _WARNING or not shown:
        raise ValueError("nothing to tell")
    return Warned(shown)


_READ: dict[str, Callable[[Any], Incoming]] = {
    "HEARTBEAT": _beat,
    "GLOBAL_POSITION_INT": _position,
    "MISSION_REQUEST_INT": _item_asked,
    "MISSION_REQUEST": _item_asked,
    "MISSION_ACK": _mission_answered,
    "COMMAND_ACK": _command_answered,
    "STATUSTEXT": _warned,
}
