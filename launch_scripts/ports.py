"""Ports of this machine: which are free, and which are taken that a run needs."""

from __future__ import annotations

import contextlib
import errno
import socket

from swarm.bus.endpoints import host_port
from swarm.config.scenario import Scenario
from swarm.errors import BusError


def free_ports(count: int) -> list[int]:
    """Ports of 127.0.0.1 which are free now."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


def page_of(port: int) -> str:
    """Address of the live view's page for a browser on this machine."""
    return f"http://127.0.0.1:{port}/"


def check_ports(scenario: Scenario, roles: tuple[str, ...]) -> None:
    """Raises BusError if a port that this machine needs is taken."""
    wanted: list[tuple[str, str, int]] = []
    if "router" in roles:
        wanted += [("the router", *host_port(endpoint)) for endpoint in scenario.network.listen]
    if "monitor" in roles and scenario.monitor.live:
        wanted += [("the live view", "127.0.0.1", scenario.monitor.web_port)]
    for who, host, port in wanted:
        if port and _taken(host, port):
            raise BusError(
                f"port {port}, which {who} needs, is taken; choose others with --port N (N and N+1 are used), "
                "or let --port 0 pick free ones"
            )


def _taken(host: str, port: int) -> bool:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return error.errno == errno.EADDRINUSE
    return False
