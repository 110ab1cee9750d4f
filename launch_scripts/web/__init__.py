"""One HTTP server, and what it serves: the page of the live view, health and metrics.

- `http_server`: answers on loopback, or on an address that an operator names. On loopback only a request whose Host
  and Origin are this machine is answered, with any method: a page of another site can make a browser connect to any
  loopback port, and can have its own name lead there (DNS rebinding). Connections are bounded in number and time.
- `live_page`: the files of rerun's web viewer, and the stream behind them.
- `health_pages`: the pages of health, made from what processes say of themselves; `health_probe` asks for one.
- `prometheus`: what a run has counted, as metric families of Prometheus.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from email.message import Message  # takes time to import, and a probe is to be quick

LOOPBACK = "127.0.0.1"
HEALTHY, READY = "/healthz", "/readyz"
PROBED = (HEALTHY, READY)
"""Pages of health. A server keeps places for those who ask for them."""


class Reply(NamedTuple):
    """Response to one request: its status, and its content."""

    code: int
    content_type: str
    content: bytes
    headers: Mapping[str, str] = MappingProxyType({})


Page = Callable[[str, "Message"], Reply]
"""Query, headers -> the reply. Called on the visitor's thread."""
