"""The port of the stream for viewers: lets visitors of this machine through to rerun's own server.

rerun lets pages read its answers only if their Origin is on loopback, but looks at no Host: a page whose name leads
to loopback may read and write there. So rerun listens on a loopback address that is drawn by chance, and this gate
at the port that people know.
"""

from __future__ import annotations

import select
import socket
import socketserver

from launch_scripts.web.loopback_guard import BoundedServer, refusal

_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
"""So begins HTTP/2 in the clear, which native viewers speak and no browser does."""
_HEAD_BYTES = 1 << 14
_HEAD_WITHIN_S = 5.0
SEND_WITHIN_S = 20.0
"""A reader that takes nothing for so long is cut off."""
_PIECE_BYTES = 1 << 16


class StreamGate(BoundedServer):
    """behind  address of rerun's server"""

    def __init__(self, port: int, behind: tuple[str, int]) -> None:
        self.behind = behind
        super().__init__(port, _Visit)


class _Visit(socketserver.BaseRequestHandler):
    server: StreamGate
    request: socket.socket

    def handle(self) -> None:
        self.request.settimeout(_HEAD_WITHIN_S)
        head = self._head()
        if not head.startswith(_PREFACE):
            why, head = _checked(head)
            if why is not None:
                body = f"{why}\n".encode()
                self.request.sendall(
                    b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nConnection: close\r\n"
                    b"Content-Length: %d\r\n\r\n%s" % (len(body), body)
                )
                return
        with socket.create_connection(self.server.behind, timeout=SEND_WITHIN_S) as inner:
            self.server.keep(self.request)
            self.request.settimeout(SEND_WITHIN_S)
            inner.sendall(head)
            join_sockets(self.request, inner)

    def _head(self) -> bytes:
        """The first bytes of a connection, up to the end of what tells who comes."""
        head = b""
        while len(head) < _HEAD_BYTES:
            piece = self.request.recv(_HEAD_BYTES - len(head))
            if not piece:
                break
            head += piece
            if head.startswith(_PREFACE) or (b"\r\n\r\n" in head and not _PREFACE.startswith(head[:14])):
                break
        return head


def _checked(head: bytes) -> tuple[str | None, bytes]:
    """(why a request is refused, the request as it is passed on). One a connection, as only its head is read."""
    first, end, body = head.partition(b"\r\n\r\n")
    line, *fields = first.decode("latin1").split("\r\n")
    headers: dict[str, str] = {}
    for field in fields:
        name, colon, value = field.partition(":")
        name = name.lower()
        if not colon or name != name.strip() or (name in headers and name in ("host", "origin")):
            return "the request is none of HTTP", b""
        headers[name] = value.strip()
    if not end:
        return "the head of the request has no end", b""
    why = refusal(headers)
    kept = [line, *(field for field in fields if not field.lower().startswith(("connection:", "keep-alive:")))]
    return why, "\r\n".join([*kept, "Connection: close"]).encode("latin1") + end + body


def join_sockets(one: socket.socket, other: socket.socket) -> None:
    """Pass on what either says, until one has no more to say."""
    while True:
        ready, _, _ = select.select([one, other], [], [])
        for source in ready:
            piece = source.recv(_PIECE_BYTES)
            if not piece:
                return
            (other if source is one else one).sendall(piece)
