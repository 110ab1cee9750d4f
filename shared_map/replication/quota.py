"""How much of the map's work one author, and all of them together, may cause. Pure: time is an argument."""

from __future__ import annotations

import math
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.wire.messages.marks import MarkSet

_BURST_S = 10
_FORGET_NS = 60 * NS_PER_S
_SPEAKS_NS = _BURST_S * NS_PER_S


@dataclass(slots=True)
class _Budget:
    """Changed marks that may still be caused: fills up to ten seconds' worth, may be overdrawn once."""

    left: float
    since_ns: int

    def fill(self, marks_per_s: float, now_ns: int) -> float:
        elapsed_s = max(now_ns - self.since_ns, 0) / NS_PER_S
        self.left = min(marks_per_s * _BURST_S, self.left + marks_per_s * elapsed_s)
        self.since_ns = max(now_ns, self.since_ns)
        return self.left


@dataclass(slots=True)
class _Author:
    """own    what it may cause at all: fills at `author_marks_per_s`
    share  what nobody else's need can take from it: fills at its part of `total_marks_per_s`
    """

    own: _Budget
    share: _Budget
    spoke_ns: int


class Quota:
    """Budgets of changed marks, per author and in all.

    An author without budget waits. So does, while the budget of all is used up, whoever has also used up its share:
    an equal part, for each author that spoke in the last ten seconds, of the total. Who stays below its share is
    never delayed, however much the others say. Of an author that waits the newest set of each tile is kept and let
    in when budgets have filled up again: it is late, but nothing is lost.
    """

    def __init__(self, author_marks_per_s: float, total_marks_per_s: float = math.inf) -> None:
        self._per_author = author_marks_per_s
        self._in_all = total_marks_per_s
        self._total = _Budget(total_marks_per_s * _BURST_S, 0)
        self._authors: dict[str, _Author] = {}
        self._waiting: dict[str, dict[int, MarkSet]] = {}
        self._speaking = 1
        self._counted_ns = -NS_PER_S

    def admits(self, mark_set: MarkSet, now_ns: int) -> bool:
        """Whether a set may be merged now; if not, it waits."""
        author = mark_set.author
        if author not in self._waiting and self._may(author, now_ns):
            return True
        waiting = self._waiting.setdefault(author, {})
        held = waiting.get(mark_set.tile)
        if held is None or (mark_set.epoch, mark_set.seq) >= (held.epoch, held.seq):
            waiting[mark_set.tile] = mark_set
        return False

    def charge(self, author: str, marks: int, now_ns: int) -> None:
        """Merging a set of this author changed so many cells; a set that changes none costs as much as one."""
        cost = max(marks, 1)
        each = self._filled(author, now_ns)
        each.spoke_ns = now_ns
        each.own.left -= cost
        if self._in_all < math.inf:
            each.share.left -= cost
            # Those within their shares cannot be refused: their overdraft must not keep the others out for ever.
            self._total.left = max(self._total.left - cost, -self._in_all * _BURST_S)

    def due(self, now_ns: int) -> MarkSet | None:
        """A set that has waited long enough; ask until there is none. Authors that wait take turns."""
        for author, waiting in self._waiting.items():
            if self._may(author, now_ns):
                mark_set = waiting.pop(next(iter(waiting)))
                del self._waiting[author]
                if waiting:
                    self._waiting[author] = waiting  # to the end of the queue
                return mark_set
        return None

    @property
    def throttled(self) -> list[str]:
        """Authors whose sets wait now."""
        return sorted(self._waiting)

    def forget(self, now_ns: int) -> None:
        """Drop the budgets that have long been full again."""
        for author, each in list(self._authors.items()):
            if now_ns - each.spoke_ns > _FORGET_NS and author not in self._waiting:
                del self._authors[author]

    def _may(self, author: str, now_ns: int) -> bool:
        each = self._filled(author, now_ns)
        return each.own.left > 0 and (self._total.left > 0 or each.share.left > 0)

    def _filled(self, author: str, now_ns: int) -> _Author:
        each = self._authors.get(author)
        if each is None:
            full, share = self._per_author * _BURST_S, self._share(now_ns) * _BURST_S
            each = self._authors[author] = _Author(_Budget(full, now_ns), _Budget(share, now_ns), now_ns)
        each.own.fill(self._per_author, now_ns)
        if self._in_all < math.inf:
            each.share.fill(self._share(now_ns), now_ns)
            self._total.fill(self._in_all, now_ns)
        return each

    def _share(self, now_ns: int) -> float:
        """Marks per second that each author is sure of. Who speaks is counted once a second."""
        if now_ns - self._counted_ns >= NS_PER_S:
            self._counted_ns = now_ns
            speaking = sum(now_ns - each.spoke_ns < _SPEAKS_NS for each in self._authors.values())
            self._speaking = max(speaking, 1)
        return self._in_all / self._speaking
