"""The links of `swarm gateway mavlink`: bytes become checked messages of one vehicle, and nothing else."""

import contextlib
import math
import os
import socket
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.client_rig import keeper_info
from support.effort import few
from support.mavlink_sender import NOW_S, Sender, beat, common, position
from support.mavlink_world import FRAME, GRID, START
from support.swarm_model import SwarmModel

from launch_scripts.gateways.mavlink import mavlink_codec as codec
from launch_scripts.gateways.mavlink.guidance import Options
from launch_scripts.gateways.mavlink.link import StreamLink, UdpLink, open_link, read_address
from launch_scripts.gateways.mavlink.mavlink_codec import Wire
from launch_scripts.gateways.mavlink.service import Shell, check_ground, read_key
from swarm.bus.bus import Heard
from swarm.client import ConfigError, Frame, RunMismatchError, Swarm
from swarm.client.session import Session
from swarm.errors import BusError
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Obstacle
from swarm.wire.topics import OBSTACLE

KEY, OTHER_KEY = bytes(range(32)), bytes(32)


def wire(sysid: int | None = None, key: bytes | None = None) -> codec.Wire:
    return codec.Wire(sysid, key, NOW_S)


def read(door: codec.Wire, data: bytes) -> list[Any]:
    return door.read(data, whole=True)


# --- in -----------------------------------------------------------------------------------------------------------


def test_what_a_vehicle_says_is_read_with_its_units() -> None:
    data = Sender().bytes_of(
        beat(),
        position(),
        position(hdg=65535),
        common.MAVLink_mission_request_int_message(codec.SYSID, codec.COMPID, 3),
        common.MAVLink_mission_request_message(codec.SYSID, codec.COMPID, 4),
        common.MAVLink_mission_ack_message(codec.SYSID, codec.COMPID, 0),
        common.MAVLink_command_ack_message(codec.ARM_DISARM, 4),
        common.MAVLink_statustext_message(2, b"PreArm: \x1b[2J no fix"),
        common.MAVLink_statustext_message(6, b"only information"),
        common.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0),
    )
    place = codec.Position(36.5, -84.1, 12.5, 5.0, math.pi / 2)
    assert read(wire(), data) == [
        codec.Beat(3, 10, True, 4), place, codec.Position(36.5, -84.1, 12.5, 5.0, None), codec.ItemAsked(3),
        codec.ItemAsked(4), codec.MissionAnswered(0), codec.CommandAnswered(codec.ARM_DISARM, 4),
        codec.Warned("PreArm: [2J no fix"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "message",
    [
        position(lat=0, lon=0),
        position(lat=900_000_001),
        position(lon=-1_800_000_001),
        position(lat=2**31 - 1),
        beat(autopilot=8),
        common.MAVLink_mission_request_int_message(codec.SYSID, 1, 3),
        common.MAVLink_mission_request_int_message(255, codec.COMPID, 3),
        common.MAVLink_mission_ack_message(codec.SYSID, codec.COMPID, 0, 1),
        common.MAVLink_command_ack_message(codec.ARM_DISARM, 0, 0, 0, 255, 190),
        common.MAVLink_statustext_message(2, b"\x01\x02"),
    ],
)
def test_what_makes_no_sense_or_is_not_to_us_is_not_heard(message: Any) -> None:
    door, sender = wire(), Sender()
    read(door, sender.bytes_of(beat()))
    assert read(door, sender.bytes_of(message)) == []


def test_the_first_autopilot_is_the_vehicle_and_all_others_are_not_heard() -> None:
    door = wire()
    assert read(door, Sender(255, 190).bytes_of(beat(autopilot=8, type=6))) == [], "a ground station"
    assert read(door, Sender(7, 100).bytes_of(beat())) == [], "a camera"
    assert read(door, Sender(7).bytes_of(position())) == [], "nobody's heartbeat was heard yet"
    assert door.vehicle is None
    assert len(read(door, Sender(7).bytes_of(beat()))) == 1
    assert door.vehicle == 7
    assert read(door, Sender(8).bytes_of(beat(), position())) == []
    assert read(wire(8), Sender(7).bytes_of(beat())) == []


def test_messages_that_are_cut_anywhere_are_read_from_a_stream_and_not_from_datagrams() -> None:
    data = Sender().bytes_of(beat(), position(), beat())
    for cut in range(len(data)):
        door = wire()
        assert len([*door.read(data[:cut], whole=False), *door.read(data[cut:], whole=False)]) == 3
    door = wire()
    assert len([*door.read(data[:30], whole=True), *door.read(data[30:], whole=True)]) < 3


@settings(max_examples=few(300), deadline=None)
@given(st.lists(st.binary(max_size=400), max_size=8), st.booleans(), st.sampled_from([None, KEY]))
def test_any_bytes_pass_the_door_as_nothing_and_a_vehicle_is_heard_after_them(
    pieces: list[bytes], whole: bool, key: bytes | None
) -> None:
    door = wire(key=key)
    for piece in pieces:
        door.read(piece, whole=whole)
        assert len(door._mav.buf) <= 512
    # The false begin of a message swallows up to 280 bytes that follow it.
    sender = Sender(key=key)
    received = [each for _ in range(40) for each in door.read(sender.bytes_of(beat()), whole=whole)]
    assert received
    assert set(received) == {codec.Beat(3, 10, True, 4)}


# --- signatures ---------------------------------------------------------------------------------------------------


def test_with_a_key_only_what_is_signed_by_it_is_heard() -> None:
    door = wire(key=KEY)
    assert read(door, Sender().bytes_of(beat())) == []
    assert read(door, Sender(key=OTHER_KEY).bytes_of(beat())) == []
    signed = Sender(key=KEY, at_s=NOW_S + 1).bytes_of(beat())
    assert len(read(door, signed)) == 1
    assert read(door, signed) == [], "said again by somebody who has heard it"


def test_a_forged_signature_of_a_late_time_shuts_no_one_out() -> None:
    door, sender = wire(key=KEY), Sender(key=KEY)
    assert len(read(door, sender.bytes_of(beat()))) == 1
    read(door, Sender(key=OTHER_KEY, at_s=NOW_S + 1e6).bytes_of(beat()))
    assert len(read(door, sender.bytes_of(beat()))) == 1


def test_what_we_say_is_signed() -> None:
    vehicle = common.MAVLink(None)
    vehicle.signing.secret_key, vehicle.signing.timestamp = KEY, int((NOW_S - 1_420_070_400) * 1e5)
    (received,) = vehicle.parse_buffer(wire(key=KEY).write(codec.Heartbeat()))
    assert received.get_type() == "HEARTBEAT"
    assert received._signed


def test_a_key_is_64_digits(tmp_path: Path) -> None:
    (tmp_path / "key").write_text(KEY.hex() + "\n")
    assert read_key(tmp_path / "key") == KEY


@settings(max_examples=few(200), deadline=None)
@given(st.binary(min_size=1, max_size=20), st.integers(0, 60), st.sampled_from([beat(), position()]))
def test_a_signed_message_that_was_changed_on_its_way_is_not_heard(other: bytes, at: int, message: Any) -> None:
    door, sender = wire(key=KEY), Sender(key=KEY)
    read(door, sender.bytes_of(beat()))
    data = sender.bytes_of(message)
    changed = (data[:at] + other + data[at + len(other) :])[: len(data)]
    assert len(read(door, changed)) == (changed == data)


# --- out ----------------------------------------------------------------------------------------------------------


def test_what_is_said_to_a_vehicle_has_its_number_and_the_units_of_mavlink() -> None:
    door, vehicle = wire(9), common.MAVLink(None)
    messages = [
        codec.Heartbeat(), codec.Command(codec.ARM_DISARM, (1,)), codec.MissionCount(2),
        codec.MissionItem(1, codec.NAV_WAYPOINT, codec.ABOVE_TERRAIN, 36.5, -84.1234567, 30.0, current=True),
        codec.MissionCurrent(1), codec.MissionCancelled(), codec.Setpoint(codec.ABOVE_HOME, 36.5, -84.1, None),
        codec.Setpoint(codec.ABOVE_HOME, 36.5, -84.1, 30.0),
    ]  # fmt: skip
    received = [vehicle.parse_buffer(door.write(message))[0] for message in messages]
    assert {(each.get_srcSystem(), each.get_srcComponent()) for each in received} == {(codec.SYSID, codec.COMPID)}
    assert [each._header.seq for each in received] == list(range(8))
    for each in received[1:]:
        assert (each.target_system, each.target_component) == (9, codec.AUTOPILOT)
    first, command, count, item, current, cancelled, on_ground, in_air = received
    assert (first.type, first.autopilot) == (18, 8)
    assert (command.command, command.param1, command.param7) == (codec.ARM_DISARM, 1.0, 0.0)
    assert (count.count, current.seq, cancelled.type) == (2, 1, 15)
    assert (item.seq, item.frame, item.x, item.y, item.z, item.current) == (
        1, codec.ABOVE_TERRAIN, 365_000_000, -841_234_567, 30.0, 1,
    )  # fmt: skip
    assert math.isnan(item.param4)
    assert (on_ground.type_mask, in_air.type_mask, in_air.alt) == (0x0DFC, 0x0DF8, 30.0)


def test_to_no_one_only_heartbeats_are_said() -> None:
    assert wire().write(codec.Heartbeat())
    assert wire().write(codec.MissionCount(3)) == b""


# --- links --------------------------------------------------------------------------------------------------------


def test_addresses_are_read() -> None:
    assert str(read_address("udpin:[::1]:14550")) == "udpin:::1:14550"
    assert str(read_address("serial:/dev/ttyACM0:921600")) == "serial:/dev/ttyACM0:921600"


@contextlib.contextmanager
def opened(text: str) -> Iterator[UdpLink | StreamLink]:
    link = open_link(read_address(text))
    try:
        yield link
    finally:
        link.close()


def within(link: UdpLink | StreamLink, turns: int = 100) -> bytes:
    """The first message that it brings."""
    for _ in range(turns):
        if data := link.read(0.05):
            return data
    raise AssertionError("nothing came")


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        made.settimeout(5.0)
        yield made


@pytest.mark.network
def test_udp_answers_the_vehicle_and_no_stranger(peer: socket.socket) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with opened(f"udpin:127.0.0.1:{port}") as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        link.write(b"to nobody")
        peer.sendto(b"vehicle", ("127.0.0.1", port))
        assert within(link) == b"vehicle"
        link.answer_last()
        stranger.sendto(b"stranger", ("127.0.0.1", port))
        assert within(link) == b"stranger"
        link.write(b"answer")
        assert peer.recv(100) == b"answer"
        with pytest.raises(BusError, match=f"cannot listen at udpin:127.0.0.1:{port}: Address already in use"):
            open_link(read_address(f"udpin:127.0.0.1:{port}"))


@pytest.mark.network
def test_udp_out_speaks_first_and_survives_that_no_one_is_there(peer: socket.socket) -> None:
    with opened(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as link:
        link.write(b"hello")
        data, back = peer.recvfrom(100)
        peer.sendto(data * 2, back)
        assert within(link) == b"hellohello"
        peer.close()
        for _ in range(3):
            link.write(b"anybody?")
            assert link.read(0.01) is None


@pytest.mark.network
def test_tcp_connects_again_when_its_peer_has_gone_and_is_back() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10.0)
        address = server.getsockname()
        with opened(f"tcp:127.0.0.1:{address[1]}") as link:
            for word in (b"first", b"second"):
                assert link.read(0.0) is None
                connection, _ = server.accept()
                connection.sendall(word)
                assert within(link) == word
                link.write(b"back")
                assert connection.recv(10) == b"back"
                connection.close()
                assert link.read(0.2) is None
                for _ in range(60):  # a second passes before it tries again
                    link.read(0.02)
    link.write(b"closed")


def test_a_serial_port_is_read_and_written() -> None:
    pytest.importorskip("serial", reason="pyserial is not installed")
    ours, theirs = os.openpty()
    tty.setraw(ours)
    try:
        with opened(f"serial:{os.ttyname(theirs)}:57600") as link:
            os.write(ours, b"vehicle")
            assert within(link) == b"vehicle"
            link.write(b"answer")
            assert os.read(ours, 100) == b"answer"
    finally:
        os.close(ours)
        os.close(theirs)
    with pytest.raises(BusError, match="cannot open serial:/dev/nothing:57600"):
        open_link(read_address("serial:/dev/nothing"))


def test_an_unknown_host_is_one_sentence() -> None:
    with pytest.raises(ConfigError, match="LINK: there is no host"):
        open_link(read_address("tcp:no such host:5760"))


def test_half_a_message_ends_a_connection_and_a_peer_that_reads_late_loses_one() -> None:
    link = StreamLink(made := mock.Mock())
    link.open()
    with mock.patch("os.write", side_effect=[3, BlockingIOError, 2]) as give:
        for closed in (0, 0, 1, 1):
            link.write(b"abc")
            assert made.return_value.close.call_count == closed
    assert give.call_count == 3, "nothing is written to a closed stream"


# --- the shell, turn by turn, between a link of a test and a swarm on a memory network ----------------------------


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

    def received(self, kind: str) -> list[Any]:
        return [each for each in self.written if each.get_type() == kind]


class Rig:
    def __init__(self, options: Options) -> None:
        self.world = SwarmModel()
        self.obstacles: list[Obstacle] = []
        self.world.bus("ear").subscribe(OBSTACLE, self._hear)
        bus = self.world.bus("adapter")
        self.session = Session(bus, keeper_info(GRID), self.world.scheduler.clock)
        self.link = PlayedLink()
        self.now_ns = 10**12
        self.sentences: list[str] = []
        self.shell = Shell(
            Swarm(self.session),
            self.link,
            Wire(None, None, time.time()),
            options,
            self.sentences.append,
            lambda: self.now_ns,
        )
        self._vehicle = Sender(4)

    def _hear(self, event: Any) -> None:
        assert isinstance(event, Heard)
        assert isinstance(event.message, Obstacle)
        self.obstacles.append(event.message)

    def vehicle_says(self, autopilot: int, type: int, mode: int = 0, base: int = 1) -> None:
        lat, lon = round(LAT_DEG * 1e7), round(LON_DEG * 1e7)
        for message in (beat(autopilot, type, mode, base), position(lat, lon)):
            self.link.pieces.append(self._vehicle.bytes_of(message))

    def turns(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            self.now_ns += 20_000_000
            self.shell.turn()
            self.world.run(0.02)


def test_a_flood_of_strangers_delays_no_heartbeat_and_hides_no_vehicle() -> None:
    rig = Rig(Options())
    rig.vehicle_says(3, 10)
    rig.link.flood = Sender(9).bytes_of(common.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))
    rig.turns(2.2)
    assert len(rig.link.received("HEARTBEAT")) == 3
    assert rig.obstacles[0].id == "mav4"
    assert FRAME.cell(rig.obstacles[0].x_m, rig.obstacles[0].y_m) == START
    assert rig.link.answered == 2, "who floods is not answered"


def test_when_the_run_is_another_one_the_vehicle_is_put_on_hold_before_the_error_ends_it() -> None:
    rig = Rig(Options("t0", arm=True, lost_s=60.0))
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
    holds = [(each.command, each.param2, each.param3) for each in rig.link.received("COMMAND_LONG")]
    assert holds[-3:] == [(176, 4.0, 3.0)] * 3, "nobody answers last words, so they are said three times"


def test_ground_without_coordinates_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="swarm gateway mavlink needs latitudes and longitudes: this terrain has no coordin"
    ):
        check_ground(Frame(GridSpec(9, 9, 10.0)))
