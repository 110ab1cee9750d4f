"""The door of a router: what is no handshake is never passed on, and who fails often costs others nothing."""

import contextlib
import socket
import socketserver
import ssl
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.processes import eventually

from launch_scripts.launcher import router
from launch_scripts.launcher.router import FREE_TRIES, Door, Knocks, missing_of_hello, neighbourhood
from swarm.errors import BusError


def client_hello() -> bytes:
    """The first bytes of a client, from the library of the system."""
    sends = ssl.MemoryBIO()
    client = ssl.create_default_context().wrap_bio(ssl.MemoryBIO(), sends, server_hostname="router")
    with contextlib.suppress(ssl.SSLWantReadError):
        client.do_handshake()
    return sends.read()


HELLO = client_hello()


def test_each_part_of_a_client_hello_lacks_the_rest() -> None:
    assert missing_of_hello(HELLO) == 0
    assert all(0 < missing_of_hello(HELLO[:n]) <= len(HELLO) - n for n in range(len(HELLO)))


@given(st.binary(min_size=6, max_size=64))
def test_anything_else_is_refused_or_waits_for_a_bounded_rest(head: bytes) -> None:
    with contextlib.suppress(ValueError):
        assert missing_of_hello(head) <= router.MOST_HELLO_BYTES
        assert head[0] == 22
        assert head[5] == 1


STEPS = st.lists(
    st.tuples(st.sampled_from(["knock", "fail", "prove", "leave", "wait"]), st.floats(0, 3)), max_size=80
)


@given(STEPS)
def test_an_address_fails_seldom_and_no_other_one_notices(steps: list[tuple[str, float]]) -> None:
    knocks, now_s, unproved, proved, failures = Knocks(), 0.0, 0, 0, 0
    for what, waits_s in [("knock", 0.0)] * 10 + steps:
        now_s += waits_s
        if what == "knock":
            unproved += knocks.admits("10.0.0.1", now_s)
        elif what == "prove" and unproved:
            knocks.proved("10.0.0.1")
            unproved, proved = unproved - 1, proved + 1
        elif what == "fail" and unproved:
            knocks.ended("10.0.0.1", False, now_s)
            unproved, failures = unproved - 1, failures + 1
        elif what == "leave" and proved:
            knocks.ended("10.0.0.1", True, now_s)
            proved -= 1
        assert unproved <= FREE_TRIES + proved
        if not proved:
            assert failures <= FREE_TRIES + now_s / 2 + len(steps)
        assert knocks.admits("10.0.0.2", now_s)
        knocks.proved("10.0.0.2")
        knocks.ended("10.0.0.2", True, now_s)


def test_failures_alone_use_up_the_tries_of_an_address_and_are_forgotten() -> None:
    knocks = Knocks()
    for now_s in (0.0, 100.0):
        for _ in range(FREE_TRIES):
            assert knocks.admits("10.0.0.1", now_s)
            knocks.ended("10.0.0.1", False, now_s)
        assert not knocks.admits("10.0.0.1", now_s)
    assert not knocks.admits("10.0.0.1", 101.0)
    assert knocks.admits("10.0.0.1", 102.1)


def test_one_site_of_ip_6_has_one_budget() -> None:
    assert neighbourhood("2001:db8::1") == neighbourhood("2001:db8::ffff:1") != neighbourhood("2001:db8:0:1::1")
    assert neighbourhood("::ffff:10.0.0.1") == neighbourhood("10.0.0.1")
    assert neighbourhood("fe80::1%eth0") == neighbourhood("fe80::2")


class Inside(socketserver.ThreadingTCPServer):
    """A listener behind a door, which sends everything back."""

    daemon_threads = True
    accepted = 0

    def finish_request(self, request: Any, client_address: Any) -> None:
        self.accepted += 1
        while piece := request.recv(1 << 16):
            request.sendall(piece)


@pytest.fixture
def inside() -> Iterator[Inside]:
    with Inside(("127.0.0.1", 0), socketserver.BaseRequestHandler) as made:
        threading.Thread(target=made.serve_forever, args=(0.02,), daemon=True).start()
        yield made
        made.shutdown()


@pytest.fixture
def door(inside: Inside) -> Iterator[Door]:
    made = Door([("127.0.0.1", 0)], inside.socket.getsockname())
    yield made
    made.close()


def knock(door: Door, said: bytes = b"") -> socket.socket:
    connection = socket.create_connection(door.places[0], 10)
    connection.sendall(said)
    return connection


def test_bytes_pass_as_they_are_however_many(door: Door) -> None:
    sent = bytes(range(256)) * 20_000
    with knock(door, HELLO) as visitor:
        assert visitor.recv(1 << 16) == HELLO
        threading.Thread(target=visitor.sendall, args=(sent,), daemon=True).start()
        came = bytearray()
        while len(came) < len(sent):
            came += visitor.recv(1 << 16)
    assert bytes(came) == sent


def test_who_hangs_up_or_speaks_no_tls_is_not_passed_on(door: Door, inside: Inside) -> None:
    for said in (b"", HELLO[:40], HELLO, b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01\xff\xff" + bytes(99)):
        for _ in range(2 * FREE_TRIES):
            knock(door, said).close()
    with knock(door, HELLO) as visitor:
        assert visitor.recv(1)
    assert inside.accepted == 1


def test_the_oldest_silent_connection_gives_way(door: Door, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(router, "MOST_WAITING", 4)
    silent = [knock(door) for _ in range(12)]
    eventually(lambda: len(door.waiting) == 4, 10, "silent connections that are cut")
    with knock(door, HELLO) as visitor:
        assert visitor.recv(1)
    for each in silent:
        each.close()


def test_a_silent_connection_ends_by_itself(door: Door) -> None:
    with knock(door, HELLO[:9]) as silent, contextlib.suppress(ConnectionResetError):
        assert silent.recv(1) == b""


def test_a_router_that_reopens_is_no_fault_of_its_visitors(door: Door, inside: Inside) -> None:
    there, door.inner = door.inner, ("127.0.0.1", 1)
    for _ in range(2 * FREE_TRIES):
        with knock(door, HELLO) as visitor, contextlib.suppress(ConnectionResetError):
            assert visitor.recv(1) == b""
    door.inner = there
    with knock(door, HELLO) as visitor:
        assert visitor.recv(1)


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="no IPv6 here")
def test_a_door_at_all_addresses_of_ip_6_serves_ip_4_too(inside: Inside) -> None:
    door = Door([("::", 0)], inside.socket.getsockname())
    for host in ("127.0.0.1", "::1"):
        with socket.create_connection((host, door.places[0][1]), 10) as visitor:
            visitor.sendall(HELLO)
            assert visitor.recv(1)
    door.close()


def test_a_closed_door_frees_its_port_and_a_taken_one_is_named(door: Door) -> None:
    place = door.places[0]
    with pytest.raises(BusError, match=rf"cannot listen on 127.0.0.1:{place[1]}: .*is the port taken"):
        Door([place], door.inner)
    door.close()
    Door([place], door.inner).close()
