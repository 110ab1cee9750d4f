"""Probes are answered from what processes said last: while a loop hangs, whatever else is asked, and in one
sentence each."""

import contextlib
import http.client
import json
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from email.message import Message
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.idle_swarm import idle_swarm
from support.processes import eventually

from launch_scripts.launcher import local_processes
from launch_scripts.launcher.local_processes import (
    CHECK_EVERY_S,
    STILL_S,
    Ending,
    LocalSwarm,
    Running,
    Sight,
    Stillness,
)
from launch_scripts.process_table import ProcessSpec
from launch_scripts.web import HEALTHY, READY, Reply
from launch_scripts.web.health_pages import Process, health_pages, verdict
from launch_scripts.web.health_probe import ask, fast
from launch_scripts.web.http_server import MOST_CONNECTIONS, Server, refusal
from swarm.errors import BusError, ConfigError
from swarm.runtime.loop_health import BOARD_BYTES, Board, Health, Phase, Vitals

_NOW_NS = 100_000_000_000

processes = st.builds(
    Process,
    st.text(max_size=8),
    st.none()
    | st.builds(
        Vitals,
        st.integers(1, _NOW_NS),
        st.integers(0, _NOW_NS),
        st.sampled_from(Phase),
        st.lists(st.text(max_size=9), max_size=3).map(tuple),
    ),
    st.none() | st.text(max_size=9),
)


@given(st.lists(processes, max_size=5))
def test_a_machine_is_well_exactly_if_each_of_its_processes_is(seen: list[Process]) -> None:
    alive, ready = verdict(HEALTHY, seen, _NOW_NS), verdict(READY, seen, _NOW_NS)
    assert alive.code == max((verdict(HEALTHY, [each], _NOW_NS).code for each in seen), default=200)
    assert ready.code == max((verdict(READY, [each], _NOW_NS).code for each in seen), default=200)
    assert alive.code <= ready.code, "what hangs is not ready"
    for found in (alive, ready):
        assert found.content.isascii()
        told = json.loads(found.content)
        assert told["status"] in ("healthy", "not healthy", "ready", "not ready")
        assert found.code == (503 if told["missing"] else 200)
        assert [each["name"] for each in told["processes"]] == [each.name for each in seen]


def test_what_is_wrong_is_said_in_words() -> None:
    hung = Process("planner-t0", Vitals(_NOW_NS - 30_000_000_000, 10_000_000_000, Phase.RUNS, ()))
    seen = [hung, Process("agent-a0", None), Process("keeper-0", None, "it has ended and is started again")]
    hangs = "planner-t0: its loop hangs for 30 s"
    assert missing(HEALTHY, seen, _NOW_NS) == [hangs]
    ended = "keeper-0: it has ended and is started again"
    assert missing(READY, seen, _NOW_NS) == [hangs, "agent-a0: its start", ended]


def missing(question: str, seen: Sequence[Process], now_ns: int) -> list[str]:
    return json.loads(verdict(question, seen, now_ns).content)["missing"]


@pytest.fixture
def health() -> Health:
    made = Health()
    made.begins(10)
    return made


@pytest.fixture
def server(health: Health) -> Iterator[Server]:
    made = Server("health port", 0, health_pages(lambda: [Process("agent-a0", health.board.read())]))
    yield made
    made.close()


def place(server: Server) -> tuple[str, int]:
    host, _, port = server.url.removeprefix("http://").rpartition(":")
    return host, int(port)


def test_a_probe_is_told_what_is_missing_and_exits_by_it(
    server: Server, health: Health, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["health", "--url", server.url]
    assert fast(words) == 1
    assert capsys.readouterr().out == "not ready\nagent-a0: its start\n"
    assert fast([*words, "--live"]) == 0
    health.on_turn(["places for its vehicles"])
    assert fast(words) == 1
    health.on_turn([])
    assert fast([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out.partition("vehicles\n")[2])["status"] == "ready"
    assert ask(f"{server.url}/healthz", live=False).page["status"] == "healthy", "a path is asked as it is"


def test_a_probe_says_what_it_could_not_reach(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    server.close()
    assert fast(["health", "--url", server.url]) == 4
    assert capsys.readouterr().err == f"swarm: {server.url} cannot be reached: Connection refused\n"
    for wrong in ("127.0.0.1:9464", "https://127.0.0.1:1", "http://x:99999", "http://[", "", "http://h:1/ä"):
        with pytest.raises(ConfigError, match="is no address such as"):
            ask(wrong, live=False)
    assert fast(["health", "--connect", "tcp/127.0.0.1:7447"]) is None, "that is the command line's"
    assert fast(["health", "--url", server.url, "--run", "x"]) is None


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"SSH-2.0-x\r\n\r\n",
        b"HTTP/1.0 404 Not Found\r\n\r\n{}",
        b"HTTP/1.0 200 OK\r\n\r\n[]",
        b"HTTP/1.0 200 OK\r\n\r\n{",
        b"HTTP/1.0 \xff\xff\r\n\r\n",
        b"HTTP/1.0 200 OK\r\n\r\n" + b"[" * 100_000,
    ],
)
def test_another_answer_is_not_taken_for_a_page_of_health(reply: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve() -> None:
            connection, _ = listening.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(reply)

        visitor = threading.Thread(target=serve)
        visitor.start()
        with pytest.raises(BusError, match=r"there is no page of health|cannot be reached"):
            ask(f"http://127.0.0.1:{listening.getsockname()[1]}", live=False)
        visitor.join(10)


def test_nothing_that_a_stranger_answers_is_obeyed_by_a_terminal() -> None:
    from launch_scripts.web.health_probe import Answer

    lines = Answer(False, {"status": "\x1b[2J", "missing": ["a\nb", {"x": "\x9b"}]}).lines()
    assert all(line.isprintable() for line in lines)


@pytest.mark.parametrize(
    "request_bytes",
    [
        b"\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET /healthz HTTP/9.9\r\n\r\n",
        b"POST /healthz HTTP/1.0\r\nHost: localhost\r\n\r\n",
        b"GET /healthz HTTP/1.0\r\nHost: example.org\r\n\r\n",
        b"GET /healthz HTTP/1.0\r\n\r\n",
        b"GET /healthz HTTP/1.0\r\nHost : localhost\r\n\r\n",
        b"GET /healthz HTTP/1.0\r\nHost: localhost\r\nHost: localhost\r\n\r\n",
        b"GET /healthz HTTP/1.0\r\nHost: localhost\r\nX: a\r\n Host: evil.example\r\n\r\n",
        b"GET /healthz HTTP/1.0\r\nHost: localhost\r\nOrigin: http://localhost\r\nOrigin: http://evil.example\r\n\r\n",
        b"GET /../../etc/passwd HTTP/1.0\r\nHost: localhost\r\n\r\n",
        b"GET /" + b"x" * 70_000 + b" HTTP/1.0\r\n\r\n",
        b"GET /healthz HTTP/1.0\r\n" + b"A: b\r\n" * 5000 + b"\r\n",
        b"GET /healthz HTTP/1.0\r\nA" + b"b" * 200_000 + b"\r\n\r\n",
        bytes(range(256)) * 40,
    ],
)
def test_a_hostile_request_is_refused_and_the_next_probe_is_answered(
    server: Server, request_bytes: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    with socket.create_connection(place(server), 10) as visitor:
        answer = b""
        with contextlib.suppress(OSError):  # it may be cut
            visitor.sendall(request_bytes)
            visitor.shutdown(socket.SHUT_WR)
            while part := visitor.recv(4096):
                answer += part
    assert b" 200 " not in answer.partition(b"\r\n")[0]
    assert ask(server.url, live=True).ok
    assert "Traceback" not in capfd.readouterr().err


def test_one_who_holds_all_connections_open_keeps_no_probe_out(server: Server) -> None:
    with contextlib.ExitStack() as held:
        for _ in range(2 * MOST_CONNECTIONS):
            each = held.enter_context(socket.create_connection(place(server), 10))
            with contextlib.suppress(OSError):  # it may have been cut already
                each.sendall(b"GET /healthz HTT")
        for _ in range(5):
            assert ask(server.url, live=True).ok


def is_cut(connection: socket.socket) -> bool:
    try:
        return connection.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


@pytest.mark.parametrize(
    ("asks", "crowd"), [("/pages", b"GET /pa"), ("/healthz", b"GET /pages HTTP/1.0\r\nHost: [::1]\r\n\r\n")]
)
def test_slow_connections_are_cut_before_old_ones_and_readers_before_probes(asks: str, crowd: bytes) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def page(query: str, headers: object) -> Reply:
        begun.set()
        assert go_on.wait(60)
        return Reply(200, "text/plain", b"all of it")

    # No connection is cut for its age, and a wait for one is too long to be overlooked.
    server = Server("health port", 0, {"/pages": page, "/healthz": page}, lasts_s=60.0)
    with contextlib.ExitStack() as held:
        early = held.enter_context(socket.create_connection(place(server), 10))
        early.sendall(f"GET {asks} HTTP/1.0\r\nHost: localhost\r\n\r\n".encode())
        assert begun.wait(10)
        late = [
            held.enter_context(socket.create_connection(place(server), 10)) for _ in range(3 * MOST_CONNECTIONS)
        ]
        for each in late:
            each.setblocking(False)
            with contextlib.suppress(OSError):
                each.sendall(crowd)
        eventually(lambda: sum(map(is_cut, late)) == 2 * MOST_CONNECTIONS + 1, 20, "a server that has accepted all")
        go_on.set()
        assert early.makefile("rb").read().endswith(b"all of it")
    server.close()


PARTS = (
    "127.0.0.1", "localhost", "LOCALHOST", "[::1]", "::1", "evil.com", ".", "@", ":", ":80", "%00", "/", "#", "?",
    " ", "\\",
)  # fmt: skip
OURS = ("127.0.0.1", "localhost", "[::1]")


@given(st.one_of(st.lists(st.sampled_from(PARTS), max_size=4).map("".join), st.text(max_size=12)))
def test_a_host_is_this_machine_by_name_or_address_and_nothing_else(host: str) -> None:
    name = host.lower().removesuffix(":80")
    for header, value in (("Host", host), ("Origin", f"http://{host}")):
        headers = Message()
        headers["Host"] = "localhost"
        del headers[header]
        headers[header] = value
        assert (refusal(headers) is None) == (name in OURS)


def test_only_an_address_beyond_this_machine_serves_others_by_name(health: Health) -> None:
    pages = health_pages(lambda: [Process("agent-a0", health.board.read())])
    for address, code in (("127.0.0.1", 403), ("0.0.0.0", 200)):
        server = Server("health port", 0, pages, address)
        connection = http.client.HTTPConnection("127.0.0.1", place(server)[1], timeout=10)
        connection.request("GET", "/healthz", headers={"Host": "pod-7.example.org:9464"})
        assert connection.getresponse().status == code
        connection.close()
        server.close()


def test_an_address_of_ip_6_is_served_and_asked(health: Health) -> None:
    try:
        server = Server("health port", 0, health_pages(lambda: [Process("a", health.board.read())]), "::1")
    except BusError as error:
        pytest.skip(f"no IPv6 here: {error}")
    assert server.url.startswith("http://[::1]:")
    assert ask(server.url, live=True).ok
    server.close()


def test_a_port_or_address_that_cannot_be_had_is_named(server: Server) -> None:
    with pytest.raises(BusError, match=f"health port {place(server)[1]} cannot be opened: Address already in use"):
        Server("health port", place(server)[1], {})
    with pytest.raises(BusError, match=r"health port 0 at 192\.0\.2\.1 cannot be opened"):
        Server("health port", 0, {}, "192.0.2.1")


class Machine:
    """A process with a main thread, as a launcher sees it at each check, and what holds its judgement."""

    def __init__(self) -> None:
        self.stillness, self.stamp_ns, self.used_s = Stillness(), 1, 0.0
        self.had_s = self.slept_s = 0.0
        """Since its last tick: what it had of a processor, and what it slept while it could have had one."""

    def check(self, passed_s: float, used: float, runnable: bool, idle: bool, ticks: bool) -> bool:
        """Returns whether it is said to hang. `used`: the share of the time for which it had a processor."""
        used_s = used * passed_s
        self.used_s, self.stamp_ns = self.used_s + used_s, self.stamp_ns + ticks
        self.had_s, self.slept_s = (
            (0.0, 0.0) if ticks else (self.had_s + used_s, self.slept_s + (not runnable) * (passed_s - used_s))
        )
        return self.stillness.needs_check(self.stamp_ns) and self.stillness.hangs(
            Sight(self.used_s, runnable), passed_s, idle
        )


_looks = st.tuples(st.floats(1.0, 90.0), st.floats(0.0, 1.0), st.booleans(), st.booleans(), st.booleans())


@given(st.lists(_looks, max_size=60))
def test_who_is_said_to_hang_had_a_minute_of_a_processor_or_slept_it_away(
    checks: list[tuple[float, float, bool, bool, bool]],
) -> None:
    machine = Machine()
    for check in checks:
        if machine.check(*check):
            assert machine.had_s + machine.slept_s >= STILL_S - 0.001


@pytest.mark.parametrize(
    ("used", "runnable", "idle", "hangs_after"),
    [
        (1.0, True, True, 61),  # a loop without an end
        (0.01, True, False, None),  # it compiles on a machine that is far too busy
        (0.0, True, False, None),
        (0.0, False, True, 61),  # a deadlock, or SIGSTOP
        (0.01, False, True, 61),  # it sleeps, and looks now and then for what never comes
        (0.0, False, False, 601),  # a deadlock among processes that leave no processor idle
    ],
)
def test_when_a_process_that_does_not_tick_is_said_to_hang(
    used: float, runnable: bool, idle: bool, hangs_after: int | None
) -> None:
    machine = Machine()
    machine.check(1.0, used, runnable, idle, True)
    found = (n for n in range(1, 700) if machine.check(1.0, used, runnable, idle, False))
    after = next(found, None)
    assert after == hangs_after or (after is not None and hangs_after is not None and abs(after - hangs_after) <= 1)


def test_who_was_stopped_with_its_launcher_does_not_hang_when_both_go_on() -> None:
    machine = Machine()
    machine.check(1.0, 0.0, False, True, True)
    assert not any(machine.check(3600.0, 0.0, False, True, False) for _ in range(30))


@pytest.mark.parametrize("phase", [Phase.STARTS, Phase.ENDS, Phase.RUNS])
def test_who_hangs_says_where_and_is_killed_if_it_cannot_but_not_while_it_starts_or_ends(
    phase: Phase, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, sent = 1000.0, []
    monkeypatch.setattr(local_processes.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(Running, "send", lambda running, number: sent.append((now_s - 1000.0, number)))
    monkeypatch.setattr(local_processes, "sight_of", lambda pid: Sight(0.0, False))
    monkeypatch.setattr(local_processes.IdleTime, "any_until", lambda idle, now_s: True)
    swarm = LocalSwarm([ProcessSpec("agent", "a0", "m:f")], lambda spec: None, Path())  # type: ignore[arg-type, return-value]
    [running] = swarm.running
    running.process, running.health = mock.Mock(pid=1), bytearray(BOARD_BYTES)
    Board(running.health).write(Vitals(1, 0, phase, ()))
    for _ in range(70):
        swarm._end_hung()
        now_s += CHECK_EVERY_S
    ended = [(61.0, signal.SIGABRT), *((s, signal.SIGKILL) for s in (67.0, 68.0, 69.0))]
    assert sent == (ended if phase is Phase.RUNS else [])


@pytest.mark.network
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_launcher_ends_what_hangs_with_where_in_its_log_and_starts_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_processes, "STILL_S", 2.0)
    swarm = idle_swarm(tmp_path, ("planner", "t0", "stand_still"))
    endings: list[Ending] = []

    def ready() -> bool:
        return not missing(READY, swarm.seen(), time.monotonic_ns())

    try:
        assert missing(READY, swarm.seen(), time.monotonic_ns()) == ["planner-t0: it does not run"]
        swarm.start()
        eventually(ready, 20, "ready")
        eventually(lambda: endings.extend(swarm.poll()) or endings, 60, "its end")
        assert endings[0].sentence == "its loop stood still, so it was killed; its log says where"
        assert endings[0].restart_in_s == 0.2
        assert not ready()
        assert not missing(HEALTHY, swarm.seen(), time.monotonic_ns()), "the launcher starts it again"
        eventually(lambda: endings.extend(swarm.poll()) or (swarm.restarts and ready()), 60, "its next generation")
    finally:
        swarm.kill()
    assert "stand_still" in (tmp_path / "planner-t0.log").read_text()
