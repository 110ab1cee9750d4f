"""Incarnations of hosts, here called lives: their numbers, their file, and the bounds on which all agree."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Sequence
from pathlib import Path

from swarm.clock import NS_PER_S
from swarm.errors import StoreError
from swarm.files import write_file

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


_MOST_BYTES = 1 << 16
"""A file of lives has 32 numbers (`LIVES_KEPT`); more of it is not read."""


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
    """A file, locked for as long as the process lives: so an earlier life that ran on it has ended.

    Raises StoreError if the file is in use, is not ours or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = os.open(f"{path}.lock", os.O_CREAT | os.O_RDWR, 0o600)
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            text = path.read_bytes()[:_MOST_BYTES] if path.exists() else b""
        except BlockingIOError as error:
            raise StoreError(f"{path} is in use: this vehicle has right of way here already") from error
        except OSError as error:
            raise StoreError(f"cannot open {path}: {error.strerror}") from error
        try:
            self.lives = [int(line) for line in text.split()]
        except ValueError as error:
            raise StoreError(f"{path} is damaged: expected one number a line, found {text[:40]!r}") from error

    def save(self, lives: Sequence[int]) -> None:
        super().save(lives)
        write_file(self._path, "".join(f"{life}\n" for life in lives).encode())

    def close(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1
