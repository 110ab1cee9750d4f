"""What was buried lately, so that an old set that turns up late is not taken for news."""

from __future__ import annotations

from swarm.clock import NS_PER_S
from swarm.wire.messages.marks import MarkSet

REMEMBERED_NS = 600 * NS_PER_S
"""A set that is longer on its way comes back to life at who hears it, until a keeper buries it again: its digest
does not tell of it, so it is offered to the keeper, which keeps the numbers of what it buried for much longer."""
_MOST = 1 << 16


class Graves:
    """(tile, author) -> the number under which it was buried, in order of burial."""

    def __init__(self) -> None:
        self._graves: dict[tuple[int, str], tuple[int, int, int]] = {}  # -> (epoch, seq, when)

    def holds(self, received: MarkSet) -> bool:
        """Whether a set was buried already; the grave of an author that says something newer is opened."""
        grave = self._graves.get((received.tile, received.author))
        if grave is None:
            return False
        number = (received.epoch, received.seq)
        if number < grave[:2] or (number == grave[:2] and not received.kinds):
            return True
        del self._graves[received.tile, received.author]
        return False

    def dig(self, burial: MarkSet, now_ns: int) -> None:
        self._graves[burial.tile, burial.author] = (burial.epoch, burial.seq, now_ns)
        if len(self._graves) > _MOST:
            del self._graves[next(iter(self._graves))]

    def forget(self, now_ns: int) -> None:
        """Drop what was buried long ago."""
        while self._graves:
            key, (_, _, since_ns) = next(iter(self._graves.items()))
            if now_ns - since_ns <= REMEMBERED_NS:
                return
            del self._graves[key]

    def __len__(self) -> int:
        return len(self._graves)
