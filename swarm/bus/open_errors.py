"""Why a session could not be opened, in our words. The library names its own source files instead."""

from __future__ import annotations

import errno
import os
import re
import socket
from collections.abc import Sequence

from swarm.bus.endpoints import host_port

_OS_ERROR = re.compile(r"\(os error (\d+)\)")
_KNOCK_S = 1.0
_HINTS = {
    errno.EADDRINUSE: "is the port taken?",
    errno.EADDRNOTAVAIL: "is it an address of this machine?",
    errno.EACCES: "ports below 1024 are for administrators",
}


def why_unreachable(endpoints: Sequence[str], *, encrypted: bool) -> str:
    """Why no router is reached at any of these endpoints: what its port does when somebody knocks."""
    reasons = dict.fromkeys(_why_silent(endpoint, encrypted) for endpoint in endpoints)
    return "; ".join(reasons)


def why_not_listening(error: Exception) -> str:
    """Why nobody can listen, from what the library says."""
    found = _OS_ERROR.search(str(error))
    if found is None:
        return "the network library refuses; its own words are in the log (is the port taken?)"
    number = int(found[1])
    hint = _HINTS.get(number)
    return os.strerror(number) + (f" ({hint})" if hint else "")


def _why_silent(endpoint: str, encrypted: bool) -> str:
    try:
        host, port = host_port(endpoint)
        socket.create_connection((host, port), timeout=_KNOCK_S).close()
    except socket.gaierror:
        return f"the name {host} is unknown here"
    except TimeoutError:
        return f"no answer within {_KNOCK_S:g} s (is a firewall between?)"
    except ConnectionRefusedError:
        return "nobody listens there (is `swarm router` running there?)"
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    if encrypted:
        return (
            "somebody listens there, and refuses us or is no router "
            "(is `swarm router` running there, with certificates of the same authority?)"
        )
    return "somebody listens there, and does not answer as a router (is `swarm router` running there?)"
