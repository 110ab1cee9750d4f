"""Compaction: what dead authors left shrinks to the statements that can still win.

Of the marks of a group's dead authors in one cell only the newest lasting one can ever win; overruled marks are
dropped from their author's set. A set with nothing left becomes a tombstone: a set without statements, whose number
says that it is compacted, and at which replicas forget that author's set of the tile.

A compacted set has a number between those of the author: it replaces the set which it was made of, and no newer
one. Two keepers may therefore compact with different knowledge: any compacted set keeps every winner. The store
keeps dropped marks permanently.

The law: the compacted sets of a tile are a function of its whole sets, dropped statements included, and of which
authors are dead. Whenever either changes, or may have changed unseen, the tile is due. A mark is therefore missing
from the map only as long as a newer lasting one of a dead author covers it. If that author turns out to live, the
overruled marks are restored before it can retract any.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.replication.digest import Ledger
from shared_map.replication.mark_sets import Statements, base_seq, mark_set, next_expiry_ns, statements, taken
from swarm.wire.messages.map_data import DIGEST_ROW, FOREVER, SEQ_STEP, TILE_AREA, MarkKind, MarkSet

_MOST_AUTHORS = 1 << 14
"""Authors that count as living: names cost a sender nothing."""


class CompactionPlan:
    """Dead authors, and tiles that may need compaction. Core: time is an argument.

    after_ns   an author that was silent for this time counts as dead. If it is alive after all, it receives the
               compacted sets, and states everything again under a higher epoch
    set_aside  tiles of which something was dropped before: whom an earlier life of the keeper took for dead is
               forgotten, so they are due
    """

    def __init__(self, after_ns: int, started_ns: int, set_aside: Iterable[int] = ()) -> None:
        self._after_ns = after_ns
        self._started_ns = started_ns
        self._heard_ns: dict[str, int] = {}  # author -> when it was heard last, of those that are not dead
        self._gone: set[str] = set()  # authors of sets that were dead at the last update
        self._due: dict[int, None] = dict.fromkeys(set_aside)  # tiles to compact, in order
        self._expiries_ns: dict[int, int] = {}  # tile -> when the next statement of a dead author can be dropped

    def note_alive(self, author: str, now_ns: int) -> None:
        """Notes that an author is alive at a time."""
        if author in self._heard_ns or len(self._heard_ns) < _MOST_AUTHORS:
            self._heard_ns[author] = now_ns

    def is_gone(self, author: str) -> bool:
        """Returns True if an author counts as dead since the last update."""
        return author not in self._heard_ns

    def accepted(self, mark_set: MarkSet) -> None:
        """Accepts a merged set: a dead author's may need compaction, or may retract marks that had overruled
        others."""
        if self.is_gone(mark_set.author) or mark_set.author in self._gone:
            self._due[mark_set.tile] = None

    def update(self, ledger: Ledger, now_ns: int) -> None:
        """Finds the authors that died, or turned out to live, since the last call, and makes their tiles due."""
        self._heard_ns = {a: when for a, when in self._heard_ns.items() if now_ns - when <= self._after_ns}
        gone = {author for author in ledger.authors if self.is_gone(author)}
        for rows in ledger.held(sorted(gone ^ self._gone)).values():
            self._due.update(dict.fromkeys(np.frombuffer(rows, DIGEST_ROW)["tile"].tolist()))
        self._gone = gone
        for tile in [tile for tile, expiry_ns in self._expiries_ns.items() if now_ns > expiry_ns]:
            del self._expiries_ns[tile]
            self._due[tile] = None

    def take_due(self, at_most: int, now_ns: int) -> list[int]:
        """Tiles to compact now."""
        if now_ns - self._started_ns <= self._after_ns:
            return []  # not heard for long enough to know which authors are dead
        tiles = list(self._due)[:at_most]
        for tile in tiles:
            del self._due[tile]
        return tiles

    def put_off(self, tiles: Iterable[int]) -> None:
        """Makes tiles due again that could not be compacted."""
        self._due.update(dict.fromkeys(tiles))

    def compacted(self, tile: int, left: Iterable[MarkSet], now_ns: int) -> None:
        """A tile was compacted.

        left  the sets of dead authors since; their statements are dropped once they have expired
        """
        times = [when for each in left if (when := next_expiry_ns(each, now_ns - self._after_ns)) is not None]
        if times:
            self._expiries_ns[tile] = min(times) + self._after_ns


def compact(
    sets: Sequence[MarkSet], dropped: Mapping[str, MarkSet], gone: Collection[str], ended_ns: int
) -> list[MarkSet]:
    """Returns the mark sets to publish so that, for dead authors, only marks which can still win remain in the
    tile. Returns an empty list if nothing is to be removed.

    sets      all sets of one tile
    dropped   author -> marks which an earlier compaction removed from its set of this tile, with the (epoch, seq)
              of the compacted set
    gone      dead authors
    ended_ns  statements which expired by then are dropped, too
    """
    whole: dict[str, MarkSet] = {}
    held = {each.author: each for each in sets}
    for author in sorted(gone):
        complete = _whole(held.get(author), dropped.get(author))
        if complete is not None and max(complete.kinds, default=0) <= MarkKind.CLEAR:
            whole[author] = complete
    compacted = []
    for group in sorted({each.group for each in whole.values()}):
        of_group = {author: each for author, each in whole.items() if each.group == group}
        best_ns, best_rank = _newest_lasting(of_group)
        for rank, (author, complete) in enumerate(of_group.items()):
            stated = statements(complete)
            counts = (stated.stamps_ns > best_ns[stated.cells]) | (
                (stated.stamps_ns == best_ns[stated.cells]) & (rank >= best_rank[stated.cells])
            )
            if stated.untils_ns is not None:
                counts &= stated.untils_ns > ended_ns
            left = taken(stated, np.flatnonzero(counts))
            if (new := _replacing(held.get(author), complete, left)) is not None:
                compacted.append(new)
    return compacted


def _whole(held: MarkSet | None, dropped: MarkSet | None) -> MarkSet | None:
    """Returns the author's own last set as far as it is known: held marks and dropped ones."""
    if dropped is None or held is None:
        return held if dropped is None else dropped
    ours, theirs = (held.epoch, base_seq(held.seq)), (dropped.epoch, base_seq(dropped.seq))
    if ours != theirs:
        return max(held, dropped, key=lambda each: (each.epoch, each.seq))
    return united(held, dropped)


def united(one: MarkSet, other: MarkSet) -> MarkSet:
    """The union of two sets that were compacted from the same one, under the higher number."""
    higher = max(one, other, key=lambda each: (each.epoch, each.seq))
    both = []
    for stated in (statements(one), statements(other)):
        lasting = np.full(len(stated.cells), FOREVER)
        both.append(stated if stated.untils_ns is not None else stated._replace(untils_ns=lasting))
    together = Statements._make(np.concatenate(columns) for columns in zip(*both, strict=True))
    stated = taken(together, np.unique(together.cells, return_index=True)[1])
    return mark_set(higher.author, higher.group, higher.tile, higher.epoch, higher.seq, stated)


def without(whole: MarkSet, left: MarkSet) -> MarkSet:
    """Returns the marks of `whole` in cells without a mark in `left`, under the number of `left`."""
    stated = statements(whole)
    gone = taken(stated, np.flatnonzero(~np.isin(stated.cells, statements(left).cells)))
    return mark_set(whole.author, whole.group, whole.tile, left.epoch, left.seq, gone)


def _newest_lasting(whole: Mapping[str, MarkSet]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(stamp, rank of the author), int64 (1024,) each, of each cell's newest lasting statement; -1 if none."""
    best_ns, best_rank = np.full(TILE_AREA, -1, np.int64), np.full(TILE_AREA, -1, np.int64)
    for rank, each in enumerate(whole.values()):  # in order of author: on a tie the larger stays
        stated = statements(each)
        if stated.untils_ns is not None:
            stated = taken(stated, np.flatnonzero(stated.untils_ns == FOREVER))
        newer = stated.stamps_ns >= best_ns[stated.cells]
        best_ns[stated.cells[newer]], best_rank[stated.cells[newer]] = stated.stamps_ns[newer], rank
    return best_ns, best_rank


def _replacing(held: MarkSet | None, complete: MarkSet, left: Statements) -> MarkSet | None:
    """The set to publish instead of `held`; None if that is right already, or no number is left."""
    if held is None and not len(left.cells):
        return None
    newest = complete if held is None else max(held, complete, key=lambda each: (each.epoch, each.seq))
    seq = newest.seq + 1
    if seq % SEQ_STEP == 0:
        return None
    if seq % SEQ_STEP == SEQ_STEP - 1:
        left = statements(complete)  # under the last number all is put back, as nothing could be after it
    same = held is not None and held.kinds and np.array_equal(statements(held).cells, left.cells)
    if same and held is not None and (held.epoch, held.seq) == (complete.epoch, complete.seq):
        return None  # under a lower number than it had before, others would take it for superseded
    return mark_set(complete.author, complete.group, complete.tile, newest.epoch, seq, left)
