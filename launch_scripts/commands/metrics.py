"""`swarm metrics`: figures of a running swarm for Prometheus."""

from __future__ import annotations

import os
import time
from importlib.resources import files
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from swarm.config.scenario import NetworkConfig

_TURN_S = 0.1


def serve_metrics(network: NetworkConfig, port: int, address: str) -> None:
    """Serve until Ctrl-C, on an address of this machine. Raises BusError if the port is taken, or there is no
    router."""
    from launch_scripts.web.health_verdict import Process
    from launch_scripts.web.metric_families import families
    from launch_scripts.web.metrics_endpoint import MetricsEndpoint
    from launch_scripts.web.metrics_exporter import Exporter
    from swarm.bus.zenoh_bus import open_bus
    from swarm.runtime.health import Health
    from swarm.runtime.supervisor import supervisor_of

    health = Health(supervisor=supervisor_of(os.environ))
    health.begins(1.0 / _TURN_S)
    endpoint = MetricsEndpoint(port, lambda: [Process("metrics", health.board.read())], address)
    try:
        with open_bus(network) as bus:
            exporter = Exporter(bus)
            typer.echo(f"metrics at {endpoint.url}; Ctrl-C ends it")
            told = None
            while True:
                exporter.listen(time.monotonic_ns(), _TURN_S)
                endpoint.answer(lambda: families(exporter.figures()))
                health.turned([] if exporter.run is not None else ["a run"])
                if exporter.run is not None and exporter.run.run_id != told:
                    told = exporter.run.run_id
                    typer.echo(f"run {told}, scenario {exporter.run.scenario}")
    except KeyboardInterrupt:
        pass
    finally:
        endpoint.close()


def dashboard() -> str:
    """A dashboard for Grafana, as JSON."""
    return files("launch_scripts.web").joinpath("dashboard.json").read_text(encoding="utf-8")


def alerts() -> str:
    """Rules of Prometheus, as YAML."""
    return files("launch_scripts.web").joinpath("alerts.yml").read_text(encoding="utf-8")
