"""`swarm metrics`: figures of a running swarm for Prometheus."""

from __future__ import annotations

import os
from importlib.resources import files
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from swarm.config.scenario import NetworkConfig

_TURN_S = 0.1


def serve_metrics(network: NetworkConfig, port: int, address: str) -> None:
    """Serve until Ctrl-C, on an address of this machine. Raises BusError if the port is taken, or there is no
    router."""
    from launch_scripts.observe.run_observer import OutsideObserver
    from launch_scripts.web.health_verdict import Process
    from launch_scripts.web.prometheus import MetricsEndpoint, families, figures_of
    from swarm.bus.zenoh_bus import open_bus
    from swarm.clock import MonotonicClock
    from swarm.runtime.health import Health
    from swarm.runtime.supervisor import supervisor_of
    from swarm.wire.topics import STATS, STATUS

    health = Health(supervisor=supervisor_of(os.environ))
    health.begins(1.0 / _TURN_S)
    endpoint = MetricsEndpoint(port, lambda: [Process("metrics", health.board.read())], address)
    try:
        with open_bus(network) as bus:
            clock, observer = MonotonicClock(), OutsideObserver(bus, topics={STATS: 0.0, STATUS: 0.0}, follows=True)
            typer.echo(f"metrics at {endpoint.url}; Ctrl-C ends it")
            told = None
            while True:
                observer.listen(clock, _TURN_S)
                endpoint.answer(lambda: families(figures_of(observer.run, observer.latest)))
                health.turned([] if observer.run is not None else ["a run"])
                if observer.run is not None and observer.run.run_id != told:
                    told = observer.run.run_id
                    typer.echo(f"run {told}, scenario {observer.run.scenario}")
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
