"""Endpoints of routers: which are valid, whether a process listens there, and if none does, the reason.

The reasons are in words of our own: the network library names its own source files instead.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
import os
import re
import socket
import time
from collections.abc import Sequence

from swarm.errors import ConfigError

log = logging.getLogger(__name__)

_PAUSE_S = 0.25
"""Between two looks for a router that is not up yet."""
_OS_ERROR = re.compile(r"\(os error (\d+)\)")
_RUNS = "is `swarm up` or `swarm role router` running there"
_KNOCK_S = 1.0
"""Longest wait for an answer of a port. A router of the same network answers within milliseconds."""
_HINTS = {
    errno.EADDRINUSE: "is the port taken?",
    errno.EADDRNOTAVAIL: "is it an address of this machine?",
    errno.EACCES: "ports below 1024 are for administrators",
}


def host_port(endpoint: str) -> tuple[str, int]:
    """Host and port of an endpoint such as tcp/[::1]:7447."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def check_endpoint(endpoint: str, has_tls: bool, where: str) -> None:
    """Raises ConfigError on an invalid endpoint, and on one beyond loopback without mutual TLS."""
    match = re.fullmatch(r"(tcp|tls)/(\[[0-9a-fA-F:]+\]|[^:/\[\]]+):(\d{1,5})", endpoint)
    if match is None:
        why = ": quic/ is not offered, as strangers could keep members out" if endpoint.startswith("quic/") else ""
        such = "expected one such as tcp/127.0.0.1:7447 or tls/host:7447"
        raise ConfigError(f"{where}: {endpoint!r} is not an endpoint{why}; {such}")
    if int(match[3]) > 65535:
        raise ConfigError(f"{where}: {endpoint!r} is not an endpoint: a port is at most 65535")
    protocol, host = match[1], match[2].strip("[]")
    if protocol == "tls" and not has_tls:
        raise ConfigError(f"{where}: {endpoint} needs network.tls with ca, certificate and key, or --tls-dir")
    if protocol == "tcp" and not is_loopback(host):
        raise ConfigError(
            f"{where}: {endpoint} leaves this machine in the clear; use tls/{host}:{match[3]} with network.tls"
        )


def is_loopback(host: str) -> bool:
    """Returns True if a host is this machine by name or address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def listening(endpoint: str) -> bool:
    """Returns True if a process accepts connections there."""
    try:
        with socket.create_connection(host_port(endpoint), timeout=0.5):
            return True
    except OSError:
        return False


def keeps_open(endpoint: str) -> bool:
    """Returns True if a process accepts a connection there and does not end it at once, as a proxy does that has no
    router behind it."""
    try:
        with socket.create_connection(host_port(endpoint), timeout=_KNOCK_S) as connection:
            return bool(connection.recv(1))
    except TimeoutError:
        return True
    except OSError:
        return False


def wait_for_router(endpoints: Sequence[str]) -> None:
    """Blocks until something listens at one of the endpoints, however long it takes; reports the wait once.

    A signal whose handler raises ends it, as Ctrl-C does.
    """
    warned = False
    while not any(map(listening, endpoints)):
        if not warned:
            warned = True
            log.warning("no router at %s yet: waiting for one (Ctrl-C ends this)", ", ".join(endpoints))
        time.sleep(_PAUSE_S)
    if warned:
        log.info("a router is there")


def why_not_listening(error: Exception) -> str:
    """Returns the reason why no process can listen there, from the library's message."""
    found = _OS_ERROR.search(str(error))
    number = error.errno if isinstance(error, OSError) else int(found[1]) if found is not None else None
    if number is None:
        return "the network library refuses; its own words are in the log (is the port taken?)"
    hint = _HINTS.get(number)
    return os.strerror(number) + (f" ({hint})" if hint else "")


def why_silent(endpoint: str, encrypted: bool) -> str:
    """Returns the reason why no router is reached at an endpoint, from a connection attempt to its port."""
    try:
        host, port = host_port(endpoint)
        socket.create_connection((host, port), timeout=_KNOCK_S).close()
    except socket.gaierror:
        return f"the name {host} is unknown here"
    except TimeoutError:
        return f"no answer within {_KNOCK_S:g} s (is a firewall between?)"
    except ConnectionRefusedError:
        return f"no process listens there ({_RUNS}?)"
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    if encrypted:
        return (
            "a process listens there, but refuses us or is not a router "
            f"({_RUNS}, with certificates of the same authority, and no proxy between?)"
        )
    return f"a process listens there, but does not reply as a router ({_RUNS}?)"
