"""What both servers of the live view share: who may come, how many, and for how long.

A page of another site can make a browser on this machine connect to any loopback port, and can even have its own
name lead there (DNS rebinding). Such a request carries the other site's name as Host or as Origin.
"""

from __future__ import annotations

import contextlib
import math
import socket
import socketserver
import threading
import time
import urllib.parse
from collections.abc import Mapping
from typing import Any, NamedTuple

LOOPBACK = "127.0.0.1"
MOST_CONNECTIONS = 24
"""At once, of each server: a browser opens six."""
_HOSTS = frozenset((LOOPBACK, "localhost", "::1"))


def refusal(headers: Mapping[str, str]) -> str | None:
    """Why a request is not served, None if it is. Any port will do: a tunnel begins where it likes."""
    host = headers.get("host", "")
    if _name_of(f"//{host}") not in _HOSTS:
        return f"Host {host[:80]!r} is not this machine"
    origin = headers.get("origin")
    if origin is not None and _name_of(origin) not in _HOSTS:
        return f"Origin {origin[:80]!r} is not this machine"
    return None


def _name_of(url: str) -> str | None:
    try:
        return urllib.parse.urlsplit(url).hostname
    except ValueError:
        return None


class Audience(NamedTuple):
    """Connections that last: how many there are now, and how many there have ever been."""

    now: int
    ever: int


class BoundedServer(socketserver.ThreadingTCPServer):
    """A thread for each connection, of which there are `MOST_CONNECTIONS` at most: who comes beyond is closed.

    lasts_s       a connection is cut after so long, unless its handler calls `keep`
    newest_first  who comes beyond is let in, and the oldest connection is cut for it: where requests are short, one
                  who holds connections open keeps nobody else out
    """

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    # Of more that come at once the system forgets the first knock, and they knock again after a second, or seven.
    request_queue_size = 4 * MOST_CONNECTIONS
    lasts_s = 60.0
    newest_first = False

    def __init__(self, port: int, handler: type[socketserver.BaseRequestHandler], address: str = LOOPBACK) -> None:
        self.address_family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._lock = threading.Lock()
        self._open: dict[socket.socket, float] = {}
        """Connection -> when it is cut, on the monotonic clock."""
        self._kept = 0
        """Connections for which `keep` was ever called."""
        super().__init__((address, port), handler)

    @property
    def port(self) -> int:
        return int(self.server_address[1])

    def close(self) -> None:
        """Listen no more, and cut all connections."""
        self.shutdown()
        self.server_close()
        with self._lock:
            for connection in self._open:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def keep(self, connection: socket.socket) -> None:
        """Let a connection last."""
        with self._lock:
            if connection in self._open:
                self._open[connection] = math.inf
                self._kept += 1

    def audience(self) -> Audience:
        """Who watches: those whose connections `keep` lets last."""
        with self._lock:
            return Audience(sum(until_s == math.inf for until_s in self._open.values()), self._kept)

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            full = len(self._open) >= MOST_CONNECTIONS
            if full and self.newest_first:
                oldest = next(iter(self._open))
                del self._open[oldest]
                with contextlib.suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)
                full = False
            if not full:
                self._open[request] = time.monotonic() + self.lasts_s
        if full:
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

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
                    with contextlib.suppress(OSError):
                        connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A visitor who leaves early is no error; all else ends the thread with its reason, as any other would."""
        import sys

        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)
