"""The router: a Zenoh session in router mode that passes on all messages, and its door.

Zenoh reads access control when a session opens, and closes no single link. When a name is revoked, the router
therefore reopens its session: all links end, and every admitted process is back within half a second, as after a
restart.

At the door of a router with certificates, strangers who knock cost members nothing. Zenoh's listener waits 100 ms
after each TLS handshake that fails, before it accepts the next connection (docs/design/security.md). The door
listens in its place. A connection is passed on once it has sent a whole ClientHello, and as long as its address has
failed seldom. The bytes pass as they are, so the names in certificates reach Zenoh.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import resource
import socket
import threading
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import cast

import msgspec

from launch_scripts.ports import free_ports
from launch_scripts.process_table import admitting_all
from launch_scripts.web import LOOPBACK
from swarm.bus.bus import Bus, Event, Post
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.clock import MonotonicClock
from swarm.config.revocations import with_revocations
from swarm.config.scenario import NetworkConfig
from swarm.endpoints import host_port, why_not_listening
from swarm.errors import BusError, SwarmError
from swarm.peers import Peer
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import NO_RUN, Member, MemberService
from swarm.runtime.process import Process
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.run_secret import authenticator_of
from swarm.wire.messages import WIRE_VERSION
from swarm.wire.messages.processes import RunInfo

PROVED_AFTER_S = 1.5
"""A connection that lasts for this time has a certificate: Zenoh ends a handshake that takes `HANDSHAKE_S`."""
HANDSHAKE_S = 1.0
"""Limit of a TLS handshake, which the router sets. Chosen, not measured."""
PROVED_BY_REPLIES = 4
"""A router replies three times at most to a handshake that fails: HelloRetryRequest, its own part, an alert."""
HELLO_WITHIN_S = 2.0
"""A client sends its ClientHello as soon as it is connected."""
_HANGS_UP_WITHIN_S = 0.02
MOST_HELLO_BYTES = 1 << 13
"""A ClientHello of common libraries has 300 to 1,800 bytes."""
MOST_WAITING = 16_384
"""Connections without a whole ClientHello. Beyond it the oldest is cut."""
FREE_TRIES = 32
"""Connections of one address that are not proved or have failed. Each one that is proved allows another."""
_FORGIVEN_PER_S = 0.5
"""Failures of an address that are forgotten each second: they keep Zenoh's listener busy for a twentieth of it."""
_MOST_ADDRESSES = 1 << 14
"""Addresses whose connections are counted: bounds the memory. New ones beyond are refused. Chosen, not measured."""
_BACKLOG = 4096
"""Connections that the kernel may keep until they are accepted; it cuts the number to net.core.somaxconn."""
_LISTEN_WITHIN_S = 10.0
"""Time for the thread of the door to listen, and to end. Chosen, not measured."""
_RECORD, _HANDSHAKE, _CLIENT_HELLO = 5, 22, 1
"""Bytes of a TLS record's header, its type of a handshake, and the handshake's type of a ClientHello (RFC 8446)."""


def missing_of_hello(head: bytes) -> int:
    """Returns how many bytes a ClientHello lacks at least, 0 if it is whole. Raises ValueError on anything else."""
    if head[:1] not in (b"", bytes([_HANDSHAKE])) or head[1:2] not in (b"", b"\x03"):
        raise ValueError("no TLS record of a handshake")
    if len(head) < _RECORD:
        return _RECORD - len(head)
    size = int.from_bytes(head[3:5], "big")
    if not 4 <= size <= MOST_HELLO_BYTES or head[5:6] not in (b"", bytes([_CLIENT_HELLO])):
        raise ValueError("no ClientHello")
    return max(_RECORD + size - len(head), 0)


@dataclass(slots=True)
class _Tries:
    """Connections of one address: passed on and not proved yet, proved and open, failed and not forgotten."""

    unproved: int = 0
    proved: int = 0
    failed: float = 0.0
    since_s: float = 0.0

    def at(self, now_s: float) -> _Tries:
        """Forgets failures for the time that has passed, and returns itself."""
        self.failed = max(self.failed - (now_s - self.since_s) * _FORGIVEN_PER_S, 0.0)
        self.since_s = now_s
        return self

    @property
    def any(self) -> bool:
        return bool(self.unproved or self.proved or self.failed)


class Knocks:
    """Judge of which connections are passed on, by address. Pure: times are in seconds of any clock."""

    def __init__(self) -> None:
        self._tries: dict[str, _Tries] = {}

    def admits(self, address: str, now_s: float) -> bool:
        """Returns True if a connection is passed on; it counts as unproved then."""
        if address not in self._tries and len(self._tries) >= _MOST_ADDRESSES:
            self._tries = {each: tries for each, tries in self._tries.items() if tries.at(now_s).any}
            if len(self._tries) >= _MOST_ADDRESSES:
                return False
        tries = self._tries.setdefault(address, _Tries(since_s=now_s)).at(now_s)
        if tries.unproved + tries.failed + 1 > FREE_TRIES + tries.proved:
            return False
        tries.unproved += 1
        return True

    def proved(self, address: str) -> None:
        """Takes note that a connection has a certificate."""
        self._tries[address].unproved -= 1
        self._tries[address].proved += 1

    def ended(self, address: str, proved: bool, now_s: float) -> None:
        """Takes note of the end of a connection that was passed on."""
        tries = self._tries[address].at(now_s)
        if proved:
            tries.proved -= 1
        else:
            tries.unproved -= 1
            tries.failed += 1


def neighbourhood(host: str) -> str:
    """Returns the address that a budget belongs to: of IPv6 the network of one site, which has 2^64 of them."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address):
        return str(address.ipv4_mapped or ipaddress.ip_network((address, 64), strict=False))
    return str(address)


class _End(asyncio.BufferedProtocol):
    """One end of a connection that is passed on: what it receives goes to the other end.

    All share one buffer, as one thread reads it: asyncio's own protocol takes 256 KiB of memory for each message.
    """

    transport: asyncio.Transport
    other: _End | None = None
    _buffer = memoryview(bytearray(1 << 16))

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.received(bytes(self._buffer[:nbytes]))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)

    def received(self, data: bytes) -> None:
        """Passes data on."""
        if self.other is not None:
            self.other.transport.write(data)

    def pause_writing(self) -> None:
        if self.other is not None:
            self.other.transport.pause_reading()

    def resume_writing(self) -> None:
        if self.other is not None:
            self.other.transport.resume_reading()

    def connection_lost(self, error: Exception | None) -> None:
        if self.other is not None:
            self.other.transport.close()


class _Visitor(_End):
    """A connection from outside."""

    def __init__(self, door: Door) -> None:
        self._door = door
        self._head = b""
        self._address: str | None = None
        """Once it is passed on."""
        self._proved = False
        self._spoke = True
        self._turns = 0
        """Number of replies of the router."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._door.accepted(self)
        asyncio.get_running_loop().call_later(HELLO_WITHIN_S, self._cut_if_slow)

    def received(self, data: bytes) -> None:
        self._spoke = True
        if self.other is not None:
            self.other.transport.write(data)
        elif not self.transport.is_closing():
            self._head += data
            self._knock()

    def _knock(self) -> None:
        """Takes note of a whole ClientHello. It is passed on unless its sender hangs up at once."""
        try:
            if missing_of_hello(self._head):
                return
        except ValueError:
            self.transport.abort()
            return
        if self._door.waiting.pop(self, self) is None:
            asyncio.get_running_loop().call_later(_HANGS_UP_WITHIN_S, self._pass_on)
        elif len(self._head) > 2 * MOST_HELLO_BYTES:
            self.transport.abort()

    def _pass_on(self) -> None:
        if self.transport.is_closing():
            return
        loop = asyncio.get_running_loop()
        address = neighbourhood(self.transport.get_extra_info("peername")[0])
        if not self._door.knocks.admits(address, loop.time()):
            self.transport.abort()
            return
        self._address = address
        self.transport.pause_reading()
        self._joining = loop.create_task(self._join())  # kept here, as its loop does not
        loop.call_later(PROVED_AFTER_S, self._prove)

    async def _join(self) -> None:
        try:
            _, inner = await asyncio.get_running_loop().create_connection(lambda: _Inner(self), *self._door.inner)
        except OSError:  # the router reopens its session, for which no visitor is to blame
            self._prove()
            self.transport.abort()
            return
        inner.other, self.other = self, inner
        if self.transport.is_closing():
            inner.transport.abort()
            return
        inner.transport.write(self._head)
        self.transport.resume_reading()

    def replied(self) -> None:
        """Takes note that the router has sent something."""
        if self._spoke:
            self._spoke = False
            self._turns += 1
            if self._turns == PROVED_BY_REPLIES:
                self._prove()

    def _cut_if_slow(self) -> None:
        if self in self._door.waiting:
            self.transport.abort()

    def _prove(self) -> None:
        if self._address is not None and not self._proved:
            self._proved = True
            self._door.knocks.proved(self._address)

    def connection_lost(self, error: Exception | None) -> None:
        super().connection_lost(error)
        self._door.left(self)
        if self._address is not None:
            self._door.knocks.ended(self._address, self._proved, asyncio.get_running_loop().time())
            self._address = None


class _Inner(_End):
    """A connection to the router's own listener."""

    def __init__(self, visitor: _Visitor) -> None:
        self._visitor = visitor

    def received(self, data: bytes) -> None:
        self._visitor.transport.write(data)
        self._visitor.replied()


class Door:
    """Listens at places, and passes connections on to a port of this machine. Raises BusError if it cannot listen.

    inner  host and port of Zenoh's listener
    """

    def __init__(self, places: Sequence[tuple[str, int]], inner: tuple[str, int]) -> None:
        self.inner = inner
        self.knocks = Knocks()
        self.waiting: dict[_Visitor, None] = {}
        """Connections without a whole ClientHello, the oldest first."""
        self._open: set[_Visitor] = set()
        self.places: list[tuple[str, int]] = []
        """Host and port of each socket that listens."""
        self._servers: list[asyncio.Server] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="door", daemon=True)
        self._thread.start()
        try:
            for host, port in places:
                self._do(self._listen(host, port))
        except OSError as error:
            self.close()
            raise BusError(f"cannot listen on {host}:{port}: {why_not_listening(error)}") from error

    def close(self) -> None:
        """Stops listening, and ends all connections. May be repeated."""
        if not self._thread.is_alive():
            return
        self._do(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_LISTEN_WITHIN_S)

    def _do(self, what: Coroutine[object, object, None]) -> None:
        asyncio.run_coroutine_threadsafe(what, self._loop).result(_LISTEN_WITHIN_S)

    async def _listen(self, host: str, port: int) -> None:
        if host == "::":  # of both protocols, as Zenoh listens; asyncio would leave IPv4 out
            listening = socket.create_server((host, port), family=socket.AF_INET6, dualstack_ipv6=True)
            server = await self._loop.create_server(lambda: _Visitor(self), sock=listening, backlog=_BACKLOG)
        else:
            server = await self._loop.create_server(lambda: _Visitor(self), host, port, backlog=_BACKLOG)
        self._servers.append(server)
        self.places += [each.getsockname()[:2] for each in server.sockets]

    async def _end(self) -> None:
        for server in self._servers:
            server.close()
        for visitor in self._open:
            visitor.transport.abort()
        await asyncio.sleep(0)

    # --- what its connections tell, on the door's own thread

    def accepted(self, visitor: _Visitor) -> None:
        """Takes note of a new connection."""
        if len(self.waiting) >= MOST_WAITING:
            oldest = next(iter(self.waiting))
            del self.waiting[oldest]
            oldest.transport.abort()
        self.waiting[visitor] = None
        self._open.add(visitor)

    def left(self, visitor: _Visitor) -> None:
        """Takes note that a connection has ended."""
        self.waiting.pop(visitor, None)
        self._open.discard(visitor)


log = logging.getLogger(__name__)

_OPEN_WITHIN_S = 5.0
"""Ten times what it takes: links end and are back within half a second (docs/operate/access.md). A port that is
taken for longer belongs to another program."""


class RouterService(MemberService):
    """Belongs to no run, so it may be stopped, started again and replaced while runs go on around it.

    reopened  asked at each tick: the bus in place of the one before, which is closed; None: it stays
    restarts  how often its launcher started it again
    """

    def __init__(
        self,
        peer: Peer,
        bus: Bus,
        post: Post,
        reopened: Callable[[], Bus | None] = lambda: None,
        *,
        restarts: int = 0,
    ) -> None:
        info = RunInfo(
            run_id=NO_RUN, role=peer.role, id=peer.id, incarnation=peer.incarnation, scenario="", terrain="",
            rows=0, cols=0, resolution_m=0.0, started_ns=peer.incarnation, restarts=restarts,
            wire_version=WIRE_VERSION,
        )  # fmt: skip
        self._member = Member(info, bus, post)
        self._reopened = reopened

    def start(self, now_ns: int) -> None:
        self._member.join()

    def handle(self, event: Event, now_ns: int) -> None:
        self._member.on_member_event(event)

    def tick(self, now_ns: int) -> None:
        if (bus := self._reopened()) is not None:
            self._member.move_to(bus)
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._member.publish_stats(now_ns)


class Admission:
    """The router's session, behind a door at its `tls/` endpoints, and reopened whenever the list of revoked names
    changes. Raises BusError if it cannot listen."""

    def __init__(self, network: NetworkConfig) -> None:
        self._authenticator = authenticator_of(network, "")  # a router belongs to no run
        self._network, self._door = network, None
        if outside := [endpoint for endpoint in network.listen if endpoint.startswith("tls/")]:
            inner = LOOPBACK, free_ports(1)[0]
            self._door = Door([host_port(each) for each in outside], inner)
            within = f"tls/{inner[0]}:{inner[1]}#tls_handshake_timeout_ms={HANDSHAKE_S * 1000:.0f}"
            others = tuple(each for each in network.listen if each not in outside)
            self._network = msgspec.structs.replace(network, listen=(*others, within))
        self._admitting = with_revocations(self._network)
        self._failure = ""
        """Reason why the file of revoked names could not be read at the last look."""
        self.bus = self._opened(within_s=0.0)

    def close(self) -> None:
        """Leaves the network."""
        if self._door is not None:
            self._door.close()
        self.bus.close()

    def reopened(self) -> ZenohBus | None:
        """The new session, if one was opened. If the list cannot be read, the previous one stays in force."""
        try:
            admitting = with_revocations(self._network)
        except SwarmError as error:
            if str(error) != self._failure:
                log.error("%s; the names that were revoked before stay so", error)
            self._failure = str(error)
            return None
        self._failure = ""
        if admitting == self._admitting:
            return None
        log.warning("revoked names: %s; reopening the session", ", ".join(admitting.revoked) or "none")
        self._admitting = admitting
        self.bus.close()
        self.bus = self._opened(_OPEN_WITHIN_S)
        return self.bus

    def _opened(self, within_s: float) -> ZenohBus:
        until_s = time.monotonic() + within_s
        while True:
            try:
                return open_bus(self._admitting, mode="router", authenticator=self._authenticator)
            except BusError:  # the port is free only once the last link has ended
                if time.monotonic() > until_s:
                    raise
                time.sleep(0.05)


def run(setup: RoleSetup, built: Callable[[], None]) -> None:
    clock, inbox = MonotonicClock(), Inbox()
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # each connection, silent ones included, is a file
    admission = Admission(admitting_all(setup.scenario).network)
    try:
        peer = Peer(setup.role, setup.id, setup.incarnation)
        service = RouterService(peer, admission.bus, inbox.post, admission.reopened, restarts=setup.restarts)
        process = Process(service, inbox, clock, tick_hz=2.0, health=setup.health)
        process.stop_on_signals()
        built()
        process.run()
    finally:
        admission.close()
