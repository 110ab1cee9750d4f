"""Endpoints of routers: their parts, and whether anybody listens there."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Sequence

log = logging.getLogger(__name__)

_PAUSE_S = 0.25


def host_port(endpoint: str) -> tuple[str, int]:
    """Host and port of an endpoint such as tcp/[::1]:7447."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port)


def listening(endpoint: str) -> bool:
    """Whether something accepts connections there."""
    try:
        with socket.create_connection(host_port(endpoint), timeout=0.5):
            return True
    except OSError:
        return False


def wait_for_router(endpoints: Sequence[str]) -> None:
    """Block until something listens at one of the endpoints, however long it takes; say once that it waits.

    A signal whose handler raises ends it, as Ctrl-C does.
    """
    said = False
    while not any(map(listening, endpoints)):
        if not said:
            said = True
            log.warning("no router at %s yet: waiting for one (Ctrl-C ends this)", ", ".join(endpoints))
        time.sleep(_PAUSE_S)
    if said:
        log.info("a router is there")
