"""Sets of marks: their statements as columns, their numbers, and which of two sets replaces the other.

An author's set of a tile replaces its set with a lower (epoch, seq). Which of several authors' statements wins is
in `merge`. Both rules read only the values in the sets, never when or in which order they arrived.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.config.setting_types import RESERVED_GROUP
from swarm.config.vehicle_classes import MOST_CLASSES
from swarm.grid import TILE_CELLS, GridSpec
from swarm.wire.fields import column, pack_column
from swarm.wire.messages.map_data import FOREVER, SEQ_STEP, STAMP_LIMIT_NS, TILE_AREA, MarkKind, MarkSet, MarkSets

_ZONES = f"{RESERVED_GROUP}."
NO_STATEMENT = -1
"""In place of a stamp: no author states anything about the cell."""


def zone_author(name: str) -> str:
    """The author of the marks which are a zone."""
    return f"{_ZONES}{name}"


def is_zone(author: str) -> bool:
    """Returns True if this author's marks are a zone: an operator's order, which wins over marks of vehicles."""
    return author.startswith(_ZONES)


class Statements(NamedTuple):
    """Statements about cells of one tile, in columns of one length.

    cells      uint16   index in the tile, row-major over 32 x 32; increasing
    kinds      uint8    MarkKind
    paces      float32  s/m, 0 where the kind is not PACE
    stamps_ns  int64    hybrid time; NO_STATEMENT where there is none
    untils_ns  int64    when a statement expires, FOREVER if it does not; None if none of them does
    """

    cells: NDArray[np.uint16]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]
    stamps_ns: NDArray[np.int64]
    untils_ns: NDArray[np.int64] | None = None


_COLUMNS = {"cells": "<u2", "kinds": "<u1", "paces": "<f4", "stamps_ns": "<i8"}
"""Columns that each set has -> their type in it; `untils_ns` is empty where nothing expires."""


def statements(mark_set: MarkSet) -> Statements:
    """The columns of a set, as read-only views of its bytes where possible."""
    kinds = column(mark_set.kinds, "<u1")
    paces = column(mark_set.paces, "<f4")
    if kinds.any():
        paces = np.where(kinds == MarkKind.PACE, paces, np.float32(0))
    untils_ns = column(mark_set.untils_ns, "<i8") if mark_set.untils_ns else None
    return Statements(column(mark_set.cells, "<u2"), kinds, paces, column(mark_set.stamps_ns, "<i8"), untils_ns)


def standing(mark_set: MarkSet, now_ns: int) -> Statements:
    """The columns of a set, without the statements that expired by `now_ns`."""
    stated = statements(mark_set)
    if stated.untils_ns is None:
        return stated
    return taken(stated, np.flatnonzero(stated.untils_ns > now_ns))


def next_expiry_ns(mark_set: MarkSet, after_ns: int) -> int | None:
    """Returns the time of the first expiry of a mark after `after_ns`; None if there is none."""
    if not mark_set.untils_ns:
        return None
    untils_ns = column(mark_set.untils_ns, "<i8")
    coming = untils_ns[(untils_ns > after_ns) & (untils_ns != FOREVER)]
    return int(coming.min()) if len(coming) else None


def mark_set(author: str, group: str, tile: int, epoch: int, seq: int, stated: Statements) -> MarkSet:
    """A set of these statements. Raises ValueError if they break a rule of the wire."""
    columns = {name: pack_column(getattr(stated, name), dtype) for name, dtype in _COLUMNS.items()}
    if stated.untils_ns is not None and (stated.untils_ns != FOREVER).any():
        columns["untils_ns"] = pack_column(stated.untils_ns, "<i8")
    made = MarkSet(author=author, group=group, tile=tile, epoch=epoch, seq=seq, **columns)
    made.check()
    return made


def base_seq(seq: int) -> int:
    """The number of the author's own set which a compacted set was made of; of an own set, its number."""
    return seq - seq % SEQ_STEP


def next_seq(seq: int) -> int:
    """The number of an author's next set: above those of all that its last one can be compacted to."""
    return base_seq(seq) + SEQ_STEP


MAX_AHEAD_NS = 24 * 3600 * NS_PER_S
"""A statement stamped further ahead of the reader's clock than this is refused: no author could overrule one
that is stamped near the limit. As wide as the error of clocks that are set for another zone."""
_CLOCK_WAS_SET_NS = 1_735_689_600 * NS_PER_S
"""2025: a clock before this was never set, as after a start without a network, and says nothing about stamps."""


def is_ahead(of: MarkSet, now_ns: int) -> bool:
    """Returns True if a set has a timestamp further ahead than clocks may differ."""
    if now_ns < _CLOCK_WAS_SET_NS or not of.kinds:
        return False
    return max(memoryview(of.stamps_ns).cast("q")) > now_ns + MAX_AHEAD_NS


def is_tombstone(of: MarkSet) -> bool:
    """Returns True if this set states that no mark of a dead author is left in this tile (see `compaction`)."""
    return not of.kinds and of.seq % SEQ_STEP > 0


def supersedes(new: MarkSet, old: MarkSet) -> bool:
    """Returns True if `new` replaces `old` of the same author and tile: the higher (epoch, seq) does.

    No author puts two different sets under one number, but a damaged payload may look as if it did. Then the larger
    content wins, so that the order of arrival does not matter even there.
    """
    if new.epoch != old.epoch:
        return new.epoch > old.epoch
    if new.seq != old.seq:
        return new.seq > old.seq
    return _content(new) > _content(old)


def _content(of: MarkSet) -> tuple[bytes, bytes, bytes, bytes, bytes, str]:
    return of.cells, of.kinds, of.paces, of.stamps_ns, of.untils_ns, of.group


def fault(of: MarkSet, grid: GridSpec) -> str | None:
    """Reason why a set cannot be part of a map on this grid; None if it can."""
    class_number, tile = grid.class_of_tile(of.tile)
    if tile == grid.tiles or class_number > MOST_CLASSES:
        return f"tile {of.tile} is none of {grid.tiles} for all vehicles or for one of {MOST_CLASSES} classes"
    tile_row, tile_col = divmod(tile, grid.tile_cols)
    cut_off = (tile_row + 1) * TILE_CELLS > grid.rows or (tile_col + 1) * TILE_CELLS > grid.cols
    if of.kinds and cut_off:
        window = grid.tile_window(tile)
        cells = column(of.cells, "<u2")
        height, width = window.row1 - window.row0, window.col1 - window.col0
        if (cells // TILE_CELLS >= height).any() or (cells % TILE_CELLS >= width).any():
            return f"a cell of tile {of.tile} lies outside the grid"
    return None


def dense(stated: Statements) -> Statements:
    """Spread over the 1024 cells of a tile, to be changed in place: CLEAR and NO_STATEMENT where nothing is stated.
    None of them expires."""
    spread = Statements(
        np.arange(TILE_AREA, dtype=np.uint16),
        np.full(TILE_AREA, MarkKind.CLEAR, np.uint8),
        np.zeros(TILE_AREA, np.float32),
        np.full(TILE_AREA, NO_STATEMENT, np.int64),
    )
    cells = stated.cells
    spread.kinds[cells], spread.paces[cells] = stated.kinds, stated.paces
    spread.stamps_ns[cells] = stated.stamps_ns
    return spread


def sparse(spread: Statements) -> Statements:
    """Without the cells that nothing is stated about."""
    return taken(spread, np.flatnonzero(spread.stamps_ns != NO_STATEMENT))


def taken(stated: Statements, where: NDArray[np.intp]) -> Statements:
    """The statements at these places (int (n,)) of the columns."""
    return Statements._make(None if each is None else each[where] for each in stated)


NO_STATEMENTS = Statements(
    np.empty(0, np.uint16), np.empty(0, np.uint8), np.empty(0, np.float32), np.empty(0, np.int64)
)


class HybridClock:
    """Stamps for an author's statements: its own clock, but newer than what it knows about the cell.

    An author can therefore always overrule a mark that it has seen, however far ahead the clock of the other is.
    This is a hybrid logical clock (Kulkarni et al. 2014) kept for each cell: one wrong clock does not carry the
    others along. Bound: of two statements made without knowledge of each other, one by a clock which is d ahead may
    beat a statement up to d younger, until an author that has seen both states something.
    """

    def __init__(self) -> None:
        self._last_ns = 0  # newest time handed to `stamps_ns`: a clock set back makes no older stamps

    def stamps_ns(self, now_ns: int, known_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """One stamp (int64) for each cell.

        known_ns  int64 (cells,)  the newest stamp known about each cell, or NO_STATEMENT
        """
        self._last_ns = max(self._last_ns, now_ns, 0)
        return np.minimum(np.maximum(self._last_ns, known_ns + 1), STAMP_LIMIT_NS - 1)


# Many sets in one message, and back: the form of replies to a late join and a resync.

MAX_BULK_BYTES = 1 << 18
"""A message is cut off at about this size: while the reader merges one, the next is packed and sent."""
_BULK_SETS = 4096
"""Sets in one message: many tombstones have no bytes by which it would be cut off."""


def packed(sets: Iterable[MarkSet]) -> Iterator[MarkSets]:
    """Packs sets, no two of one tile and author, into few messages, each of one author and group."""
    together: dict[tuple[str, str], list[MarkSet]] = {}
    for each in sets:
        together.setdefault((each.author, each.group), []).append(each)
    for (author, group), theirs in together.items():
        for some in _cut(theirs):
            yield _message(author, group, some)


def _cut(sets: list[MarkSet]) -> Iterator[list[MarkSet]]:
    some: list[MarkSet] = []
    size = 0
    for each in sets:
        if some and (size >= MAX_BULK_BYTES or len(some) == _BULK_SETS):
            yield some
            some, size = [], 0
        some.append(each)
        size += 23 + 15 * len(each.kinds) + len(each.untils_ns)
    if some:
        yield some


def _message(author: str, group: str, sets: list[MarkSet]) -> MarkSets:
    return MarkSets(
        author=author,
        group=group,
        tiles=pack_column([each.tile for each in sets], "<u4"),
        epochs=pack_column([each.epoch for each in sets], "<u8"),
        seqs=pack_column([each.seq for each in sets], "<u8"),
        counts=pack_column([len(each.kinds) for each in sets], "<u2"),
        ending=bytes([bool(each.untils_ns) for each in sets]),
        **{name: b"".join([getattr(each, name) for each in sets]) for name in (*_COLUMNS, "untils_ns")},
    )


def unpacked(bulk: MarkSets) -> list[MarkSet]:
    """The sets in a message that passed its checks. Each owns its bytes, so none keeps the whole message alive."""
    counts = column(bulk.counts, "<u2").astype(np.int64)
    ends = np.cumsum(counts)
    lasting = np.cumsum(np.where(column(bulk.ending, "<u1") == 1, counts, 0))
    rows = zip(
        column(bulk.tiles, "<u4").tolist(),
        column(bulk.epochs, "<u8").tolist(),
        column(bulk.seqs, "<u8").tolist(),
        bulk.ending,
        (ends - counts).tolist(),
        ends.tolist(),
        lasting.tolist(),
        strict=True,
    )
    author, group = bulk.author, bulk.group
    cells, kinds, paces, stamps_ns, untils_ns = bulk.cells, bulk.kinds, bulk.paces, bulk.stamps_ns, bulk.untils_ns
    return [
        MarkSet(
            author=author,
            group=group,
            tile=tile,
            epoch=epoch,
            seq=seq,
            cells=cells[2 * first : 2 * end],
            kinds=kinds[first:end],
            paces=paces[4 * first : 4 * end],
            stamps_ns=stamps_ns[8 * first : 8 * end],
            untils_ns=untils_ns[8 * (until - end + first) : 8 * until] if ending else b"",
        )
        for tile, epoch, seq, ending, first, end, until in rows
    ]
