"""Limits of one author in a replica: memory (`Capacity`) and work (`Quota`)."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.wire.messages.map_data import TILE_AREA, MarkSet, owner_of

MAX_SETS = 1 << 18
"""Sets in all, empty ones included: every tile of a 16,384 x 16,384 map once. About half a kilobyte each."""
MAX_MARKS = 1 << 23
"""Statements in all; 15 bytes each, 23 where some of the set expire."""
_PART = 4
"""No process may fill more than one part in this many of any of these."""

_MAX_WAITING = 1 << 14
"""Sets of throttled processes that wait, in all. Sets without a place are requested again once a digest names them
(docs/reference/limits.md)."""

_TURNS = 128
"""Turns of waiting processes in one tick, some 10 ms: names cost a sender nothing."""

_MOST_OWNERS = 4096
"""Processes with a budget of their own; all later ones share one, as names cost a sender nothing."""
_OTHERS = ""

_BURST_S = 10
"""A full bucket lasts so long at its rate: a vehicle that finds a burnt forest may tell of it at once."""
_FORGET_NS = 60 * NS_PER_S
"""A process that was silent for this time, and waits for nothing, loses its budget: its bucket is full by then."""
_SPEAKS_NS = _BURST_S * NS_PER_S
"""An author that was silent for longer has a full bucket, and needs no share."""


_NOTHING = (0, 0)
"""Sets and statements of a process that holds none."""


class Capacity:
    """Counts the sets and statements held, in all and by process; refuses a set which would exceed a bound.

    Which sets are refused depends on what came first, so replicas are equal only within the bounds. The bounds
    limit the memory to some 330 MB, a quarter of it for one process.

    sets, marks  held now
    """

    def __init__(self, max_sets: int = MAX_SETS, max_marks: int = MAX_MARKS) -> None:
        self.sets = 0
        self.marks = 0
        self._max_sets, self._max_marks = max_sets, max_marks
        self._owners: dict[str, tuple[int, int]] = {}  # process -> (sets, marks), of those that hold any

    def take(self, new: MarkSet, old: MarkSet | None, *, own: bool = False) -> bool:
        """Counts `new` instead of `old`; False, and nothing changes, if that exceeds a bound. A set which takes no
        more than before is never refused.

        own  no bound applies
        """
        owner, marks = owner_of(new.author), len(new.kinds)
        sets, more = (1, marks) if old is None else (0, marks - len(old.kinds))
        if not own and (sets or more > 0) and not self._fits(owner, sets, more):
            return False
        self._count(owner, sets, more)
        return True

    def free(self, old: MarkSet) -> None:
        """Notes that a set is not held any more."""
        self._count(owner_of(old.author), -1, -len(old.kinds))

    def full_for(self, author: str) -> bool:
        """True if an author's set of one more tile could exceed a bound, were it to cover every cell."""
        return not self._fits(owner_of(author), 1, TILE_AREA)

    def _fits(self, owner: str, sets: int, marks: int) -> bool:
        """Returns True if these additions stay within the bounds; set bounds apply only if a set is added."""
        own_sets, own_marks = self._owners.get(owner, _NOTHING)
        return (
            self.marks + marks <= self._max_marks
            and own_marks + marks <= self._max_marks // _PART
            and (not sets or (self.sets < self._max_sets and own_sets < self._max_sets // _PART))
        )

    def _count(self, owner: str, sets: int, marks: int) -> None:
        own_sets, own_marks = self._owners.get(owner, _NOTHING)
        self._owners[owner] = (own_sets + sets, own_marks + marks)
        if self._owners[owner] == _NOTHING:
            del self._owners[owner]
        self.sets += sets
        self.marks += marks


class Quota:
    """Token buckets of changed marks, for each process that writes and for all together. Time is an argument.

    A process whose bucket is empty waits. While the shared bucket is empty, those above their share wait too: each
    that was heard in the last ten seconds has an equal share of the total rate. One below its share is never
    delayed, whatever the others do. Of a waiting author the newest set of each tile is kept, and admitted once its
    buckets have filled: it is late, but not lost.
    """

    def __init__(self, author_marks_per_s: float, total_marks_per_s: float = math.inf) -> None:
        self._author_rate = author_marks_per_s
        self._total_rate = total_marks_per_s
        self._total = _Bucket(total_marks_per_s * _BURST_S, 0)
        self._owners: dict[str, _Budget] = {}
        # Process -> (tile, author) -> newest set; the process whose turn is next comes first.
        self.waiting: OrderedDict[str, dict[tuple[int, str], MarkSet]] = OrderedDict()
        self._waiting_sets = 0
        self._speaking = 1  # authors heard lately, counted at `_counted_ns`
        self._counted_ns = -NS_PER_S

    def admits(self, mark_set: MarkSet, now_ns: int) -> bool:
        """Returns True if a set may be merged now; if not, it waits here, while there is a place for it."""
        owner = owner_of(mark_set.author)
        if owner not in self.waiting and self._may(owner, now_ns):
            return True
        waiting = self.waiting.get(owner, {})
        at = (mark_set.tile, mark_set.author)
        held = waiting.get(at)
        if held is None and (len(waiting) >= _MAX_WAITING // _PART or self._waiting_sets >= _MAX_WAITING):
            return False
        if held is None or (mark_set.epoch, mark_set.seq) >= (held.epoch, held.seq):
            self._waiting_sets += held is None
            waiting[at] = mark_set
            self.waiting[owner] = waiting
        return False

    def charge(self, author: str, marks: int, now_ns: int) -> None:
        """Charges the author for the cells that merging its set changed; a set that changes none costs as much as
        one."""
        cost = max(marks, 1)
        each = self._filled(owner_of(author), now_ns)
        each.heard_ns = now_ns
        each.own.left -= cost
        each.share.left -= cost
        # Authors within their shares cannot be refused: what they overdraw must not keep others out for ever.
        self._total.left = max(self._total.left - cost, -self._total_rate * _BURST_S)

    def due(self, now_ns: int) -> Iterator[MarkSet]:
        """Sets which have waited long enough. Waiting processes take turns, of which a tick has `_TURNS`. The
        caller charges for each set before it takes the next."""
        for _ in range(_TURNS):
            if not self.waiting:
                return
            owner, waiting = next(iter(self.waiting.items()))
            self.waiting.move_to_end(owner)
            if self._may(owner, now_ns):
                mark_set = waiting.pop(next(iter(waiting)))
                self._waiting_sets -= 1
                if not waiting:
                    del self.waiting[owner]
                yield mark_set

    @property
    def throttled(self) -> list[str]:
        """Processes whose sets wait now."""
        return sorted(self.waiting)

    def forget(self, now_ns: int) -> None:
        """Drops the buckets of those that were silent for a minute: they are full again."""
        for owner, each in list(self._owners.items()):
            if now_ns - each.heard_ns > _FORGET_NS and owner not in self.waiting:
                del self._owners[owner]

    def _may(self, owner: str, now_ns: int) -> bool:
        each = self._filled(owner, now_ns)
        return each.own.left > 0 and (self._total.left > 0 or each.share.left > 0)

    def _filled(self, owner: str, now_ns: int) -> _Budget:
        if owner not in self._owners and len(self._owners) >= _MOST_OWNERS:
            owner = _OTHERS
        each = self._owners.get(owner)
        if each is None:
            own, share = self._author_rate * _BURST_S, self._share(now_ns) * _BURST_S
            each = self._owners[owner] = _Budget(_Bucket(own, now_ns), _Bucket(share, now_ns), now_ns)
        each.own.fill(self._author_rate, now_ns)
        each.share.fill(self._share(now_ns), now_ns)
        self._total.fill(self._total_rate, now_ns)
        return each

    def _share(self, now_ns: int) -> float:
        """Marks per second that each process is sure of. Processes are counted once a second."""
        if now_ns - self._counted_ns >= NS_PER_S:
            self._counted_ns = now_ns
            speaking = sum(now_ns - each.heard_ns < _SPEAKS_NS for each in self._owners.values())
            self._speaking = max(speaking, 1)
        return self._total_rate / self._speaking


@dataclass(slots=True)
class _Bucket:
    """Changed marks that may still be caused: fills up to ten seconds' worth, and may be overdrawn once."""

    left: float
    since_ns: int

    def fill(self, marks_per_s: float, now_ns: int) -> None:
        if now_ns <= self.since_ns:
            return  # as most often: a tick's sets are admitted and charged at one time
        elapsed_s = (now_ns - self.since_ns) / NS_PER_S
        self.left = min(marks_per_s * _BURST_S, self.left + marks_per_s * elapsed_s)
        self.since_ns = now_ns


@dataclass(slots=True)
class _Budget:
    """Limits of one author.

    own       fills at the rate of one process
    share     fills at this process's part of the total rate: others cannot use it
    heard_ns  when a set of it was merged last
    """

    own: _Bucket
    share: _Bucket
    heard_ns: int
