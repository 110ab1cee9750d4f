"""What systemd, or another supervisor, is told by a process that it has started: sd_notify(3).

Datagrams on the Unix socket that `NOTIFY_SOCKET` names. None of them may hold the loop up, so one for which there
is no space is not sent; what matters is said again.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Mapping

log = logging.getLogger(__name__)

_LONGEST_STATUS = 200
_PINGS_PER_LIMIT = 4
"""A ping may come late, or be lost, twice."""


class Supervisor:
    """Tells it when the process is up, that its loop turns, and what it does.

    address    of the socket: a path, or `@name` in the abstract namespace; None: nobody wants to know
    limit_ns   after so long without a ping the supervisor takes the process for hung; None: it does not look
    """

    def __init__(self, address: str | None, limit_ns: int | None = None) -> None:
        self._address = address
        self._every_ns = None if limit_ns is None else limit_ns // _PINGS_PER_LIMIT
        self._due_ns = 0
        self._told_ready = False
        self._status: str | None = None
        """What is to be said with the next datagram; None: nothing new."""
        self._socket = None if address is None else _opened()

    def says(self, what: str) -> None:
        """What the process does now, in a line for people (`systemctl status`)."""
        self._status = "".join(each if each.isprintable() else " " for each in what)[:_LONGEST_STATUS]
        self._send([])

    def turned(self, now_ns: int) -> None:
        """The loop has turned: at the first time the process is up, at later ones it is still alive."""
        words = [] if self._told_ready else ["READY=1"]
        if self._every_ns is not None and now_ns >= self._due_ns:
            words.append("WATCHDOG=1")
        if words and self._send(words):
            self._told_ready = True
            self._due_ns = now_ns + (self._every_ns or 0)

    def ends(self) -> None:
        self._send(["STOPPING=1"])

    def _send(self, words: list[str]) -> bool:
        """Whether it has arrived."""
        if self._socket is None or self._address is None:
            return True
        told = [*words, *([] if self._status is None else [f"STATUS={self._status}"])]
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        try:
            self._socket.sendto("\n".join(told).encode(), address)
        except OSError as error:
            log.debug("NOTIFY_SOCKET %s: %s", self._address, error)
            return False
        self._status = None
        return True


def supervisor_of(environment: Mapping[str, str]) -> Supervisor:
    """The one that an environment names; one to whom nothing is told where it names none."""
    address = environment.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return Supervisor(None)
    pid, limit_us = environment.get("WATCHDOG_PID", ""), environment.get("WATCHDOG_USEC", "")
    meant = pid in ("", str(os.getpid()))
    return Supervisor(address, int(limit_us) * 1000 if meant and limit_us.isdecimal() and int(limit_us) else None)


def _opened() -> socket.socket:
    opened = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
    opened.setblocking(False)
    return opened
