"""The page of the live view: a start page at once, then rerun's web viewer, and beside both how the run is.

rerun's own function serves to the whole network, and its page calls home, for usage data among other things; the
policy of our server stops that. The page's files are found only inside the viewer program, so it is started for a
moment when the first visitor comes.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import math
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Mapping
from email.message import Message
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from launch_scripts import parent_death
from launch_scripts.web import LOOPBACK, Page, Reply
from launch_scripts.web.http_server import Server
from shared_map.terrain.terrain import Terrain
from swarm.errors import BusError, StoreError

log = logging.getLogger(__name__)

T = TypeVar("T")
_FILES = ("/", "/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico", "/sw.js")
_BANNER = "/run_banner.js"
_START_PAGE = f'<!doctype html><title>terrain swarm</title><body><script src="{_BANNER}"></script>'.encode()
_POLLED_WITHIN_S = 5.0
"""Pages poll once a second; a machine that draws without a graphics card is late at times."""
_READY_WITHIN_S = 20.0
"""Time for the viewer's server to answer. Chosen, not measured."""
PORT_PATIENCE_S = 3.0
"""A port that is in use is waited for at most this time: after a restart the one before may still have it."""
_LASTS_S = 120.0
"""The page has 40 MB, and a tunnel may be slow."""


class LivePage:
    """Serves a start page, and once a stream is there the page of the web viewer, to which the start page leads.
    Raises BusError if it cannot listen on the port; 0 is any.

    run      information about the run that pages poll, see `run_banner.js`
    terrain  of which the start page shows a picture; None while there is none
    """

    def __init__(
        self, port: int, run: Callable[[], Mapping[str, Any]] = dict, terrain: Terrain | None = None
    ) -> None:
        self.run, self.terrain = run, terrain
        self._asked_s = -math.inf
        self._files: dict[str, Reply] = {}
        self._fetching = threading.Lock()
        banner = Path(__file__).with_name("run_banner.js").read_bytes()
        pages: dict[str, Page] = {path: partial(self._file, path) for path in _FILES}
        pages |= {
            "/": self._entrance,
            _BANNER: lambda query, headers: Reply(200, "text/javascript", banner),
            "/run.json": self._run_json,
            "/terrain.webp": self._picture,
        }
        self.server = Server("web_port", port, pages, lasts_s=_LASTS_S)

    @property
    def is_open(self) -> bool:
        """True while a page polls, be it before its viewer has a stream."""
        return time.monotonic() - self._asked_s < _POLLED_WITHIN_S

    def _run_json(self, query: str, headers: Message) -> Reply:
        self._asked_s = time.monotonic()
        if self.server.behind is not None and not self._files and not self._fetching.locked():
            threading.Thread(
                target=self._file, args=("/", query, headers), name="viewer-files", daemon=True
            ).start()
        fields = {**self.run(), "view": bool(self._files), "picture": self.terrain is not None}
        return Reply(200, "application/json", json.dumps(fields).encode())

    def _picture(self, query: str, headers: Message) -> Reply:
        from launch_scripts.observe.palette import terrain_picture  # NumPy, and PIL

        if self.terrain is None:
            return Reply(404, "text/plain", b"the terrain is not prepared yet\n")
        return Reply(200, "image/webp", terrain_picture(self.terrain))

    def _entrance(self, query: str, headers: Message) -> Reply:
        """Leads a visit without a query to the stream, which comes through the page's own port: so a tunnel needs
        one port, and may begin at any."""
        if query:
            return self._file("/", query, headers)
        if not self._files:
            return Reply(200, "text/html; charset=utf-8", _START_PAGE)
        params = {"url": f"rerun+http://{headers['host']}/proxy", "theme": "dark", "hide_welcome_screen": "1"}
        return Reply(302, "text/plain", b"", {"Location": f"/?{urllib.parse.urlencode(params)}"})

    def _file(self, path: str, query: str, headers: Message) -> Reply:
        with self._fetching:
            if not self._files:
                try:
                    self._files = _take_files()
                except (OSError, StoreError) as error:
                    log.warning("no viewer to serve: %s", error)
                    text = b"the viewer program cannot be started; see the monitor's log\n"
                    return Reply(503, "text/plain", text)
        return self._files[path]


def when_free(listen: Callable[[], T]) -> T:
    """Listens on a port, and waits for one which is still in use. Raises BusError."""
    deadline_s = time.monotonic() + PORT_PATIENCE_S
    while True:
        try:
            return listen()
        except BusError as error:
            if time.monotonic() > deadline_s:
                raise BusError(
                    f"no live view: monitor.{error}; choose another, 0 for any, or monitor.live = false"
                ) from error
        time.sleep(0.1)


def viewer_program() -> Path:
    """The viewer itself. The script of that name on the path would be a second process between us and it."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise StoreError("rerun's viewer is not installed: install rerun-sdk, or set monitor.live = false")
    return Path(spec.origin).parent / ("rerun.exe" if sys.platform == "win32" else "rerun")


def _take_files() -> dict[str, Reply]:
    """The page's files, from a viewer program that lives only as long as that takes; the page with our script at
    its end. Raises OSError if the program does not serve them."""
    with socket.create_server((LOOPBACK, 0)) as probe:
        port = probe.getsockname()[1]
    # Given a stream to show, the program serves nothing but the page. On "CI" it collects no usage data and writes
    # nothing to the home folder.
    serve = ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(port), "rerun+http://127.0.0.1:1/proxy"]
    viewer = subprocess.Popen(
        [sys.executable, "-I", parent_death.__file__, str(os.getpid()), str(viewer_program()), *serve],
        stdin=subprocess.DEVNULL,
        env={**os.environ, "CI": "1", "RUST_LOG": "warn"},
    )
    try:
        files = {path: _fetch(f"http://{LOOPBACK}:{port}{path}", viewer) for path in _FILES}
    finally:
        viewer.kill()
        viewer.wait()
    body, end, rest = files["/"].content.rpartition(b"</body>")
    script = f'<script src="{_BANNER}"></script>'.encode()
    return {**files, "/": files["/"]._replace(content=body + script + end + rest)}


def _fetch(url: str, viewer: subprocess.Popen[bytes]) -> Reply:
    """Waits for the viewer to listen. Raises OSError, as urllib's errors are."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    deadline_s = time.monotonic() + _READY_WITHIN_S
    while True:
        try:
            with direct.open(url, timeout=_READY_WITHIN_S) as reply:
                content = reply.read()
                kind = reply.headers.get("Content-Type") or "text/html"
                return Reply(200, kind, content, {"rerun-final-length": str(len(content))})
        except urllib.error.HTTPError:
            raise
        except OSError:
            if viewer.poll() is not None or time.monotonic() > deadline_s:
                raise
        time.sleep(0.02)
