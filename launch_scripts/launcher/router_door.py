"""The door of a router with certificates: strangers who knock cost members nothing.

Zenoh's listener waits 100 ms after each TLS handshake that fails, before it accepts the next connection
(docs/design/security.md). This door listens in its place. A connection is passed on once it has sent a whole
ClientHello, and as long as its address has failed seldom. The bytes pass as they are, so the names in certificates
reach Zenoh.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
import threading
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import cast

from swarm.bus.endpoints import why_not_listening
from swarm.errors import BusError

PROVED_AFTER_S = 1.5
"""A connection that lasts for this time has a certificate: Zenoh ends a handshake that takes `HANDSHAKE_S`."""
HANDSHAKE_S = 1.0
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
_BACKLOG = 4096
_LISTEN_WITHIN_S = 10.0
_RECORD, _HANDSHAKE, _CLIENT_HELLO = 5, 22, 1


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
    """One end of a connection that is passed on: what it receives goes to the other end, and is kept before there
    is one.

    All share one buffer, as one thread reads it: asyncio's own protocol takes 256 KiB of memory for each message.

    begins  is called once it is connected
    """

    transport: asyncio.Transport
    _buffer = memoryview(bytearray(1 << 16))

    def __init__(self, begins: Callable[[_End], object] = lambda _: None) -> None:
        self._begins = begins
        self.other: _End | None = None
        self.kept = b""
        self.spoke = True
        """True until the other end replies."""
        self.replies = 0
        self.ended = False
        self._news = asyncio.Event()

    async def until(self, done: Callable[[], bool]) -> None:
        """Returns once something is so, or this end is closed."""
        while not (self.ended or done()):
            self._news.clear()
            await self._news.wait()

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._buffer[:nbytes])
        self.spoke = True
        if self.other is None:
            self.kept += data
            self._news.set()
            if len(self.kept) > 2 * MOST_HELLO_BYTES:
                self.transport.abort()
            return
        self.other.transport.write(data)
        if self.other.spoke:
            self.other.spoke = False
            self.replies += 1
            if self.replies == PROVED_BY_REPLIES:
                self.other._news.set()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self._begins(self)

    def pause_writing(self) -> None:
        if self.other is not None:
            self.other.transport.pause_reading()

    def resume_writing(self) -> None:
        if self.other is not None:
            self.other.transport.resume_reading()

    def connection_lost(self, error: Exception | None) -> None:
        self.ended = True
        self._news.set()
        if self.other is not None:
            self.other.transport.close()


class Door:
    """Listens at places, and passes connections on to a port of this machine. Raises BusError if it cannot listen.

    inner  host and port of Zenoh's listener
    """

    def __init__(self, places: Sequence[tuple[str, int]], inner: tuple[str, int]) -> None:
        self.inner = inner
        self.knocks = Knocks()
        self.waiting: dict[_End, None] = {}
        """Connections without a whole ClientHello, the oldest first."""
        self._visits: dict[_End, asyncio.Task[None]] = {}
        """All connections from outside."""
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
            server = await self._loop.create_server(lambda: _End(self._accepted), sock=listening, backlog=_BACKLOG)
        else:
            server = await self._loop.create_server(lambda: _End(self._accepted), host, port, backlog=_BACKLOG)
        self._servers.append(server)
        self.places += [each.getsockname()[:2] for each in server.sockets]

    async def _end(self) -> None:
        for server in self._servers:
            server.close()
        for visitor, visit in self._visits.items():
            visitor.transport.abort()
            visit.cancel()
        await asyncio.gather(*self._visits.values(), return_exceptions=True)

    def _accepted(self, visitor: _End) -> None:
        if len(self.waiting) >= MOST_WAITING:
            self._cut(next(iter(self.waiting)))
        self.waiting[visitor] = None
        self._loop.call_later(HELLO_WITHIN_S, self._cut, visitor)
        self._visits[visitor] = self._loop.create_task(self._visit(visitor))

    def _cut(self, visitor: _End) -> None:
        """Ends a connection which has not sent a whole ClientHello."""
        if visitor in self.waiting:
            del self.waiting[visitor]
            visitor.transport.abort()

    async def _visit(self, visitor: _End) -> None:
        """Passes a connection on once it has sent a whole ClientHello, unless its sender hangs up at once."""
        try:
            await visitor.until(lambda: not missing_of_hello(visitor.kept))
            self.waiting.pop(visitor, None)
            if not visitor.ended:
                await asyncio.sleep(_HANGS_UP_WITHIN_S)
            if not visitor.ended:
                await self._pass_on(visitor)
        except ValueError:
            visitor.transport.abort()
        finally:
            self.waiting.pop(visitor, None)
            del self._visits[visitor]

    async def _pass_on(self, visitor: _End) -> None:
        """Connects it to the router, if its address has tries left, and learns whether it has a certificate."""
        address = neighbourhood(visitor.transport.get_extra_info("peername")[0])
        if not self.knocks.admits(address, self._loop.time()):
            visitor.transport.abort()
            return
        visitor.transport.pause_reading()
        inner, is_proved = _End(), True
        inner.other = visitor
        try:
            await self._loop.create_connection(lambda: inner, *self.inner)
        except OSError:  # the router reopens its session, for which no visitor is to blame
            visitor.transport.abort()
        else:
            visitor.other = inner
            inner.transport.write(visitor.kept)
            visitor.transport.resume_reading()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PROVED_AFTER_S):
                    await visitor.until(lambda: inner.replies >= PROVED_BY_REPLIES)
            is_proved = inner.replies >= PROVED_BY_REPLIES or not visitor.ended
        if is_proved:
            self.knocks.proved(address)
        await visitor.until(lambda: False)
        self.knocks.ended(address, is_proved, self._loop.time())
