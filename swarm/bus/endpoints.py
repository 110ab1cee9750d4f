"""Endpoints of routers: their parts, whether a process listens there, and if none does, the reason.

The reasons are in words of our own: the network library names its own source files instead.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import socket
import time
from collections.abc import Sequence

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
