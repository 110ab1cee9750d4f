"""Folding: what authors that are gone have left behind shrinks to what still counts.

Of the statements of a group's dead authors about one cell only the newest lasting one can ever win: what it
overrules is dropped from its author's set. A set with nothing left in it is buried: a set without statements whose
number says that it is a folding, at which replicas forget the tile of that author.

A folding stands under a number between the author's own: it replaces the set that it was made of, and no newer one.
So two keepers may fold with different knowledge: whichever folding stays, no winner has been dropped. What was
dropped lies in the keeper's store for a while, and is put back when it counts after all, because a set turns up
that takes back what had overruled it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.replication.digest import Ledger
from shared_map.replication.marks import Statements, base_seq, first_end_ns, mark_set, statements, taken
from swarm.wire.messages.marks import DIGEST_ROW, FOLDS, MarkSet
from swarm.wire.statements import FOREVER, TILE_AREA, MarkKind


class FoldPlan:
    """Which authors are gone, and which tiles may have something to fold. Core: time is an argument.

    after_ns  an author of whom nothing was heard for so long is taken for dead. Should it live, it hears what
              became of its sets, and says all again under a higher epoch.
    """

    def __init__(self, after_ns: int, started_ns: int) -> None:
        self._after_ns = after_ns
        self._started_ns = started_ns
        self._heard_ns: dict[str, int] = {}
        self._gone: set[str] = set()  # those whose tiles have been looked at
        self._due: dict[int, bool] = {}  # tile -> whether what was dropped there may count again
        self._begun = False
        self._ends_ns: dict[int, int] = {}  # tile -> when the next statement of a dead author has ended

    def heard(self, author: str, now_ns: int) -> None:
        """It lives."""
        self._heard_ns[author] = now_ns

    def is_gone(self, author: str, now_ns: int) -> bool:
        return now_ns - self._heard_ns.get(author, self._started_ns) > self._after_ns

    def accepted(self, mark_set: MarkSet) -> None:
        """A set came: of a dead author, it may be one to fold, or take back what had overruled others."""
        if mark_set.author not in self._heard_ns:
            self._due[mark_set.tile] = True

    def update(self, ledger: Ledger, now_ns: int) -> None:
        """Notice who is gone since the last time."""
        self._heard_ns = {a: when for a, when in self._heard_ns.items() if now_ns - when <= self._after_ns}
        gone = {author for author in ledger.authors if self.is_gone(author, now_ns)}
        for rows in ledger.held(sorted(gone - self._gone)).values():
            for tile in np.frombuffer(rows, DIGEST_ROW)["tile"].tolist():
                # One more that is dead overrules more, and never less; only what came before we began is not known.
                self._due[tile] = self._due.get(tile, not self._begun)
        self._begun = self._begun or now_ns - self._started_ns > self._after_ns
        self._gone = gone
        for tile in [tile for tile, end_ns in self._ends_ns.items() if now_ns > end_ns]:
            del self._ends_ns[tile]
            self._due[tile] = True

    def take_due(self, at_most: int, now_ns: int) -> dict[int, bool]:
        """Tiles to look at now, and whether also at what was dropped there before."""
        if now_ns - self._started_ns <= self._after_ns:
            return {}  # we have not listened for long enough to take anybody for dead
        return {tile: self._due.pop(tile) for tile in list(self._due)[:at_most]}

    def put_off(self, tiles: Mapping[int, bool]) -> None:
        """These could not be folded now."""
        for tile, dropped_too in tiles.items():
            self._due[tile] = dropped_too or self._due.get(tile, False)

    def folded(self, tile: int, left: Iterable[MarkSet], now_ns: int) -> None:
        """What is left of a tile's dead authors; statements that end by themselves are dropped when they have."""
        ends = [end_ns for each in left if (end_ns := first_end_ns(each, now_ns - self._after_ns)) is not None]
        if ends:
            self._ends_ns[tile] = min(ends) + self._after_ns


def fold(
    sets: Sequence[MarkSet], dropped: Mapping[str, MarkSet], gone: Collection[str], ended_ns: int
) -> list[MarkSet]:
    """The sets to put so that of a tile's dead authors only what counts is left; none if that is so.

    sets      all sets of one tile
    dropped   author -> what was dropped from its set of this tile before, under the number of that folding
    gone      authors that are taken for dead
    ended_ns  statements that ended by themselves before this are dropped, too
    """
    whole: dict[str, MarkSet] = {}
    held = {each.author: each for each in sets}
    for author in sorted(gone):
        complete = _whole(held.get(author), dropped.get(author))
        if complete is not None and max(complete.kinds, default=0) <= MarkKind.CLEAR:
            whole[author] = complete
    folded = []
    for group in sorted({each.group for each in whole.values()}):
        of_group = {author: each for author, each in whole.items() if each.group == group}
        best_ns, best_rank = _newest_lasting(of_group)
        for rank, (author, complete) in enumerate(of_group.items()):
            said = statements(complete)
            counts = (said.stamps_ns > best_ns[said.cells]) | (
                (said.stamps_ns == best_ns[said.cells]) & (rank >= best_rank[said.cells])
            )
            if said.untils_ns is not None:
                counts &= said.untils_ns > ended_ns
            left = taken(said, np.flatnonzero(counts))
            if (new := _replacing(held.get(author), complete, left)) is not None:
                folded.append(new)
    return folded


def _whole(held: MarkSet | None, dropped: MarkSet | None) -> MarkSet | None:
    """All that an author is known to have said last: what is held of it with what was dropped from it."""
    if dropped is None or held is None:
        return held if dropped is None else dropped
    ours, theirs = (held.epoch, base_seq(held.seq)), (dropped.epoch, base_seq(dropped.seq))
    if ours != theirs:
        return max(held, dropped, key=lambda each: (each.epoch, each.seq))
    return united(held, dropped)


def united(one: MarkSet, other: MarkSet | None = None) -> MarkSet:
    """Two foldings of one set, together: what is in either, under the higher number."""
    if other is None:
        return one
    higher = max(one, other, key=lambda each: (each.epoch, each.seq))
    a, b = statements(one), statements(other)
    cells, first = np.unique(np.concatenate([a.cells, b.cells]), return_index=True)
    lasting = (np.full(len(said.cells), FOREVER) for said in (a, b))
    untils = [u if said.untils_ns is None else said.untils_ns for said, u in zip((a, b), lasting, strict=True)]
    said = Statements(
        cells,
        np.concatenate([a.kinds, b.kinds])[first],
        np.concatenate([a.paces, b.paces])[first],
        np.concatenate([a.stamps_ns, b.stamps_ns])[first],
        np.concatenate(untils)[first],
    )
    return mark_set(higher.author, higher.group, higher.tile, higher.epoch, higher.seq, said)


def without(whole: MarkSet, left: MarkSet) -> MarkSet:
    """What is in one set and about no cell of the other, under the other's number."""
    said = statements(whole)
    gone = taken(said, np.flatnonzero(~np.isin(said.cells, statements(left).cells)))
    return mark_set(whole.author, whole.group, whole.tile, left.epoch, left.seq, gone)


def _newest_lasting(whole: Mapping[str, MarkSet]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(stamp, rank of the author) per cell of the newest statement that does not end; -1 where there is none."""
    best_ns, best_rank = np.full(TILE_AREA, -1, np.int64), np.full(TILE_AREA, -1, np.int64)
    for rank, each in enumerate(whole.values()):  # in order of author: on a tie the larger stays
        said = statements(each)
        if said.untils_ns is not None:
            said = taken(said, np.flatnonzero(said.untils_ns == FOREVER))
        newer = said.stamps_ns >= best_ns[said.cells]
        best_ns[said.cells[newer]], best_rank[said.cells[newer]] = said.stamps_ns[newer], rank
    return best_ns, best_rank


def _replacing(held: MarkSet | None, complete: MarkSet, left: Statements) -> MarkSet | None:
    """The set to put instead of the one held; None where that is right already or no number is left."""
    if held is None and not len(left.cells):
        return None
    same = held is not None and held.kinds and np.array_equal(statements(held).cells, left.cells)
    if same and held is not None and (held.epoch, base_seq(held.seq)) == (complete.epoch, base_seq(complete.seq)):
        return None
    newest = complete if held is None else max(held, complete, key=lambda each: (each.epoch, each.seq))
    seq = newest.seq + 1
    if seq % FOLDS == 0:
        return None
    return mark_set(complete.author, complete.group, complete.tile, newest.epoch, seq, left)
