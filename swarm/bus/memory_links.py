"""What becomes of messages between the nodes of a `MemoryNetwork`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class LinkModel(Protocol):
    """What happens to a message between two nodes."""

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        """One delay per copy that arrives; none where it is lost."""
        ...

    def connected(self, source: str, destination: str, now_ns: int) -> bool:
        """Whether the network holds the two for connected, in the direction of the message. Tokens and queries
        depend on it. It may lag behind `delays_ns`: a cut is noticed when the lease runs out."""
        ...


class PerfectLinks:
    """Every message arrives once, after the same short time."""

    def __init__(self, delay_ns: int = 200_000) -> None:
        self._delays = (delay_ns,)

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        return self._delays

    def connected(self, source: str, destination: str, now_ns: int) -> bool:
        return True
