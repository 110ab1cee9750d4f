"""Serves metrics to Prometheus on loopback: `/metrics`, in the format that the visitor asks for.

Figures belong to the thread that hears the swarm. So a visitor's thread only leaves a question and waits; the owner
answers at its next turn. Nobody asks, nothing is made.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from http.server import BaseHTTPRequestHandler
from typing import Any

from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from launch_scripts.monitor.serving.loopback_guard import LOOPBACK, BoundedServer, refusal
from swarm.errors import BusError

log = logging.getLogger(__name__)

_WAIT_S = 5.0
"""Prometheus gives up after 10 s."""


class OneScrape(Collector):
    """What `choose_encoder`'s formats take for a registry."""

    def __init__(self, families: Iterable[Metric]) -> None:
        self._families = families

    def collect(self) -> Iterable[Metric]:
        return self._families


class MetricsEndpoint:
    """Answers scrapes with what the owner makes at its next call of `answer`. Raises BusError if the port is taken;
    0 is any."""

    def __init__(self, port: int) -> None:
        self._waiting: queue.SimpleQueue[Future[list[Metric]]] = queue.SimpleQueue()
        try:
            self._server = _Server(port, _Handler)
        except OSError as error:
            raise BusError(f"metrics port {port} cannot be opened: {error.strerror}") from error
        self._server.endpoint = self
        threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://{LOOPBACK}:{self._server.port}/metrics"

    def answer(self, make: Callable[[], Iterable[Metric]]) -> None:
        """Answers all who wait. Called by the thread that owns the figures, several times a second."""
        made: list[Metric] | None = None
        while not self._waiting.empty():
            waiting = self._waiting.get()
            made = list(make()) if made is None else made
            waiting.set_result(made)

    def ask(self) -> list[Metric]:
        """Called by a visitor's thread. Raises TimeoutError if the owner is too busy."""
        waiting: Future[list[Metric]] = Future()
        self._waiting.put(waiting)
        return waiting.result(_WAIT_S)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class _Server(BoundedServer):
    endpoint: MetricsEndpoint


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = 10.0

    def do_GET(self) -> None:
        headers = {name.lower(): value for name, value in self.headers.items()}
        if len(self.headers.get_all("host", [])) > 1 or refusal(headers) is not None:
            self.send_error(403, "only visitors from this machine are served")
            return
        if self.path.partition("?")[0] != "/metrics":
            self.send_error(404, "metrics are at /metrics")
            return
        try:
            families = self.server.endpoint.ask()
        except TimeoutError:
            self.send_error(503, "the swarm's observer is busy; ask again")
            return
        encode, content_type = choose_encoder(headers.get("accept", ""))
        content = encode(OneScrape(families))
        self.send_response(200)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        log.debug(format, *args)
