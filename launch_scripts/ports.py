"""Ports of this machine: which are free, and which are taken that a run needs."""

from __future__ import annotations

import contextlib
import errno
import socket
from itertools import combinations

from swarm.config.scenario import Scenario
from swarm.endpoints import host_port
from swarm.errors import BusError, ConfigError

_METRICS = "the metrics (--metrics-port)"


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


def check_ports(scenario: Scenario, roles: tuple[str, ...], metrics: tuple[str, int] = ("", 0)) -> None:
    """Compares the ports of all services which a run opens on this machine. Raises ConfigError if two of them have
    one port, and BusError if a port is taken.

    metrics  address and port of the metrics; 0: none, or any free one
    """
    listen = scenario.network.listen if "router" in roles else ()
    wanted = [("the router (network.listen)", *host_port(endpoint)) for endpoint in listen]
    if "monitor" in roles and scenario.monitor.live:
        wanted.append(("the live view (monitor.web_port)", "127.0.0.1", scenario.monitor.web_port))
    wanted.append((_METRICS, *metrics))
    for (who, host, port), (other, its_host, its_port) in combinations(wanted, 2):
        if port and port == its_port and _overlap(host, its_host):
            raise ConfigError(f"port {port} is that of {who} and of {other}; expected another for one of them")
    for who, host, port in wanted:
        if port and _taken(host, port):
            other = "--metrics-port N" if who == _METRICS else "--port N (N and N+1 are used)"
            raise BusError(f"port {port} of {who} is taken; choose another with {other}; 0 picks a free one")


def _overlap(*hosts: str) -> bool:
    """Returns True if two services cannot have the same port at these two hosts."""
    one, other = ("127.0.0.1" if host == "localhost" else host for host in hosts)
    return one == other or "::" in hosts or ("0.0.0.0" in hosts and ":" not in one + other)


def _taken(host: str, port: int) -> bool:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return error.errno == errno.EADDRINUSE
    return False
