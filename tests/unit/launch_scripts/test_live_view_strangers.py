"""Access to the live view: pages of this machine come in, those of other sites neither read nor connect; no client
can keep it busy."""

import contextlib
import http.client
import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import rerun as rr
from support.monitor_rig import READ, taking
from support.processes import eventually

from launch_scripts.monitor.live_layout import make_blueprint
from launch_scripts.monitor.rerun_outputs import Sinks
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from launch_scripts.web import http_server as web
from launch_scripts.web.http_server import MOST_CONNECTIONS, Audience
from shared_map.terrain.terrain import terrain_of_pace
from swarm.config.scenario import MonitorConfig

pytestmark = pytest.mark.network

GRPC_WEB = {"Content-Type": "application/grpc-web+proto", "X-Grpc-Web": "1"}


@pytest.fixture(scope="module")
def sinks() -> Iterator[Sinks]:
    mesh = TerrainMesh(terrain_of_pace(np.ones((8, 8), np.float32)))
    opened = Sinks("r", None, MonitorConfig(web_port=0), make_blueprint(mesh))
    opened.rec.log("secret", rr.TextLog("where everybody is"))
    yield opened
    opened.close()


def ask(port: int, method: str, path: str, headers: dict[str, str], body: bytes = b"") -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    with contextlib.closing(connection):
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value.format(port=port))
        connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        reply = connection.getresponse()
        return reply.status, reply.read1(500)


FOREIGN = [
    {"Host": "evil.example:{port}", "Origin": "http://evil.example:{port}"},
    {"Host": "[::ffff:10.0.0.1]:{port}"},
    {"Origin": "null"},
    {"Origin": "https://app.rerun.io"},
]
OWN = [
    {},
    {"Host": "localhost:8080"},
    {"Host": "127.0.0.1:{port}", "Origin": "http://127.0.0.1:9090"},
    {"Host": "[::1]:{port}", "Origin": "http://[::1]:1"},
]


@pytest.mark.parametrize("headers", FOREIGN, ids=str)
def test_pages_of_other_sites_are_refused(sinks: Sinks, headers: dict[str, str]) -> None:
    page = sinks.web_port
    assert ask(page, "GET", "/", headers)[0] == 403
    assert ask(page, "GET", "/run.json", headers)[0] == 403
    for method in ("POST", "OPTIONS", "GET"):
        status, body = ask(page, method, READ, {**GRPC_WEB, **headers}, bytes(5))
        assert status == 403
        assert b"where everybody is" not in body


@pytest.mark.parametrize("headers", OWN, ids=str)
def test_pages_of_this_machine_come_in_through_tunnels_too(sinks: Sinks, headers: dict[str, str]) -> None:
    page = sinks.web_port
    assert ask(page, "GET", "/", headers)[0] == 200
    status, body = ask(page, "POST", READ, {**GRPC_WEB, **headers}, bytes(5))
    assert (status, len(body) > 50) == (200, True), "the stream comes through the page's port"


def test_a_second_request_on_a_connection_does_not_slip_in_behind_the_first(sinks: Sinks) -> None:
    own = f"POST {READ} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\n".encode() + bytes(5)
    with socket.create_connection(("127.0.0.1", sinks.web_port), timeout=10) as both:
        both.sendall(own + taking("evil.example"))
        told = b""
        with contextlib.suppress(ConnectionError):
            while piece := both.recv(4096):
                told += piece
    assert told.count(b"HTTP/1.1 ") == 1, told


def test_connections_are_bounded_and_the_idle_ones_cut(sinks: Sinks, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sinks.page.server, "lasts_s", 1.5)
    port, before = sinks.web_port, threading.active_count()
    with contextlib.ExitStack() as stack:
        for _ in range(4 * MOST_CONNECTIONS):
            with contextlib.suppress(OSError):
                idle = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=5))
                idle.sendall(b"GET / HT")
        time.sleep(0.5)
        assert threading.active_count() - before <= MOST_CONNECTIONS
        eventually(
            lambda: threading.active_count() <= before, 15, "open at our end, and cut at theirs, their threads"
        )
    monkeypatch.undo()
    assert ask(port, "GET", "/", {"Host": "evil.example"})[0] == 403


def test_a_reader_that_takes_nothing_is_cut_off(sinks: Sinks, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "SEND_WITHIN_S", 1.0)
    before = threading.active_count()
    with socket.socket() as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(("127.0.0.1", sinks.web_port))
        slow.sendall(taking())
        for _ in range(60):
            sinks.rec.log("noise", rr.Image(np.random.default_rng(1).integers(0, 255, (400, 400, 3), np.uint8)))
        sinks.rec.flush(timeout_sec=10)
        eventually(lambda: threading.active_count() <= before, 20, "the end of its thread")


def test_connections_that_ask_for_nothing_of_the_stream_keep_no_visitor_out(sinks: Sinks) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(MOST_CONNECTIONS):
            silent = stack.enter_context(socket.create_connection(("127.0.0.1", sinks.web_port), timeout=20))
            silent.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0]))
            assert silent.recv(9), "rerun's server has greeted it"
        assert ask(sinks.web_port, "GET", "/", {})[0] in (200, 302)


def test_who_takes_the_stream_looks_and_who_only_knocks_does_not(sinks: Sinks) -> None:
    page = sinks.web_port
    eventually(lambda: sinks.audience().now == 0, 30, "those of the tests before are gone")
    before = sinks.audience()
    ask(page, "POST", READ, {"Host": "evil.example", **GRPC_WEB})
    ask(page, "GET", "/", {})
    assert sinks.audience() == before
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            viewer = stack.enter_context(socket.create_connection(("127.0.0.1", page), timeout=5))
            viewer.sendall(taking())
            assert viewer.recv(4) == b"HTTP"
        eventually(lambda: sinks.audience() == Audience(now=2, ever=before.ever + 2), 10, "both have taken it")
    eventually(lambda: sinks.audience().now == 0, 30, "both are gone")
    assert sinks.audience() == Audience(now=0, ever=before.ever + 2)


def test_rerun_itself_listens_where_no_one_looks(sinks: Sinks) -> None:
    assert sinks.page.server.behind is not None
    host, port = sinks.page.server.behind
    assert host.startswith("127.")
    assert (host, port) != ("127.0.0.1", sinks.web_port)
