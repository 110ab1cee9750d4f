"""How much a replica may hold: a hostile author could fill everybody's memory, one tile or name at a time."""

from __future__ import annotations

from swarm.messages import MarkSet

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
        self._authors: dict[str, tuple[int, int]] = {}  # -> (sets, marks)

    def for_set(self, new: MarkSet, old: MarkSet | None) -> bool:
        """Whether there is room to replace `old` by `new`. There always is for what takes no more than before."""
        more_sets = old is None
        more_marks = len(new.kinds) - (0 if old is None else len(old.kinds))
        if more_marks <= 0 and not more_sets:
            return True
        sets, marks = self._authors.get(new.author, (0, 0))
        if more_sets and (self.sets >= self._max_sets or sets >= self._max_sets // _SHARE):
            return False
        return more_marks <= 0 or (
            self.marks + more_marks <= self._max_marks and marks + more_marks <= self._max_marks // _SHARE
        )

    def take(self, new: MarkSet, old: MarkSet | None) -> None:
        """`new` is held now, in the place of `old`."""
        more_sets = int(old is None)
        more_marks = len(new.kinds) - (0 if old is None else len(old.kinds))
        sets, marks = self._authors.get(new.author, (0, 0))
        self._authors[new.author] = (sets + more_sets, marks + more_marks)
        self.sets += more_sets
        self.marks += more_marks

    def full_for(self, author: str) -> bool:
        """Whether an author's next set of a new tile would have no room."""
        sets, marks = self._authors.get(author, (0, 0))
        return (
            self.sets >= self._max_sets
            or self.marks >= self._max_marks
            or sets >= self._max_sets // _SHARE
            or marks >= self._max_marks // _SHARE
        )
