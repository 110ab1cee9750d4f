"""How much of the map's work one author may cause. Pure: time is an argument."""

from __future__ import annotations

from swarm.clock import NS_PER_S
from swarm.messages import MarkSet

_BURST_S = 10
_FORGET_NS = 60 * NS_PER_S


class Quota:
    """A budget of changed marks per author: it fills at `marks_per_s` up to ten seconds' worth and may be overdrawn
    once. Sets of an author without budget wait, the newest of each tile, and are let in when it has filled up
    again: an author that says too much is late, but nothing is lost, and nobody else is affected."""

    def __init__(self, marks_per_s: float) -> None:
        self._marks_per_s = marks_per_s
        self._left: dict[str, tuple[float, int]] = {}  # author -> (budget, when)
        self._waiting: dict[str, dict[int, MarkSet]] = {}

    def admits(self, mark_set: MarkSet, now_ns: int) -> bool:
        """Whether a set may be merged now; if not, it waits."""
        author = mark_set.author
        if author not in self._waiting and self._budget(author, now_ns) > 0:
            return True
        waiting = self._waiting.setdefault(author, {})
        held = waiting.get(mark_set.tile)
        if held is None or (mark_set.epoch, mark_set.seq) >= (held.epoch, held.seq):
            waiting[mark_set.tile] = mark_set
        return False

    def charge(self, author: str, marks: int, now_ns: int) -> None:
        """Merging a set of this author changed so many cells; a set that changes none costs as much as one."""
        self._left[author] = (self._budget(author, now_ns) - max(marks, 1), now_ns)

    def due(self, now_ns: int) -> MarkSet | None:
        """A set that has waited long enough; ask until there is none."""
        for author, waiting in self._waiting.items():
            if self._budget(author, now_ns) > 0:
                mark_set = waiting.pop(next(iter(waiting)))
                if not waiting:
                    del self._waiting[author]
                return mark_set
        return None

    @property
    def throttled(self) -> list[str]:
        """Authors whose sets wait now."""
        return sorted(self._waiting)

    def forget(self, now_ns: int) -> None:
        """Drop the budgets that have long been full again."""
        for author, (_, since_ns) in list(self._left.items()):
            if now_ns - since_ns > _FORGET_NS and author not in self._waiting:
                del self._left[author]

    def _budget(self, author: str, now_ns: int) -> float:
        full = self._marks_per_s * _BURST_S
        left, since_ns = self._left.get(author, (full, now_ns))
        return min(full, left + self._marks_per_s * (now_ns - since_ns) / NS_PER_S)
