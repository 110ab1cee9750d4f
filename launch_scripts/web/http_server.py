"""The HTTP server: who may come, how many at once, and for how long."""

from __future__ import annotations

import contextlib
import io
import math
import re
import select
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from email.message import Message
from enum import IntEnum
from http.server import BaseHTTPRequestHandler
from typing import Any, NamedTuple, cast

from launch_scripts.web import LOOPBACK, PROBED, Page
from swarm.endpoints import is_loopback
from swarm.errors import BusError

MOST_CONNECTIONS = 24
"""At once, of each server: a browser opens six."""
_MOST_PEEKED = 1 << 13
"""Bytes of a request that are looked at before its thread reads them: a browser's has 1 kB, a probe's 100 bytes."""
SEND_WITHIN_S = 20.0
"""A reader of the stream that takes nothing for this time is cut off."""
_AUTHORITY = r"(?:([A-Za-z0-9.]+)|\[([0-9A-Fa-f:.]+)\])(?::[0-9]{1,5})?"
_SAYS_HOST = {"host": re.compile(_AUTHORITY), "origin": re.compile(f"https?://{_AUTHORITY}")}
"""A name or address and a port, and nothing else: parsers of URLs disagree about all other forms."""
_GREETING_BYTES = 100
"""More than rerun's server says to a connection that asks for nothing."""
_HTTP_2 = b"PRI * HTTP/2.0\r\n"
"""The first line of HTTP/2 in the clear, which native viewers speak and no browser does."""
_HEADERS = {
    # No requests to other hosts: usage data, fonts, release news.
    "Content-Security-Policy": (
        "default-src 'self' blob: data:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
        "style-src 'self' 'unsafe-inline'; worker-src 'self' blob:; connect-src 'self'"
    ),
    "Cache-Control": "no-cache",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
}


def refusal(headers: Message) -> str | None:
    """Says why a request is not served; None if it is. Any port will do: a tunnel begins where it likes."""
    for name in ("host", "origin"):
        found = headers.get_all(name, [""] if name == "host" else [])
        if len(found) > 1 or not all(_names_this_machine(name, each) for each in found):
            return f"{name} {', '.join(found)[:80]!r} is not this machine"
    if any(sign in value for value in headers.values() for sign in "\r\n"):
        return "a header goes on in another line"  # a server behind might read it otherwise
    return None


def _names_this_machine(header: str, value: str) -> bool:
    match = _SAYS_HOST[header].fullmatch(value)
    return match is not None and is_loopback((match[1] or match[2]).lower())


class Audience(NamedTuple):
    """Connections to the stream: how many there are now, and how many there have ever been."""

    now: int
    ever: int


class Haste(IntEnum):
    """Speed at which a connection frees its place. Where there are too many, the slowest kind is cut first."""

    ASKS = 0
    """It has not finished its request, which may take as long as it likes."""
    READS = 1
    """It gets an answer, which may be long."""
    PROBES = 2
    """It gets an answer about health, which is short."""


def _haste(head: bytes) -> Haste:
    """The kind of a connection, from the bytes that it has sent."""
    if b"\r\n\r\n" not in head:
        return Haste.ASKS
    path = head.split(b" ", 2)[1:2]
    return Haste.PROBES if path and path[0].decode("latin1") in PROBED else Haste.READS


@dataclass(slots=True)
class _Visitor:
    """An open connection.

    until_s  when it is cut, on the monotonic clock
    haste    as far as its thread has read it
    """

    until_s: float
    haste: Haste = Haste.ASKS


class Server(socketserver.ThreadingTCPServer):
    """Answers requests, each connection on a thread of its own. At most `MOST_CONNECTIONS` are open at once.

    what     names the port in an error
    port     0 is any
    pages    path -> what answers it
    address  one beyond loopback serves visitors from elsewhere, too
    lasts_s  a connection that does not take the stream is cut after this time

    Requests are short: beyond the bound the slowest connection which has not taken the stream is closed for the new
    one, so that no client keeps others out by holding connections open: first one that has not finished its
    request, then a reader, then a probe, and of one kind the oldest. Probes therefore lose their place to probes
    only. If all have taken the stream, the new one is cut.

    Raises BusError if it cannot listen there. The OSError is its cause.
    """

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    # Beyond this the system forgets the first knock of a visitor, who knocks again after a second, or seven.
    request_queue_size = 4 * MOST_CONNECTIONS

    def __init__(
        self, what: str, port: int, pages: Mapping[str, Page], address: str = LOOPBACK, *, lasts_s: float = 10.0
    ) -> None:
        self.pages, self.lasts_s = pages, lasts_s
        self.behind: tuple[str, int] | None = None
        """Address of rerun's server, to which requests for the stream are passed."""
        self.guarded = is_loopback(address)
        self.address_family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._lock = threading.Lock()
        self._open: dict[socket.socket, _Visitor] = {}
        """Connections, the oldest first."""
        self._kept = 0
        """Connections that ever took the stream."""
        try:
            super().__init__((address, port), _Visit)
        except (OSError, OverflowError) as error:
            there = f"{port}" if address == LOOPBACK else f"{port} at {address}"
            raise BusError(f"{what} {there} cannot be opened: {getattr(error, 'strerror', error)}") from error
        self.port = int(self.server_address[1])
        self.url = f"http://{f'[{address}]' if ':' in address else address}:{self.port}"
        threading.Thread(target=self.serve_forever, name=what, daemon=True).start()

    def close(self) -> None:
        """Stops listening, and cuts all connections."""
        self.shutdown()
        self.server_close()
        with self._lock:
            for connection in self._open:
                _cut(connection)

    def keep(self, connection: socket.socket) -> None:
        """Keeps a connection open, from the first call on."""
        with self._lock:
            if connection in self._open and self._open[connection].until_s != math.inf:
                self._open[connection].until_s = math.inf
                self._kept += 1

    def asked(self, connection: socket.socket, path: str) -> None:
        """Notes that a connection has finished its request."""
        with self._lock:
            if connection in self._open:
                self._open[connection].haste = Haste.PROBES if path in PROBED else Haste.READS

    def audience(self) -> Audience:
        """The connections which `keep` lets last."""
        with self._lock:
            return Audience(sum(each.until_s == math.inf for each in self._open.values()), self._kept)

    def process_request(self, request: Any, client_address: Any) -> None:
        request.settimeout(self.lasts_s / 2)
        with self._lock:
            if len(self._open) >= MOST_CONNECTIONS and (slowest := self._slowest()) is not None:
                del self._open[slowest]
                _cut(slowest)
            if fits := len(self._open) < MOST_CONNECTIONS:
                self._open[request] = _Visitor(time.monotonic() + self.lasts_s)
        if fits:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def _slowest(self) -> socket.socket | None:
        """The connection that is cut for a new one. What a thread has not read yet counts, too: it may be late."""
        short = [(each, visitor.haste) for each, visitor in self._open.items() if visitor.until_s != math.inf]
        return min(short, key=lambda each: each[1] or _haste(_waiting(each[0])), default=(None, 0))[0]

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Called twice a second: cuts connections whose time is over, so that their threads end."""
        now_s = time.monotonic()
        with self._lock:
            for connection, visitor in self._open.items():
                if now_s > visitor.until_s:
                    _cut(connection)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A visitor who leaves early is no error. All else is printed, as the library does."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


def _cut(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def _waiting(connection: socket.socket) -> bytes:
    """The bytes that a connection has sent and its thread has not read."""
    # The socket itself would wait until its timeout where its thread takes the bytes first, and all others with it.
    with contextlib.suppress(OSError), connection.dup() as copy:  # it may have been closed meanwhile
        copy.setblocking(False)
        return copy.recv(_MOST_PEEKED, socket.MSG_PEEK)
    return b""


class _Visit(BaseHTTPRequestHandler):
    """One request. The library bounds its size; HTTP/1.0 bounds a connection to one."""

    server: Server
    raw_requestline: bytes

    def parse_request(self) -> bool:
        """Returns True if a method is to answer: an HTTP/2 request is read no further, a foreign one gets no
        answer."""
        if self.raw_requestline == _HTTP_2 and self.server.behind is not None:
            self._pass_on(self.server.behind, _HTTP_2)
            return False
        if not super().parse_request():
            return False
        self.server.asked(self.connection, self.path.partition("?")[0])
        why = refusal(self.headers) if self.server.guarded else None
        if why is not None:
            self.send_error(403, "only visitors from this machine are served", why)
        return why is None

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        page = self.server.pages.get(path)
        if page is None:
            self.send_error(404, explain=f"There is {' and '.join(self.server.pages) or 'no page'}.")
            return
        reply = page(query, self.headers)
        self.send_response(reply.code)
        its = {"Content-Type": reply.content_type, "Content-Length": str(len(reply.content))}
        for name, value in {**_HEADERS, **its, **reply.headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(reply.content)

    def do_POST(self) -> None:
        """Passes on what a viewer asks rerun's server, as it was checked, and one request a connection."""
        if self.server.behind is None or not self.path.startswith("/rerun."):
            self.send_error(404)
            return
        del self.headers["connection"], self.headers["keep-alive"]  # they are of this connection only
        passed = [f"{name}: {value}" for name, value in self.headers.items()]
        head = "\r\n".join([f"{self.command} {self.path} HTTP/1.1", *passed, "Connection: close", "", ""])
        self._pass_on(self.server.behind, head.encode("latin1"))

    do_HEAD, do_OPTIONS = do_GET, do_POST  # noqa: N815 (the library calls them so)

    def _pass_on(self, behind: tuple[str, int], head: bytes) -> None:
        """Joins the visitor with rerun's server, until one of them has no more to say."""
        self.close_connection = True
        self.connection.settimeout(0.0)
        head += cast("io.BufferedReader", self.rfile).peek()  # bytes read beyond the head
        with socket.create_connection(behind, timeout=SEND_WITHIN_S) as inner:
            self.connection.settimeout(SEND_WITHIN_S)
            inner.sendall(head)
            ends = {self.connection: inner, inner: self.connection}
            while True:
                for source in select.select(ends, [], [])[0]:
                    piece = source.recv(1 << 16)
                    if not piece:
                        return
                    if source is inner and len(piece) > _GREETING_BYTES:
                        self.server.keep(self.connection)
                    ends[source].sendall(piece)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing is logged here, as a log may be what hangs."""
