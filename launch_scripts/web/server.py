"""The HTTP server: who may come, how many at once, and for how long."""

from __future__ import annotations

import contextlib
import io
import math
import select
import socket
import socketserver
import sys
import threading
import time
import urllib.parse
from collections.abc import Mapping
from email.message import Message
from http.server import BaseHTTPRequestHandler
from typing import Any, NamedTuple, cast

from launch_scripts.web import LOOPBACK, Page
from swarm.errors import BusError

MOST_CONNECTIONS = 24
"""At once, of each server: a browser opens six."""
SEND_WITHIN_S = 20.0
"""A reader of the stream that takes nothing for so long is cut off."""
_HOSTS = frozenset((LOOPBACK, "localhost", "::1"))
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
        if len(found) > 1 or any(_host_of(f"//{each}" if name == "host" else each) not in _HOSTS for each in found):
            return f"{name} {', '.join(found)[:80]!r} is not this machine"
    if any(sign in value for value in headers.values() for sign in "\r\n"):
        return "a header goes on in another line"  # a server behind might read it otherwise
    return None


def _host_of(url: str) -> str | None:
    try:
        return urllib.parse.urlsplit(url).hostname
    except ValueError:
        return None


class Audience(NamedTuple):
    """Connections to the stream: how many there are now, and how many there have ever been."""

    now: int
    ever: int


class Server(socketserver.ThreadingTCPServer):
    """Answers requests, each connection on a thread of its own. At most `MOST_CONNECTIONS` are open at once.

    what     names the port in an error
    port     0 is any
    pages    path -> what answers it
    address  one beyond loopback serves visitors from elsewhere, too
    behind   address of rerun's server, to which requests for the stream are passed
    lasts_s  a connection that does not take the stream is cut after so long

    Requests are short: beyond the bound the oldest connection which has not taken the stream is closed for the new
    one, so that no client keeps others out by holding connections open. If all have taken it, the new one is cut.

    Raises BusError if it cannot listen there. The OSError is its cause.
    """

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    # Beyond this the system forgets the first knock of a visitor, who knocks again after a second, or seven.
    request_queue_size = 4 * MOST_CONNECTIONS

    def __init__(
        self,
        what: str,
        port: int,
        pages: Mapping[str, Page],
        address: str = LOOPBACK,
        *,
        behind: tuple[str, int] | None = None,
        lasts_s: float = 10.0,
    ) -> None:
        self.pages, self.behind, self.lasts_s = pages, behind, lasts_s
        self.guarded = address in _HOSTS
        self.address_family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._lock = threading.Lock()
        self._open: dict[socket.socket, float] = {}
        """Connection -> when it is cut, on the monotonic clock."""
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
        """Keeps a connection open."""
        with self._lock:
            if connection in self._open:
                self._open[connection] = math.inf
                self._kept += 1

    def audience(self) -> Audience:
        """The connections which `keep` lets last."""
        with self._lock:
            return Audience(sum(until_s == math.inf for until_s in self._open.values()), self._kept)

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            asking = (each for each, until_s in self._open.items() if until_s != math.inf)
            if len(self._open) >= MOST_CONNECTIONS and (oldest := next(asking, None)) is not None:
                del self._open[oldest]
                _cut(oldest)
            if fits := len(self._open) < MOST_CONNECTIONS:
                self._open[request] = time.monotonic() + self.lasts_s
        if fits:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Called twice a second: cuts connections whose time is over, so that their threads end."""
        now_s = time.monotonic()
        with self._lock:
            for connection, until_s in self._open.items():
                if now_s > until_s:
                    _cut(connection)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A visitor who leaves early is no error. All else is printed, as the library does."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


def _cut(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _Visit(BaseHTTPRequestHandler):
    """One request. The library bounds its size; HTTP/1.0 bounds a connection to one."""

    server: Server
    raw_requestline: bytes

    def setup(self) -> None:
        super().setup()
        self.connection.settimeout(self.server.lasts_s / 2)

    def parse_request(self) -> bool:
        """Returns True if a method is to answer: an HTTP/2 request is read no further, a foreign one gets no
        answer."""
        if self.raw_requestline == _HTTP_2 and self.server.behind is not None:
            self._pass_on(self.server.behind, _HTTP_2)
            return False
        if not super().parse_request():
            return False
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
            self.server.keep(self.connection)
            self.connection.settimeout(SEND_WITHIN_S)
            inner.sendall(head)
            ends = {self.connection: inner, inner: self.connection}
            while True:
                for source in select.select(ends, [], [])[0]:
                    piece = source.recv(1 << 16)
                    if not piece:
                        return
                    ends[source].sendall(piece)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing is logged here, as a log may be what hangs."""
