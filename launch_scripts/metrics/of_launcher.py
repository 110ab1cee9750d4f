"""The metrics of a run that the launcher serves by option: what it has heard anyway for its table."""

from __future__ import annotations

from launch_scripts.metrics.endpoint import MetricsEndpoint
from launch_scripts.metrics.families import Figures, Run, families
from launch_scripts.report.latest_state import Observed


class LauncherMetrics:
    """Raises BusError if the port is taken; 0 is any."""

    def __init__(self, port: int, run_id: str, scenario: str, started_ns: int) -> None:
        self._endpoint = MetricsEndpoint(port)
        self._run = Run(run_id, scenario, started_ns)

    @property
    def url(self) -> str:
        return self._endpoint.url

    def answer(self, observed: Observed) -> None:
        """Answers who has asked since the last call."""
        self._endpoint.answer(lambda: families(Figures(self._run, observed, observed.status, observed.up())))

    def close(self) -> None:
        self._endpoint.close()
