"""Metrics and health of a launcher's processes by HTTP, if it is given a port, and its state to its supervisor."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from launch_scripts.launcher.run_options import UpOptions
from launch_scripts.web.health_pages import Process
from swarm.errors import BusError
from swarm.runtime.loop_health import Health, supervisor_of

if TYPE_CHECKING:
    from launch_scripts.observe.latest_messages import LatestState
    from launch_scripts.web.prometheus import MetricsEndpoint

_TURNS_HZ = 2.0
"""Lowest rate of a launcher's turns."""
_NAME = "launcher"


class LauncherHealth:
    """Metrics and health of this launcher's processes, by HTTP. Raises BusError if the port is taken; if another
    launcher is taken over from, the port is opened once that one has left it.

    seen  state of the processes that this launcher has started; called by any thread
    """

    def __init__(self, options: UpOptions, run_id: str, seen: Callable[[], Sequence[Process]]) -> None:
        self._options, self._run_id, self._seen = options, run_id, seen
        self._health = Health(supervisor=supervisor_of(os.environ))
        self._health.starts("the start of its processes")
        self._health.begins(_TURNS_HZ)
        self._metrics: MetricsEndpoint | None = None
        if not options.takes_over:
            self._open()

    @property
    def url(self) -> str:
        """URL of the metrics; empty without a port, and before it is opened."""
        return "" if self._metrics is None else self._metrics.url

    def _open(self) -> None:
        port, address = self._options.metrics_port, self._options.signals_address
        if port is None or self._metrics is not None:
            return
        from launch_scripts.web.prometheus import MetricsEndpoint  # takes time to import

        board, seen = self._health.board, self._seen
        self._metrics = MetricsEndpoint(port, lambda: [Process(_NAME, board.read()), *seen()], address)

    def turned(
        self,
        observed: LatestState,
        started_ns: int,
        missing: Sequence[str],
        up: Collection[tuple[str, str]] | None = None,
    ) -> None:
        """Notes a turn of the launcher, and answers scrapes that came since the last one.

        missing  names of processes that it has started and that no process has seen alive yet
        up       (role, id) of the living processes, if these are a part of the run; None: the whole run is
                 observed, so the metrics name it
        """
        self._health.turned([f"word of {name}" for name in missing])
        with suppress(BusError):  # the launcher before still has the port
            self._open()
        if self._metrics is not None:
            from launch_scripts.web.prometheus import Run, families

            run = Run(self._run_id, self._options.scenario.name, started_ns) if up is None else None
            alive = observed.up() if up is None else up
            status = observed.status if up is None else {}  # a part hears it until a route is served
            self._metrics.answer(lambda: families(run, observed, status, alive))

    def ends(self) -> None:
        """The run ends from now on; figures are answered no more."""
        self._health.ends()

    def close(self) -> None:
        if self._metrics is not None:
            self._metrics.close()
