"""The metrics of a run that the launcher serves by option: what it has heard anyway for its table."""

from __future__ import annotations

from launch_scripts.metrics.endpoint import MetricsEndpoint
from launch_scripts.metrics.families import Figures, Run, families
from launch_scripts.report.latest_state import Observed


class LauncherMetrics:
    """Raises BusError if the port is taken; 0 is any."""

    def __init__(self, port: int, run_id: str, scenario: str) -> None:
        self._endpoint = MetricsEndpoint(port)
        self._run = Run(run_id, scenario, 0)

    @property
    def url(self) -> str:
        return self._endpoint.url

    def answer(self, observed: Observed, started_ns: int) -> None:
        """Answers who has asked since the last call."""
        run = self._run._replace(started_ns=started_ns)
        self._endpoint.answer(lambda: families(Figures(run, observed, observed.status, observed.up())))

    def close(self) -> None:
        self._endpoint.close()
