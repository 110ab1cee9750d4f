"""Asks a page of health, for probes that run a command: `swarm health --url`.

A probe is started every few seconds, so this imports nothing but what it takes, and `fast` answers before the
command line is loaded.
"""

from __future__ import annotations

import json
import socket
import sys
import time
import urllib.parse
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from launch_scripts.plain_text import plain
from launch_scripts.web import HEALTHY, READY
from swarm.errors import BusError, ConfigError, SwarmError

NOT_READY = 1
"""Exit code of a probe for a process that is not ready."""
_TIMEOUT_S = 5.0
"""Half of what a container's health check grants (10 s, Containerfile), so that the probe itself says why there is
no answer."""
_MOST_BYTES = 1 << 20
"""A page of health has a line for each thing that is missing, some hundred bytes: room for ten thousand of them."""
_LONGEST = 300
"""Characters of a line, or of an address in an error: a few lines of a terminal. The text came from the network."""


class Answer(NamedTuple):
    """Reply to a probe. Nothing of `page` is to be trusted: it came from the network."""

    ok: bool
    page: dict[str, Any]

    def lines(self) -> list[str]:
        """For people."""
        missing = self.page.get("missing")
        lines = [self.page.get("status"), *(missing if isinstance(missing, list) else [])]
        return [plain(str(line)[:_LONGEST]) for line in lines]

    def show(self, *, as_json: bool) -> int:
        """Prints it. Returns the exit code."""
        for line in [json.dumps(self.page, indent=2)] if as_json else self.lines():
            print(line)
        return 0 if self.ok else NOT_READY


def ask(url: str, *, live: bool) -> Answer:
    """Asks whether processes are ready, or with `live` whether they live. Raises BusError if there is no reply,
    ConfigError if the address is invalid."""
    host, port, path = _place(url)
    try:
        with socket.create_connection((host, port), _TIMEOUT_S) as connection:
            name = f"[{host}]" if ":" in host else host
            words = f"GET {path or (HEALTHY if live else READY)} HTTP/1.0\r\nHost: {name}:{port}\r\n\r\n"
            connection.sendall(words.encode("ascii"))
            reply = _read(connection)
    except TimeoutError as error:
        raise BusError(f"{url} does not answer within {_TIMEOUT_S:g} s") from error
    except OSError as error:
        raise BusError(f"{url} cannot be reached: {error.strerror or error}") from error
    head, _, body = reply.partition(b"\r\n\r\n")
    protocol, code, *_ = [*head.decode("ascii", "replace").split(None, 2), "", ""]
    page = None
    if protocol.startswith("HTTP/") and code in ("200", "503"):
        with suppress(ValueError, RecursionError):
            page = json.loads(body)
    if not isinstance(page, dict) or "status" not in page:
        raise BusError(f"{url} answers {code[:20]!r}: there is no page of health")
    return Answer(code == "200", page)


def _place(url: str) -> tuple[str, int, str]:
    try:
        parts = urllib.parse.urlsplit(url)
        host, port = parts.hostname, parts.port
        path = parts.path if parts.path != "/" else ""
        if parts.scheme == "http" and host and port and (path + host).isascii() and " " not in path:
            return host, port, path
    except ValueError:
        pass
    raise ConfigError(f"--url {url[:_LONGEST]!r} is no address such as http://127.0.0.1:9464")


def _read(connection: socket.socket) -> bytes:
    until_s = time.monotonic() + _TIMEOUT_S
    reply = part = connection.recv(65536)
    while part and len(reply) < _MOST_BYTES:
        connection.settimeout(max(until_s - time.monotonic(), 0.001))
        part = connection.recv(65536)
        reply += part
    return reply


def fast(words: Sequence[str]) -> int | None:
    """The exit code of `swarm health --url URL [--live] [--json]`; None where that is not what the words say, which
    is then the command line's to read."""
    if len(words) < 3 or words[0] != "health" or words[1] != "--url" or not set(words[3:]) <= {"--live", "--json"}:
        return None
    try:
        return ask(words[2], live="--live" in words).show(as_json="--json" in words)
    except SwarmError as error:
        print(f"swarm: {error}", file=sys.stderr)
        return error.exit_code
