"""What a launcher tells other programs: figures and health by HTTP, if it is given a port, and how it is to the
supervisor that started it, if there is one."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from launch_scripts.launcher.options import UpOptions
from launch_scripts.web.health_verdict import Process
from swarm.errors import BusError
from swarm.runtime.health import Health
from swarm.runtime.supervisor import supervisor_of

if TYPE_CHECKING:
    from launch_scripts.observe.latest_state import LatestState
    from launch_scripts.web.prometheus import MetricsEndpoint

_TURNS_HZ = 2.0
"""How often a launcher turns, at least."""
_NAME = "launcher"


class MachineSignals:
    """Raises BusError if the port is taken; where another launcher is taken over from, it is opened once that one
    has left it.

    seen  how the processes are that this launcher has started; called by any thread
    """

    def __init__(self, options: UpOptions, run_id: str, seen: Callable[[], Sequence[Process]]) -> None:
        self._run = (run_id, options.scenario.name)
        self._health = Health(supervisor=supervisor_of(os.environ))
        self._health.starts("the start of its processes")
        self._health.begins(_TURNS_HZ)
        self.url = ""
        """Of the figures; empty without a port, and before it is opened."""
        self._port, self._address = options.metrics_port, options.signals_address
        self._seen = seen
        self._metrics: MetricsEndpoint | None = None
        if not options.takes_over:
            self._open()

    def _open(self) -> None:
        if self._port is None:
            return
        from launch_scripts.web.prometheus import MetricsEndpoint  # takes time to import

        board, seen = self._health.board, self._seen
        self._metrics = MetricsEndpoint(self._port, lambda: [Process(_NAME, board.read()), *seen()], self._address)
        self.url = self._metrics.url

    def turned(
        self,
        observed: LatestState,
        started_ns: int,
        missing: Sequence[str],
        up: Collection[tuple[str, str]] | None = None,
    ) -> None:
        """The launcher has turned: tells so, and answers who has asked for figures since the last time.

        missing  names of processes that it has started and nobody has heard yet
        up       (role, id) of the processes that live, where these are a part of the run; None: all of the run is
                 observed, so the figures name it
        """
        self._health.turned([f"word of {name}" for name in missing])
        if self._metrics is None:
            with suppress(BusError):  # the launcher before still has the port
                self._open()
        if self._metrics is not None:
            from launch_scripts.web.prometheus import Figures, Run, families

            run = Run(*self._run, started_ns) if up is None else None
            alive = observed.up() if up is None else up
            self._metrics.answer(lambda: families(Figures(run, observed, observed.status, alive)))

    def ends(self) -> None:
        """The run ends from now on; figures are answered no more."""
        self._health.ends()

    def close(self) -> None:
        if self._metrics is not None:
            self._metrics.close()
