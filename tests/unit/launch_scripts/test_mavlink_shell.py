"""The shell of `gateway mavlink`, turn by turn, between a link of a test and a swarm on a memory network."""

import time
from typing import Any

import pytest
from support.client_rig import keeper_info
from support.mavlink_sender import Sender, beat, common, position
from support.mavlink_world import FRAME, GRID, START
from support.swarm_model import SwarmModel

from launch_scripts.gateways.mavlink.guidance import Wishes
from launch_scripts.gateways.mavlink.mavlink_codec import Wire
from launch_scripts.gateways.mavlink.service import Shell, check_ground
from swarm.bus.bus import Heard
from swarm.client import ConfigError, Frame, RunMismatchError, Swarm
from swarm.client.session import Session
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Obstacle
from swarm.wire.topics import OBSTACLE

LAT_DEG, LON_DEG = FRAME.to_wgs84(*GRID.centre_m(START))


class PlayedLink:
    """Brings the pieces of a list, or one piece without end, and keeps the written bytes."""

    whole = True

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.flood = b""
        self.written: list[Any] = []
        self.answered = 0
        self._reader = common.MAVLink(None)

    def read(self, within_s: float) -> bytes | None:
        if self.pieces:
            return self.pieces.pop(0)
        return self.flood or None

    def answer_last(self) -> None:
        self.answered += 1

    def write(self, data: bytes) -> None:
        self.written += self._reader.parse_buffer(data) or []

    def close(self) -> None:
        pass

    def heard(self, kind: str) -> list[Any]:
        return [each for each in self.written if each.get_type() == kind]


class Rig:
    def __init__(self, wishes: Wishes) -> None:
        self.world = SwarmModel()
        self.obstacles: list[Obstacle] = []
        self.world.bus("ear").subscribe(OBSTACLE, self._hear)
        bus = self.world.bus("adapter")
        self.session = Session(bus, keeper_info(GRID), self.world.scheduler.clock)
        self.link = PlayedLink()
        self.now_ns = 10**12
        self.told: list[str] = []
        self.shell = Shell(
            Swarm(self.session),
            self.link,
            Wire(None, None, time.time()),
            wishes,
            self.told.append,
            lambda: self.now_ns,
        )
        self._vehicle = Sender(4)

    def _hear(self, event: Any) -> None:
        assert isinstance(event, Heard)
        assert isinstance(event.message, Obstacle)
        self.obstacles.append(event.message)

    def vehicle_says(self, autopilot: int, type: int, mode: int = 0, base: int = 1) -> None:
        lat, lon = round(LAT_DEG * 1e7), round(LON_DEG * 1e7)
        for said in (beat(autopilot, type, mode, base), position(lat, lon)):
            self.link.pieces.append(self._vehicle.bytes_of(said))

    def turns(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            self.now_ns += 20_000_000
            self.shell.turn()
            self.world.run(0.02)


def test_a_flood_of_strangers_delays_no_heartbeat_and_hides_no_vehicle() -> None:
    rig = Rig(Wishes())
    rig.vehicle_says(3, 10)
    rig.link.flood = Sender(9).bytes_of(common.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))
    rig.turns(2.2)
    assert len(rig.link.heard("HEARTBEAT")) == 3
    assert rig.obstacles[0].id == "mav4"
    assert FRAME.cell(rig.obstacles[0].x_m, rig.obstacles[0].y_m) == START
    assert rig.link.answered == 2, "who floods is not answered"


def test_when_the_run_is_another_one_the_vehicle_is_put_on_hold_before_the_error_ends_it() -> None:
    rig = Rig(Wishes("t0", arm=True, lost_s=60.0))
    mission = 4 << 16 | 4 << 24
    rig.vehicle_says(12, 10, mission, base=1 | 128)
    rig.turns(0.1)
    adapter = rig.shell._adapter
    adapter._arming.drive(adapter._beat, 0.0, rig.now_ns)  # type: ignore[arg-type]
    rig.session.ended = RunMismatchError("run a is over, and run b is in its namespace: connect again")
    rig.vehicle_says(12, 10, mission, base=1 | 128)
    with pytest.raises(RunMismatchError):
        rig.turns(1.0)
    rig.shell.stop()
    holds = [(each.command, each.param2, each.param3) for each in rig.link.heard("COMMAND_LONG")]
    assert holds[-3:] == [(176, 4.0, 3.0)] * 3, "nobody answers last words, so they are said three times"


def test_ground_without_coordinates_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="swarm gateway mavlink needs latitudes and longitudes: this terrain has no coordin"
    ):
        check_ground(Frame(GridSpec(9, 9, 10.0)))
