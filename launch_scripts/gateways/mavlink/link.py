"""The link to a vehicle: bytes in and out of UDP, TCP or a serial port, hardly ever waiting.

pymavlink has connections of its own. They reply to any sender, keep the ids of foreign senders, and wait for
seconds while a peer is missing.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from swarm.errors import BusError, ConfigError

_MOST_BYTES = 65536
"""Bytes that are read at once: no UDP datagram has more."""
_OPEN_AGAIN_S = 1.0
"""Pause between two attempts to open a link. Chosen, not measured."""
_PATIENCE_S = 0.3
"""A TCP peer which has not answered by then is tried again later: nothing else is done meanwhile."""
_BAUD = 57600
"""The default of SiK telemetry radios, and so of the autopilots' ports for telemetry."""
_EXAMPLES = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


@dataclass(frozen=True)
class Address:
    """The address of a vehicle.

    kind    udpin, udpout, tcp or serial
    name    a host, or a device
    number  port, or bauds
    """

    kind: str
    name: str
    number: int

    def __str__(self) -> str:
        return f"{self.kind}:{self.name}:{self.number}"


def read_address(text: str) -> Address:
    """Raises ConfigError."""
    kind, _, rest = text.partition(":")
    if kind == "serial" and (found := re.fullmatch(r"([^:]+)(?::([0-9]{1,7}))?", rest)):
        return Address(kind, found[1], int(found[2] or _BAUD))
    found = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^:\[\]]+):([0-9]{1,5})", rest)
    if kind in ("udpin", "udpout", "tcp") and found and 0 < int(found[2]) < 65536:
        return Address(kind, found[1].strip("[]"), int(found[2]))
    raise ConfigError(f"LINK: found {text[:80]!r}, expected {_EXAMPLES}")


def open_link(address: Address) -> UdpLink | StreamLink:
    """Raises ConfigError or BusError. Once it is open nothing raises: a link that is down brings nothing, and comes
    back."""
    if address.kind == "serial":
        import serial

        link = StreamLink(lambda: serial.Serial(address.name, address.number))
        try:
            link.open()
        except (OSError, ValueError) as error:
            raise BusError(f"cannot open {address}: {error}") from error
        return link
    kind = socket.SOCK_STREAM if address.kind == "tcp" else socket.SOCK_DGRAM
    try:
        family, _, _, _, peer = socket.getaddrinfo(address.name, address.number, type=kind)[0]
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"LINK: there is no host {address.name[:80]!r}") from error
    if address.kind == "tcp":
        return StreamLink(lambda: _connected(family, peer))
    return UdpLink(address, family, peer)


class UdpLink:
    """Listens at an address and answers the vehicle, or speaks to an address and listens for its answers."""

    whole = True
    """Each piece that it brings holds whole messages."""

    def __init__(self, address: Address, family: int, peer: Any) -> None:
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._last = self._peer = peer if address.kind == "udpout" else None
        if address.kind == "udpin":
            try:
                self._socket.bind(peer)
            except OSError as error:
                self._socket.close()
                raise BusError(f"cannot listen at {address}: {error.strerror or error}") from error

    def read(self, within_s: float) -> bytes | None:
        """Returns received bytes, after waiting up to a timeout; None if there are none."""
        if select.select([self._socket], [], [], within_s)[0]:
            with contextlib.suppress(OSError):  # no peer was there for our message
                data, self._last = self._socket.recvfrom(_MOST_BYTES)
                return data
        return None

    def answer_last(self) -> None:
        """Remembers the sender of the last message; replies go there."""
        self._peer = self._last

    def write(self, data: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._peer)

    def close(self) -> None:
        self._socket.close()


class StreamLink:
    """A TCP connection or a serial port, opened again once a second while it is closed.

    made  opens it, so that its file neither waits for bytes nor for room for them. Raises OSError
    """

    whole = False

    def __init__(self, made: Callable[[], Any]) -> None:
        self._made = made
        self._stream: Any = None
        self._due_s = 0.0

    def open(self) -> None:
        self._due_s = time.monotonic() + _OPEN_AGAIN_S
        self._stream = self._made()

    def read(self, within_s: float) -> bytes | None:
        if self._stream is None and time.monotonic() >= self._due_s:
            with contextlib.suppress(OSError, ValueError):
                self.open()
        if self._stream is None:
            time.sleep(within_s)
        elif select.select([self._stream], [], [], within_s)[0]:
            with contextlib.suppress(OSError):
                if data := os.read(self._stream.fileno(), _MOST_BYTES):
                    return data
            self.close()
        return None

    def answer_last(self) -> None:
        pass

    def write(self, data: bytes) -> None:
        if self._stream is not None:
            try:
                whole = os.write(self._stream.fileno(), data) == len(data)
            except OSError as error:
                whole = isinstance(error, BlockingIOError)  # all of it is lost
            if not whole:  # its peer reads nothing, and half a message would spoil what follows
                self.close()

    def close(self) -> None:
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()
        self._stream = None


def _connected(family: int, peer: Any) -> socket.socket:
    made = socket.socket(family, socket.SOCK_STREAM)
    try:
        made.settimeout(_PATIENCE_S)
        made.connect(peer)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.setblocking(False)
    except OSError:
        made.close()
        raise
    return made
