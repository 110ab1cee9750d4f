"""Other systems on a MAVLink link, by pymavlink itself. Tests that import this are left out without it."""

from typing import Any

import pytest

from launch_scripts.gateways.mavlink.mavlink_codec import AUTOPILOT

common: Any = pytest.importorskip("pymavlink.dialects.v20.common", reason="pymavlink is not installed")
NOW_S = 1_700_000_000.0


class Sender:
    """Another system on the link, by pymavlink itself."""

    def __init__(
        self, sysid: int = 1, compid: int = AUTOPILOT, key: bytes | None = None, at_s: float = NOW_S
    ) -> None:
        self.mav = common.MAVLink(None, srcSystem=sysid, srcComponent=compid)
        if key is not None:
            self.mav.signing.secret_key, self.mav.signing.sign_outgoing = key, True
            self.mav.signing.timestamp = int((at_s - 1_420_070_400) * 1e5)

    def bytes_of(self, *messages: Any) -> bytes:
        packed = []
        for message in messages:
            packed.append(bytes(message.pack(self.mav)))
            self.mav.seq = (self.mav.seq + 1) % 256
        return b"".join(packed)


def beat(autopilot: int = 3, type: int = 10, mode: int = 4, base: int = 129) -> Any:
    return common.MAVLink_heartbeat_message(type, autopilot, base, mode, 4, 3)


def position(lat: int = 365_000_000, lon: int = -841_000_000, vx: int = 300, hdg: int = 9000) -> Any:
    return common.MAVLink_global_position_int_message(1, lat, lon, 500_000, 12_500, vx, 400, 0, hdg)
