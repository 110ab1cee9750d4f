"""A loop's record is read whole at any moment, grows old when the loop hangs, and reaches a supervisor."""

import contextlib
import os
import select
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.dummy_roles import Idle
from support.makers import run_info
from support.processes import eventually
from support.swarm_model import LossyLinks

from swarm.bus.bus import AskEnded, LinkChanged
from swarm.bus.memory_bus import MemoryNetwork
from swarm.bus.scheduler import Scheduler
from swarm.clock import ManualClock, MonotonicClock
from swarm.runtime import loop_health
from swarm.runtime.inbox import Inbox
from swarm.runtime.loop_health import Board, Health, Phase, Supervisor, Vitals, supervisor_of
from swarm.runtime.membership import Member
from swarm.runtime.process import Process
from swarm.runtime.stats import READY
from swarm.wire.topics import RUN


class Memory:
    """Counts the bytes that a writer may still write, and drops those beyond: it was killed there."""

    def __init__(self) -> None:
        self.bytes = bytearray(loop_health.BOARD_BYTES)
        self.left = 1 << 30

    def __getitem__(self, at: slice) -> bytes:
        return bytes(self.bytes[at])

    def __setitem__(self, at: slice, content: bytes) -> None:
        taken = content[: self.left]
        self.bytes[at.start : at.start + len(taken)] = taken
        self.left -= len(taken)


vitals = st.builds(
    Vitals,
    st.integers(1, 1 << 62),
    st.integers(0, 1 << 62),
    st.sampled_from(Phase),
    st.lists(st.text(max_size=30), max_size=5).map(tuple),
)


@given(told=st.lists(vitals, min_size=1, max_size=6), last=vitals, cut=st.integers(0, loop_health.SLOT_BYTES))
def test_a_reader_sees_a_whole_record_wherever_the_writer_was_killed(told, last, cut):
    memory = Memory()
    board = Board(memory)
    rising = [each._replace(stamp_ns=n + 1) for n, each in enumerate([*told, last])]
    for each in rising[:-1]:
        board.write(each)
        assert Board(memory).read() == each
    memory.left = cut
    board.write(rising[-1])
    assert Board(memory).read() in rising[-2:]


@given(st.lists(st.text(max_size=400), max_size=60))
def test_what_is_lacking_always_fits(lacks: list[str]) -> None:
    board = Board()
    board.write(Vitals(1, 2, Phase.RUNS, tuple(lacks)))
    found = board.read()
    assert all(short == whole[: len(short)] for short, whole in zip(found.lacks, lacks, strict=False))
    assert bool(found.lacks) == bool(lacks), "one need at least is told, so that nobody seems ready"


def test_nothing_was_written_where_there_are_zeros_or_rubbish() -> None:
    assert Board(bytearray(loop_health.BOARD_BYTES)).read() is None
    assert Board(bytearray(os.urandom(loop_health.BOARD_BYTES))).read() is None


class Sleepy(Idle):
    """A service whose tick hangs on request."""

    def __init__(self) -> None:
        super().__init__()
        self.hang, self.wake = threading.Event(), threading.Event()
        self.needs: list[str] = ["a bed"]

    def lacks(self) -> list[str]:
        return self.needs

    def tick(self, now_ns: int) -> None:
        if self.hang.is_set():
            self.wake.wait(60)


@contextlib.contextmanager
def running(service: Sleepy, health: Health) -> Iterator[None]:
    """A loop on a thread, which ends even if its tick hangs."""
    process = Process(service, Inbox(), MonotonicClock(), tick_hz=50, health=health)
    thread = threading.Thread(target=process.run)
    thread.start()
    try:
        yield
    finally:
        service.hang.clear()
        service.wake.set()
        process.stop()
        thread.join(30)


def test_a_loop_that_hangs_is_seen_from_another_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_health, "HUNG_S", 0.5)
    service, health = Sleepy(), Health()
    told = health.board.read
    assert told().phase is Phase.STARTS
    with running(service, health):
        eventually(lambda: told().phase is Phase.RUNS, 30, "a loop that runs")
        assert told().lacks == ("a bed",)
        service.needs = []
        eventually(lambda: not told().lacks, 30, "a loop that lacks nothing")
        service.hang.set()
        eventually(lambda: told().hangs(time.monotonic_ns()), 30, "a loop that hangs")
        service.hang.clear()
        service.wake.set()
        eventually(lambda: not told().hangs(time.monotonic_ns()), 30, "a loop that turns again")
    assert told().phase is Phase.ENDS
    assert not told().hangs(1 << 62), "what ends does not turn, and does not hang"


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """The socket of a service manager."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(10)
        yield listening


def told(manager: socket.socket) -> list[str]:
    return manager.recv(4096).decode().split("\n")


def test_systemd_is_told_when_a_loop_is_up_turns_and_ends(manager: socket.socket) -> None:
    limit_us = 400_000
    environment = {
        "NOTIFY_SOCKET": manager.getsockname(),
        "WATCHDOG_USEC": str(limit_us),
        "WATCHDOG_PID": str(os.getpid()),
    }
    service, health = Sleepy(), Health(supervisor=supervisor_of(environment))
    assert told(manager) == ["STATUS=its start"]
    with running(service, health):
        assert told(manager) == ["STATUS=waits for a bed"]
        assert told(manager) == ["READY=1", "WATCHDOG=1"]
        for _ in range(3):
            assert told(manager) == ["WATCHDOG=1"]
        service.needs = []
        while (words := told(manager)) == ["WATCHDOG=1"]:
            pass
        assert words == ["STATUS=ready"]
        service.hang.set()
        manager.settimeout(3 * limit_us / 1e6)
        assert falls_silent(manager)
    manager.settimeout(10)
    while (words := told(manager)) == ["WATCHDOG=1"]:
        pass
    assert words == ["STOPPING=1"]


def test_a_manager_that_reads_nothing_holds_no_one_up_and_hears_of_the_start_later(manager: socket.socket) -> None:
    supervisor = Supervisor(manager.getsockname(), limit_ns=4)
    fill(manager)
    began_s = time.monotonic()
    for now_ns in range(1, 1000):
        supervisor.on_turn(now_ns)
    assert time.monotonic() - began_s < 5
    while manager.recv(100) == b"x" and select.select([manager], [], [], 0)[0]:
        pass
    supervisor.on_turn(2000)
    assert told(manager)[0] == "READY=1"


def falls_silent(manager: socket.socket) -> bool:
    """True if there is silence for as long as the socket waits, once messages in transit have come."""
    for _ in range(1000):  # more than a socket keeps
        try:
            told(manager)
        except TimeoutError:
            return True
    return False


def fill(manager: socket.socket) -> None:
    """Sends as many datagrams as there is space for."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as filler:
        filler.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                filler.sendto(b"x", manager.getsockname())


def test_a_name_in_the_abstract_namespace_is_a_manager_too() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        name = f"terrain-swarm-test-{os.getpid()}"
        listening.bind(f"\0{name}")
        listening.settimeout(10)
        supervisor_of({"NOTIFY_SOCKET": f"@{name}"}).on_turn(1)
        assert listening.recv(100) == b"READY=1"


@given(st.text(max_size=300))
def test_no_text_makes_a_word_of_its_own(text: str) -> None:
    supervisor = Supervisor(None)
    supervisor._address, supervisor._socket = "@nowhere", Mock()
    supervisor.says(text)
    (sent, _), _ = supervisor._socket.sendto.call_args
    assert sent.count(b"\n") == 0


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"NOTIFY_SOCKET": ""},
        {"NOTIFY_SOCKET": "vsock:2:1"},
        {"NOTIFY_SOCKET": "/nowhere/at/all", "WATCHDOG_USEC": "x"},
        {"NOTIFY_SOCKET": "/nowhere/at/all", "WATCHDOG_USEC": "1", "WATCHDOG_PID": "1"},
    ],
)
def test_a_process_without_a_manager_goes_on(environment: dict[str, str]) -> None:
    supervisor = supervisor_of(environment)
    supervisor.says("x")
    supervisor.on_turn(1)
    supervisor.ends()


def test_a_process_is_ready_once_its_link_is_up_its_run_is_known_and_its_needs_are_met() -> None:
    scheduler = Scheduler(ManualClock(1))
    network = MemoryNetwork(scheduler, LossyLinks(0))
    bus = network.bus("agent-a0")
    member = Member(run_info(), bus, lambda event: None)
    fed: list[bool] = []
    member.needs("food", lambda: bool(fed))
    assert member.lacks() == ["word of its run", "food"]
    member.on_member_event(AskEnded("run-check", RUN, 0, None))
    assert member.lacks() == ["food"], "whoever is alone in its namespace begins the run"
    fed.append(True)
    assert member.lacks() == []
    member.on_member_event(LinkChanged(up=False, beyond=True))
    assert member.lacks() == [], "a link between routers is not ours"
    member.on_member_event(LinkChanged(up=False))
    member.on_member_event(LinkChanged(up=True, beyond=True))
    assert member.lacks() == ["its router"]
    member.publish_stats(1)
    assert member.counters.gauges[READY] == 0.0
    member.on_member_event(LinkChanged(up=True))
    member.publish_stats(2)
    assert member.counters.gauges[READY] == 1.0
