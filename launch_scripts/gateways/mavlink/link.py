"""The link to a vehicle: bytes in and out of UDP, TCP or a serial port, never waiting.

pymavlink has connections of its own. They answer whoever has sent them anything, keep what strangers name, and wait
for seconds where a peer is gone.
"""

from __future__ import annotations

import contextlib
import errno
import re
import select
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from swarm.errors import BusError, ConfigError

_MOST_BYTES = 65536
_CONNECT_AGAIN_S = 1.0
_BAUD = 57600
_EXAMPLES = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


@dataclass(frozen=True)
class Address:
    """kind  udpin, udpout, tcp or serial
    name  a host, or a device
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


class Link(Protocol):
    """A way to a vehicle. Nothing raises once it is open: a link that is down brings nothing, and comes back."""

    whole: bool
    """Each piece that it brings holds whole messages."""

    def read(self, within_s: float) -> bytes | None:
        """What has come, after waiting for it for so long; None if nothing has."""

    def answer_last(self) -> None:
        """What was read last is the vehicle's: what is written goes where it came from."""

    def write(self, data: bytes) -> None: ...

    def close(self) -> None: ...


def open_link(address: Address) -> Link:
    """Raises ConfigError or BusError."""
    if address.kind == "serial":
        return SerialLink(address)
    return TcpLink(address) if address.kind == "tcp" else UdpLink(address)


class UdpLink:
    """Listens at an address and answers the vehicle, or speaks to an address and listens for its answers."""

    whole = True

    def __init__(self, address: Address) -> None:
        family, peer = _resolved(address, socket.SOCK_DGRAM)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._last: Any = None
        self._peer = None if address.kind == "udpin" else peer
        if address.kind == "udpin":
            try:
                self._socket.bind(peer)
            except OSError as error:
                self._socket.close()
                raise BusError(f"cannot listen at {address}: {error.strerror or error}") from error

    def read(self, within_s: float) -> bytes | None:
        if not select.select([self._socket], [], [], within_s)[0]:
            return None
        try:
            data, self._last = self._socket.recvfrom(_MOST_BYTES)
        except OSError:  # nobody was there for what we have sent
            return None
        return data

    def answer_last(self) -> None:
        self._peer = self._last

    def write(self, data: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._peer)

    def close(self) -> None:
        self._socket.close()


class TcpLink:
    """Connects, and once a second again while nobody is there."""

    whole = False

    def __init__(self, address: Address) -> None:
        self._family, self._peer = _resolved(address, socket.SOCK_STREAM)
        self._socket: socket.socket | None = None
        self._connected = False
        self._due_s = 0.0

    def read(self, within_s: float) -> bytes | None:
        if not self._is_up(within_s) or self._socket is None:
            return None
        if not select.select([self._socket], [], [], within_s)[0]:
            return None
        try:
            data = self._socket.recv(_MOST_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self.close()
        return data or None

    def answer_last(self) -> None:
        pass

    def write(self, data: bytes) -> None:
        if self._socket is None or not self._connected:
            return
        try:
            if self._socket.send(data) < len(data):
                self.close()  # a peer that reads nothing; half a message would spoil what follows
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self._connected = None, False

    def _is_up(self, within_s: float) -> bool:
        """Whether it is connected; goes on connecting, and waits while it is not."""
        if self._connected:
            return True
        now_s = time.monotonic()
        if self._socket is None:
            if now_s < self._due_s:
                time.sleep(within_s)
                return False
            self._due_s = now_s + _CONNECT_AGAIN_S
            self._socket = socket.socket(self._family, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            if self._socket.connect_ex(self._peer) not in (0, errno.EINPROGRESS):
                self.close()
                return False
        if not select.select([], [self._socket], [], within_s)[1]:
            if now_s > self._due_s + 5 * _CONNECT_AGAIN_S:
                self.close()
            return False
        if self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self.close()
            return False
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connected = True
        return True


class SerialLink:
    """A serial port, opened again once a second while it is gone."""

    whole = False

    def __init__(self, address: Address) -> None:
        try:
            import serial
        except ModuleNotFoundError as error:
            raise ConfigError("a serial link needs pyserial: pip install 'terrain-swarm[mavlink]'") from error
        port: Any = serial.Serial
        self._open: Callable[[], Any] = lambda: port(address.name, address.number, timeout=0.02, write_timeout=0.05)
        self._due_s = 0.0
        try:
            self._port: Any = self._open()
        except (OSError, ValueError) as error:
            raise BusError(f"cannot open {address}: {error}") from error

    def read(self, within_s: float) -> bytes | None:
        if self._port is None and not self._opened():
            time.sleep(within_s)
            return None
        try:
            data: bytes = self._port.read(1)  # waits for it
            data += self._port.read(self._port.in_waiting)
        except OSError:
            self.close()
            return None
        return data or None

    def answer_last(self) -> None:
        pass

    def write(self, data: bytes) -> None:
        if self._port is not None:
            try:
                self._port.write(data)
            except OSError:
                self.close()

    def close(self) -> None:
        if self._port is not None:
            with contextlib.suppress(OSError):
                self._port.close()
        self._port = None

    def _opened(self) -> bool:
        if time.monotonic() < self._due_s:
            return False
        self._due_s = time.monotonic() + _CONNECT_AGAIN_S
        with contextlib.suppress(OSError, ValueError):
            self._port = self._open()
        return self._port is not None


def _resolved(address: Address, kind: int) -> tuple[int, Any]:
    try:
        found = socket.getaddrinfo(address.name, address.number, type=kind)
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"LINK: there is no host {address.name[:80]!r}") from error
    return found[0][0], found[0][4]
