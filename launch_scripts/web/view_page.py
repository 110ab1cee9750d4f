"""Serves the viewer's page on loopback only; its policy lets it load nothing from the internet.

rerun's own function serves to the whole network, and its page calls home, for usage data among other things. The
page's files are found only inside the viewer program, so it is started for a moment when the first visitor comes.
"""

from __future__ import annotations

import http.client
import importlib.util
import json
import logging
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, NamedTuple

from launch_scripts import parent_death
from launch_scripts.web.loopback_guard import LOOPBACK, Audience, BoundedServer, refusal
from launch_scripts.web.stream_gate import SEND_WITHIN_S, join_sockets
from swarm.errors import StoreError

log = logging.getLogger(__name__)

_FILES = ("/", "/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico", "/sw.js")
_BANNER = "/run_banner.js"
_READY_WITHIN_S = 20.0
_MOST_ASKED = 1 << 16
"""Bytes of a question that is passed on to rerun's server."""
_OF_A_LINK = frozenset(("connection", "keep-alive"))
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


class _File(NamedTuple):
    content_type: str
    content: bytes


class ViewerPage:
    """Serves the page of the web viewer, and its stream; a visit to `/` leads to both. Raises OSError if it cannot
    listen on the port; 0 is any.

    stream  address of rerun's server
    """

    def __init__(self, port: int, stream: tuple[str, int]) -> None:
        self.stream = stream
        self.run: Callable[[], Mapping[str, Any]] = dict
        """What the page is told of the run whenever it asks, see `run_banner.js`."""
        self._files: dict[str, _File] = {}
        self._fetching = threading.Lock()
        self._server = _Server(port, _Handler)
        self._server.page = self
        threading.Thread(target=self._server.serve_forever, name="viewer-page", daemon=True).start()

    @property
    def port(self) -> int:
        return self._server.port

    def close(self) -> None:
        self._server.close()

    def audience(self) -> Audience:
        """Who takes the stream through the page's port."""
        return self._server.audience()

    def entrance(self, host: str) -> str:
        """Where a visit without a query is sent. The stream comes through the page's own port: so a tunnel needs
        one port, and may begin at any."""
        query = {"url": f"rerun+http://{host}/proxy", "theme": "dark", "hide_welcome_screen": "1"}
        return "/?" + urllib.parse.urlencode(query)

    def file(self, path: str) -> _File | None:
        """Raises OSError if the viewer cannot be started."""
        if path == _BANNER:
            return _File("text/javascript", Path(__file__).with_name("run_banner.js").read_bytes())
        if path == "/run.json":
            return _File("application/json", json.dumps(self.run()).encode())
        if path not in _FILES:
            return None
        with self._fetching:
            if not self._files:
                self._files = _with_banner(_take_files())
        return self._files.get(path)


class _Server(BoundedServer):
    lasts_s = 120.0  # the page has 40 MB, and a tunnel may be slow
    page: ViewerPage


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = 60.0  # for the head of a request, and for all of an answer

    def do_GET(self) -> None:
        headers = {name.lower(): value for name, value in self.headers.items()}
        if len(self.headers.get_all("host", [])) > 1 or refusal(headers) is not None:
            self.send_error(403, "only pages of this machine are served")
            return
        path, _, query = self.path.partition("?")
        if path == "/" and not query:
            self.send_response(302)
            self.send_header("Location", self.server.page.entrance(headers["host"]))
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        try:
            file = self.server.page.file(path)
        except (OSError, StoreError) as error:
            log.warning("no viewer to serve: %s", error)
            self.send_error(503, "the viewer program cannot be started; see the monitor's log")
            return
        if file is None:
            self.send_error(404)
            return
        self.send_response(200)
        for name, value in {**_HEADERS, "Content-Type": file.content_type}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(file.content)))
        self.send_header("rerun-final-length", str(len(file.content)))
        self.end_headers()
        self.wfile.write(file.content)

    def do_POST(self) -> None:
        """The viewer asks rerun's server for the stream."""
        headers = {name.lower(): value for name, value in self.headers.items()}
        if len(self.headers.get_all("host", [])) > 1 or refusal(headers) is not None:
            self.send_error(403, "only pages of this machine are served")
            return
        length = headers.get("content-length", "")
        if (
            not self.path.startswith("/rerun.")
            or not (length.isascii() and length.isdigit())
            or ("transfer-encoding" in headers or len(self.headers.get_all("content-length", [])) > 1)
        ):
            self.send_error(404)
            return
        body = self.rfile.read(min(int(length), _MOST_ASKED))
        passed = [f"{name}: {value}" for name, value in self.headers.items() if name.lower() not in _OF_A_LINK]
        head = "\r\n".join([f"POST {self.path} HTTP/1.1", *passed, "Connection: close", "", ""])
        self.close_connection = True
        with socket.create_connection(self.server.page.stream, timeout=SEND_WITHIN_S) as inner:
            self.server.keep(self.connection)
            self.connection.settimeout(SEND_WITHIN_S)
            inner.sendall(head.encode("latin1") + body)
            join_sockets(self.connection, inner)

    def log_message(self, format: str, *args: Any) -> None:
        log.debug(format, *args)


def viewer_program() -> Path:
    """The viewer itself. The script of that name on the path would be a second process between us and it."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise StoreError("rerun's viewer is not installed: install rerun-sdk, or set monitor.live = false")
    return Path(spec.origin).parent / ("rerun.exe" if sys.platform == "win32" else "rerun")


def _with_banner(files: dict[str, _File]) -> dict[str, _File]:
    """The page with our script at its end."""
    page = files["/"]
    body, end, rest = page.content.rpartition(b"</body>")
    script = f'<script src="{_BANNER}"></script>'.encode()
    return {**files, "/": _File(page.content_type, body + script + end + rest)}


def _take_files() -> dict[str, _File]:
    """The page's files, from a viewer program that lives only as long as that takes."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    # Given a stream to show, the program serves nothing but the page. On "CI" it collects no usage data and writes
    # nothing to the home folder.
    serve = [str(viewer_program()), "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(port)]
    viewer = subprocess.Popen(
        [
            sys.executable,
            "-I",
            str(Path(parent_death.__file__)),
            str(os.getpid()),
            *serve,
            "rerun+http://127.0.0.1:1/proxy",
        ],
        stdin=subprocess.DEVNULL,
        env={**os.environ, "CI": "1", "RUST_LOG": "warn"},
    )
    try:
        _wait_for(port, viewer)
        return {path: _fetch(port, path) for path in _FILES}
    finally:
        viewer.kill()
        viewer.wait()


def _wait_for(port: int, viewer: subprocess.Popen[bytes]) -> None:
    deadline_s = time.monotonic() + _READY_WITHIN_S
    while True:
        try:
            socket.create_connection((LOOPBACK, port), timeout=1.0).close()
            return
        except OSError:
            if viewer.poll() is not None or time.monotonic() > deadline_s:
                raise
        time.sleep(0.02)


def _fetch(port: int, path: str) -> _File:
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=_READY_WITHIN_S)
    try:
        connection.request("GET", path)
        reply = connection.getresponse()
        content = reply.read()
        if reply.status != 200:
            raise OSError(f"the viewer answers {reply.status} for {path}")
        return _File(reply.headers.get("Content-Type") or "text/html", content)
    except http.client.HTTPException as error:
        raise OSError(f"the viewer does not serve {path}: {error!r}") from error
    finally:
        connection.close()
