"""Tombstones heard lately, so that an old set which arrives late is not taken for news."""

from __future__ import annotations

from swarm.clock import NS_PER_S
from swarm.wire.messages.map_data import MarkSet

REMEMBERED_NS = 600 * NS_PER_S
"""A set which arrives later than this after its tombstone is held again. No digest of a keeper names it, so it is
offered to the keepers, which remember tombstones for much longer and send this one again."""
_MAX_TOMBSTONES = 1 << 16


class Tombstones:
    """(tile, author) -> the number under which the author's set was deleted, oldest first."""

    def __init__(self) -> None:
        self._deleted: dict[tuple[int, str], tuple[int, int, int]] = {}  # -> (epoch, seq, when heard)

    def covers(self, received: MarkSet) -> bool:
        """Whether a set was deleted already. Drops the tombstone of an author that states something newer."""
        if not self._deleted:
            return False
        tombstone = self._deleted.get((received.tile, received.author))
        if tombstone is None:
            return False
        number = (received.epoch, received.seq)
        if number < tombstone[:2] or (number == tombstone[:2] and not received.kinds):
            return True
        del self._deleted[received.tile, received.author]
        return False

    def above(self, tile: int, author: str, number: tuple[int, int]) -> bool:
        """Whether a tombstone of this (epoch, seq) or above is known."""
        tombstone = self._deleted.get((tile, author))
        return tombstone is not None and tombstone[:2] >= number

    def add(self, tombstone: MarkSet, now_ns: int) -> None:
        """Remember a tombstone; beyond 65,536 the oldest is forgotten."""
        self._deleted[tombstone.tile, tombstone.author] = (tombstone.epoch, tombstone.seq, now_ns)
        if len(self._deleted) > _MAX_TOMBSTONES:
            del self._deleted[next(iter(self._deleted))]

    def expire(self, now_ns: int) -> None:
        """Forget tombstones which are older than REMEMBERED_NS."""
        while self._deleted:
            key, (_, _, since_ns) = next(iter(self._deleted.items()))
            if now_ns - since_ns <= REMEMBERED_NS:
                return
            del self._deleted[key]

    def __len__(self) -> int:
        return len(self._deleted)
