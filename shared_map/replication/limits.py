"""How much a replica may hold: a hostile author could fill everybody's memory, one tile or name at a time."""

from __future__ import annotations

from swarm.wire.messages.marks import MarkSet
from swarm.wire.statements import TILE_AREA

MAX_SETS = 1 << 18
"""Sets in all, tombstones included: every tile of a 16,384 x 16,384 map once. About half a kilobyte each."""
MAX_MARKS = 1 << 23
"""Statements in all; 15 bytes each, 23 where they end by themselves."""
_SHARE = 4
"""No author may fill more than this part of either."""


class Room:
    """Counts what is held, in all and by author. Beyond the bounds a set that would add to it has no room.

    What is refused depends on what came first: only within the bounds do replicas hold the same. They are there
    so that a hostile author costs memory that one can state (some 330 MB) and not more.
    """

    def __init__(self, max_sets: int = MAX_SETS, max_marks: int = MAX_MARKS) -> None:
        self.sets = 0
        self.marks = 0
        self._max_sets, self._max_marks = max_sets, max_marks
        self._authors: dict[str, list[int]] = {}  # -> [sets, marks]

    def take(self, new: MarkSet, old: MarkSet | None, *, own: bool = False) -> bool:
        """Make room for `new` in the place of `old`; False if there is none. There always is for what takes no more
        than before, and for one's own."""
        marks = len(new.kinds)
        sets = 1
        if old is not None:
            marks -= len(old.kinds)
            sets = 0
        held = self._authors.get(new.author)
        if held is None:
            held = [0, 0]
        if (
            not own
            and (sets or marks > 0)
            and (
                (sets and (self.sets >= self._max_sets or held[0] >= self._max_sets // _SHARE))
                or self.marks + marks > self._max_marks
                or held[1] + marks > self._max_marks // _SHARE
            )
        ):
            return False
        self._authors[new.author] = held
        held[0] += sets
        held[1] += marks
        self.sets += sets
        self.marks += marks
        return True

    def take_new(self, author: str, sets: int, marks: int) -> bool:
        """As `take` of so many sets that replace none; False, and nothing taken, unless there is room for all."""
        held = self._authors.get(author, (0, 0))
        if (
            self.sets + sets > self._max_sets
            or held[0] + sets > self._max_sets // _SHARE
            or self.marks + marks > self._max_marks
            or held[1] + marks > self._max_marks // _SHARE
        ):
            return False
        self._authors[author] = [held[0] + sets, held[1] + marks]
        self.sets += sets
        self.marks += marks
        return True

    def free(self, old: MarkSet) -> None:
        """`old` is held no more."""
        held = self._authors[old.author]
        held[0] -= 1
        held[1] -= len(old.kinds)
        self.sets -= 1
        self.marks -= len(old.kinds)
        if held == [0, 0]:
            del self._authors[old.author]

    def full_for(self, author: str) -> bool:
        """Whether an author's next set of a new tile, a full one at worst, would have no room."""
        sets, marks = self._authors.get(author, (0, 0))
        return (
            self.sets >= self._max_sets
            or self.marks + TILE_AREA > self._max_marks
            or sets >= self._max_sets // _SHARE
            or marks + TILE_AREA > self._max_marks // _SHARE
        )
