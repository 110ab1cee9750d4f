"""The answers to one query on Zenoh."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Protocol

import zenoh

from swarm.bus.bus import USUAL_TIMEOUT_S
from swarm.wire.messages import Message


class Reply(Protocol):
    """Sends one answer to a query whose payload was `asked`, or as a text why there is none."""

    def __call__(
        self, query: zenoh.Query, asked: bytes, message: Message | str, fields: Mapping[str, str | int]
    ) -> None: ...


class ZenohAnswerer:
    """The `Answerer` of one query, which arrives when this is made. `_query` is None after the end.

    asked  its payload
    """

    def __init__(self, query: zenoh.Query, asked: bytes, reply: Reply) -> None:
        self._query: zenoh.Query | None = query
        self._reply = reply
        self.asked = asked
        self._arrived_s = time.monotonic()
        self.timeout_s = USUAL_TIMEOUT_S

    def waited_s(self) -> float:
        return time.monotonic() - self._arrived_s

    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None:
        if self._query is None:
            raise RuntimeError("answered after the end")
        self._reply(self._query, self.asked, message, fields)

    def refuse(self, reason: str) -> None:
        if self._query is not None:
            self._reply(self._query, self.asked, reason, {})

    def end(self) -> None:
        # Zenoh ends a query when its last handle goes; `drop` does it now, not at the next garbage collection.
        if self._query is not None:
            self._query.drop()  # type: ignore[no-untyped-call]
            self._query = None
