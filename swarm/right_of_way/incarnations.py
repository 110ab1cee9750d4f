"""Incarnations of hosts, here called lives: their numbers, their file, and the bounds on which all agree."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

from swarm.clock import NS_PER_S
from swarm.config.input_files import FileKind
from swarm.files import writing
from swarm.journal import Journal

BEAT_NS = NS_PER_S // 5
"""Period at which an unchanged statement is repeated: by it members know of a warden, and a warden of its hosts."""
FURTHEST_EPOCH = 3 << 20
"""No run advances by this number of epochs while one process does not receive them."""
_LIFE_BITS = 32
"""Bits of chance in a life's number, by which two that begin at once differ."""
_FURTHEST_LIFE = 1 << 16
"""Restarts of a host beyond the known number, which no host reaches in a run."""


def first_life(after: int, chance: int) -> int:
    """A new life's number: greater than all that are known. If two begin at the same time, chance decides."""
    return ((after >> _LIFE_BITS) + 1 << _LIFE_BITS) | (chance & 0xFFFF_FFFF)


def is_far_ahead(life: int, known: int) -> bool:
    """Returns True if a number is too high to be explained by restarts."""
    return life >> _LIFE_BITS > (known >> _LIFE_BITS) + _FURTHEST_LIFE


_SIZE_BYTES = 1 << 13
"""Space for some 30 starts of a guest before its file is written again."""
_LIFE = struct.Struct("<Q")


class MemoryLives:
    """The lives of a guest that have begun here, the oldest first: by them a new life proves that those before it
    have ended.

    These survive a simulated process, not this one. Cells granted to a forgotten life stay shut until an operator
    removes it.
    """

    def __init__(self) -> None:
        self.lives: list[int] = []

    def save(self, lives: Sequence[int]) -> None:
        self.lives = list(lives)

    def close(self) -> None:
        """Gives it to another process."""


class LifeFile(MemoryLives):
    """A journal of lives, locked for as long as the process lives: so an earlier life that ran on it has ended.

    Raises StoreError if the file is in use, is damaged or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        with writing(path):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._journal = Journal(
            path,
            FileKind.LIVES,
            lambda: [_encoded(self.lives)],
            _older,
            size=_SIZE_BYTES,
            in_use="by this vehicle, which has right of way here already",
        )
        for body in self._journal.found:
            self.lives = [number for (number,) in _LIFE.iter_unpack(body)]
        self._journal.begin()

    def save(self, lives: Sequence[int]) -> None:
        super().save(lives)
        self._journal.append(_encoded(lives))
        self._journal.sync()

    def close(self) -> None:
        self._journal.close()


def _encoded(lives: Sequence[int]) -> bytes:
    return b"".join(map(_LIFE.pack, lives))


def _older(data: bytes) -> list[bytes]:
    """The lives in a file from before journals: one number a line."""
    lives = [int(line) for line in data.decode("ascii").splitlines()]
    if not lives or not all(0 < life < 1 << 63 for life in lives):
        raise ValueError(repr(data[:40]))
    return [_encoded(lives)]
