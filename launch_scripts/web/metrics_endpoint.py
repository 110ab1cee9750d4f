"""Answers Prometheus: `/metrics`, in the format that the visitor asks for.

Figures belong to the thread that hears the swarm. So a visitor's thread only leaves a question and waits; the owner
answers at its next turn. Nobody asks, nothing is made.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future

from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from launch_scripts.web.health_pages import PageServer, Reply, health_pages
from launch_scripts.web.health_verdict import Process
from launch_scripts.web.loopback_guard import LOOPBACK

_METRICS = "/metrics"
_WAIT_S = 5.0
"""Prometheus gives up after 10 s."""


class OneScrape(Collector):
    """What `choose_encoder`'s formats take for a registry."""

    def __init__(self, families: Iterable[Metric]) -> None:
        self._families = families

    def collect(self) -> Iterable[Metric]:
        return self._families


class MetricsEndpoint:
    """Answers scrapes with what the owner makes at its next call of `answer`, and probes at once. Raises BusError
    if the port is taken; 0 is any.

    processes  whose health is told; called on visitors' threads
    """

    def __init__(self, port: int, processes: Callable[[], Sequence[Process]], address: str = LOOPBACK) -> None:
        self._waiting: queue.SimpleQueue[Future[list[Metric]]] = queue.SimpleQueue()
        pages = {_METRICS: self._scraped, **health_pages(processes)}
        self._server = PageServer("metrics port", port, pages, address)

    @property
    def url(self) -> str:
        return f"{self._server.url}{_METRICS}"

    def answer(self, make: Callable[[], Iterable[Metric]]) -> None:
        """Answers all who wait. Called by the thread that owns the figures, several times a second."""
        made: list[Metric] | None = None
        while not self._waiting.empty():
            waiting = self._waiting.get()
            made = list(make()) if made is None else made
            waiting.set_result(made)

    def _scraped(self, headers: Mapping[str, str]) -> Reply:
        waiting: Future[list[Metric]] = Future()
        self._waiting.put(waiting)
        try:
            families = waiting.result(_WAIT_S)
        except TimeoutError:
            return Reply(503, "text/plain", b"the swarm's observer is busy; ask again\n")
        encode, content_type = choose_encoder(headers.get("accept", ""))
        return Reply(200, content_type, encode(OneScrape(families)))

    def close(self) -> None:
        self._server.close()
