"""Serves what machines ask of this one over HTTP: health, and figures if there are any.

Each visitor has a thread of its own, which takes no lock of a loop that it tells of; nothing is logged here, as a
log may be what hangs. A request is bounded in size and time by the library and by `BoundedServer`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from http.server import BaseHTTPRequestHandler
from typing import Any, NamedTuple

from launch_scripts.web.health_verdict import HEALTHY, READY, Process, verdict
from launch_scripts.web.loopback_guard import LOOPBACK, BoundedServer, refusal
from swarm.errors import BusError

_REQUEST_S = 5.0
"""A visitor who takes longer is cut."""


class Reply(NamedTuple):
    """What a visitor gets."""

    code: int
    content_type: str
    content: bytes


Page = Callable[[Mapping[str, str]], Reply]
"""Headers, with names in small letters -> the reply. Called on a visitor's thread."""


def health_pages(processes: Callable[[], Sequence[Process]]) -> dict[str, Page]:
    """The two pages that probes ask for: 200 if all is well, 503 otherwise, with the reasons as JSON."""

    def page(question: str) -> Page:
        def answer(headers: Mapping[str, str]) -> Reply:
            found = verdict(question, processes(), time.monotonic_ns())
            return Reply(200 if found.ok else 503, "application/json", found.body)

        return answer

    return {question: page(question) for question in (HEALTHY, READY)}


class PageServer:
    """Raises BusError if the port is taken, or the address is none of this machine's; port 0 is any.

    what     names the option in that error
    address  others than that of loopback serve visitors from elsewhere, too
    """

    def __init__(self, what: str, port: int, pages: Mapping[str, Page], address: str = LOOPBACK) -> None:
        try:
            self._server = _Server(port, _Handler, address)
        except (OSError, OverflowError) as error:
            there = f"{port}" if address == LOOPBACK else f"{port} at {address}"
            raise BusError(f"{what} {there} cannot be opened: {getattr(error, 'strerror', error)}") from error
        self._server.pages = dict(pages)
        self._server.guarded = address in (LOOPBACK, "::1", "localhost")
        threading.Thread(target=self._server.serve_forever, name=what, daemon=True).start()
        host = f"[{address}]" if ":" in address else address
        self.url = f"http://{host}:{self._server.port}"

    def close(self) -> None:
        self._server.close()


class _Server(BoundedServer):
    lasts_s = 2 * _REQUEST_S
    newest_first = True
    pages: dict[str, Page]
    guarded: bool
    """Whether only this machine may ask: then a page of another site may not make a browser here ask."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _REQUEST_S

    def do_GET(self) -> None:
        headers = {name.lower(): value for name, value in self.headers.items()}
        several = len(self.headers.get_all("host", [])) > 1
        if self.server.guarded and (several or refusal(headers) is not None):
            self.send_error(403, "only visitors from this machine are served")
            return
        page = self.server.pages.get(self.path.partition("?")[0])
        if page is None:
            self.send_error(404, f"there is {' and '.join(self.server.pages)}")
            return
        reply = page(headers)
        self.send_response(reply.code)
        self.send_header("Content-Type", reply.content_type)
        self.send_header("Content-Length", str(len(reply.content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(reply.content)

    do_HEAD = do_GET  # noqa: N815 (the library calls it so)

    def log_message(self, format: str, *args: Any) -> None:
        pass
