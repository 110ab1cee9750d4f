"""Generations of hosts, each a start of a process: their numbers, their file, and the bounds on which all agree."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from swarm.clock import NS_PER_S
from swarm.config.input_files import FileKind
from swarm.files import make_folder
from swarm.journal import Journal

_K = TypeVar("_K")
_V = TypeVar("_V")

HEARTBEAT_NS = NS_PER_S // 5
"""Period at which an unchanged statement is repeated: by it members know of a leader, and a leader of its hosts."""

FURTHEST_EPOCH = 3 << 20
"""No run advances by this number of epochs while one process does not receive them."""
_GENERATION_BITS = 32
"""Bits of chance in a generation's number, by which two that begin at once differ."""
_FURTHEST_GENERATION = 1 << 16
"""Restarts of a host beyond the known number, which no host reaches in a run."""


def was_just_sent(news: object, sent: object, age_ns: int, again_ns: int = HEARTBEAT_NS) -> bool:
    """Returns True if the same was sent so recently that it need not be repeated yet."""
    return news == sent and 0 <= age_ns < again_ns


def keep_last(kept: dict[_K, _V], key: _K, value: _V, most: int) -> None:
    """Adds a value. The oldest goes if there are more than `most`."""
    kept[key] = value
    if len(kept) > most:
        del kept[next(iter(kept))]


def first_generation(after: int, chance: int) -> int:
    """A new generation's number: greater than all that are known. If two begin at the same time, chance decides."""
    return ((after >> _GENERATION_BITS) + 1 << _GENERATION_BITS) | (chance & 0xFFFF_FFFF)


def is_far_ahead(generation: int, known: int) -> bool:
    """Returns True if a number is too high to be explained by restarts."""
    return generation >> _GENERATION_BITS > (known >> _GENERATION_BITS) + _FURTHEST_GENERATION


_SIZE_BYTES = 1 << 13
"""Space for some 30 starts of an external vehicle before its file is written again."""
_GENERATION = struct.Struct("<Q")


class MemoryGenerations:
    """The generations of an external vehicle that have begun here, the oldest first: by them a new one proves that
    those before it have ended.

    These survive a simulated process, not this one. Cells granted to a forgotten generation stay shut until an
    operator removes it.
    """

    def __init__(self) -> None:
        self.generations: list[int] = []

    def save(self, generations: Sequence[int]) -> None:
        self.generations = list(generations)

    def check(self) -> str | None:
        """Looks whether the file is as it was left, and writes it again. Returns the reason if that fails."""
        return None

    def close(self) -> None:
        """Gives it to another process."""


class GenerationFile(MemoryGenerations):
    """A journal of generations, locked for as long as the process lives: so an earlier generation that ran on it
    has ended.

    Raises StoreError if the file is in use, is damaged or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        make_folder(path.parent, 0o700)
        self._journal = Journal(
            path,
            FileKind.GENERATIONS,
            lambda: [_encoded(self.generations)],
            size=_SIZE_BYTES,
            in_use="by this vehicle, which has right of way here already",
        )
        for body in self._journal.found:
            self.generations = [number for (number,) in _GENERATION.iter_unpack(body)]
        self._journal.begin()

    def save(self, generations: Sequence[int]) -> None:
        super().save(generations)
        self._journal.append(_encoded(generations))
        self._journal.sync()

    def check(self) -> str | None:
        return self._journal.reserve()

    def close(self) -> None:
        self._journal.close()


def _encoded(generations: Sequence[int]) -> bytes:
    return b"".join(map(_GENERATION.pack, generations))
