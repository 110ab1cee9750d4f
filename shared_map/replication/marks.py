"""Marks and their merge rule. An author's set for a tile replaces its set with a lower (epoch, seq); of several
authors' statements about one cell the newest wins, on a tie the one of the larger author id.

Every decision is made on the values in the sets, never on when or in which order they were received: that is why
merging depends on neither order, grouping nor repetition.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm.grid import REGION_TILES, TILE_CELLS, GridSpec
from swarm.wire.fields import column, pack_column
from swarm.wire.messages.marks import FOLDS, MarkSet
from swarm.wire.statements import FOREVER, STAMP_LIMIT_NS, TILE_AREA, MarkKind

NO_STATEMENT = -1
"""In place of a stamp: nobody says anything about the cell."""


class Statements(NamedTuple):
    """Columns of statements about cells of one tile; all of one length.

    cells      index inside the tile, increasing
    kinds      MarkKind
    paces      s/m, 0 where the kind is not PACE
    stamps_ns  hybrid time, NO_STATEMENT where there is none
    untils_ns  when a statement ends by itself, FOREVER if it does not; None if none of them does
    """

    cells: NDArray[np.uint16]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]
    stamps_ns: NDArray[np.int64]
    untils_ns: NDArray[np.int64] | None = None


def statements(mark_set: MarkSet) -> Statements:
    """The columns of a set."""
    kinds = column(mark_set.kinds, "<u1")
    paces = column(mark_set.paces, "<f4")
    if max(mark_set.kinds, default=_PACE) != _PACE:
        paces = np.where(kinds == _PACE, paces, _NO_PACE)
    untils_ns = column(mark_set.untils_ns, "<i8") if mark_set.untils_ns else None
    return Statements(column(mark_set.cells, "<u2"), kinds, paces, column(mark_set.stamps_ns, "<i8"), untils_ns)


def standing(mark_set: MarkSet, now_ns: int) -> Statements:
    """The columns of a set, without the statements that have ended."""
    said = statements(mark_set)
    if said.untils_ns is None or not len(said.cells):
        return said
    return taken(said, np.flatnonzero(said.untils_ns > now_ns))


def first_end_ns(mark_set: MarkSet, after_ns: int) -> int | None:
    """When the next of a set's statements ends by itself; None if none does."""
    if not mark_set.untils_ns:
        return None
    untils_ns = column(mark_set.untils_ns, "<i8")
    coming = untils_ns[(untils_ns > after_ns) & (untils_ns != FOREVER)]
    return int(coming.min()) if len(coming) else None


def mark_set(author: str, group: str, tile: int, epoch: int, seq: int, said: Statements) -> MarkSet:
    """A set of these columns. Raises ValueError where they break a rule."""
    made = MarkSet(
        author=author,
        group=group,
        tile=tile,
        epoch=epoch,
        seq=seq,
        cells=pack_column(said.cells, "<u2"),
        kinds=pack_column(said.kinds, "<u1"),
        paces=pack_column(said.paces, "<f4"),
        stamps_ns=pack_column(said.stamps_ns, "<i8"),
        untils_ns=_packed_untils(said.untils_ns),
    )
    made.check()
    return made


def _packed_untils(untils_ns: NDArray[np.int64] | None) -> bytes:
    if untils_ns is None or (untils_ns == FOREVER).all():
        return b""
    return pack_column(untils_ns, "<i8")


def base_seq(seq: int) -> int:
    """The number of the author's own set that a folding is made of; of an own set its number."""
    return seq - seq % FOLDS


def next_seq(seq: int) -> int:
    """The number of an author's next set: above all foldings of the last one."""
    return base_seq(seq) + FOLDS


def is_burial(of: MarkSet) -> bool:
    """Whether a keeper says that nothing of an author that is gone is left here (see `folding`)."""
    return not of.kinds and of.seq % FOLDS > 0


def supersedes(new: MarkSet, old: MarkSet) -> bool:
    """Whether `new` replaces `old` of the same author and tile: higher (epoch, seq).

    An author never puts two different sets under one number. Should a damaged payload look as if, the larger
    content wins, so that even then the order of arrival does not matter.
    """
    if new.epoch != old.epoch:
        return new.epoch > old.epoch
    if new.seq != old.seq:
        return new.seq > old.seq
    return _content(new) > _content(old)


def _content(of: MarkSet) -> tuple[bytes, bytes, bytes, bytes, bytes, str]:
    return of.cells, of.kinds, of.paces, of.stamps_ns, of.untils_ns, of.group


def fault(of: MarkSet, grid: GridSpec) -> str | None:
    """Why a set can be no part of this grid's map; None if it can."""
    if of.tile >= grid.tiles:
        return f"tile {of.tile} is not in 0..{grid.tiles - 1}"
    if of.kinds and at_border(of.tile, grid):
        window = grid.tile_window(of.tile)
        cells = column(of.cells, "<u2")
        height, width = window.row1 - window.row0, window.col1 - window.col0
        if (cells // TILE_CELLS >= height).any() or (cells % TILE_CELLS >= width).any():
            return f"a cell of tile {of.tile} lies outside the grid"
    return None


def at_border(tile: int, grid: GridSpec) -> bool:
    """Whether the grid ends inside or with this tile."""
    tile_row, tile_col = divmod(tile, grid.tile_cols)
    return (tile_row + 1) * TILE_CELLS > grid.rows or (tile_col + 1) * TILE_CELLS > grid.cols


def resolve(sets: Iterable[MarkSet], now_ns: int = 0) -> Statements:
    """The winning statement about each of a tile's 1024 cells; CLEAR where nobody says anything.

    sets    at most one per author, in increasing order of author
    now_ns  statements that ended by then count as never made
    """
    won = _blank()
    for each in sets:
        if each.kinds:
            said = standing(each, now_ns)
            _overlay(won, said, said.stamps_ns >= won.stamps_ns[said.cells])  # on a tie the larger author
    return won


def difference(old: MarkSet | None, new: MarkSet, others: Sequence[MarkSet], now_ns: int = 0) -> Statements:
    """The cells whose winner changes in kind or pace when `new` replaces `old`, with their winners since.

    others  the sets of the other authors, in increasing order of author
    """
    if not others and not new.untils_ns:
        if old is None:
            said = statements(new)
            return taken(said, np.flatnonzero(said.kinds != _CLEAR)) if _CLEAR in new.kinds else said
        if _small(new) and _small(old):
            return _small_difference(old, new)
    base = _blank()
    larger = np.zeros(TILE_AREA, bool)  # the cell's winner so far is of an author that wins ties against us
    for each in others:
        if each.kinds:
            said = standing(each, now_ns)
            wins = said.stamps_ns >= base.stamps_ns[said.cells]
            _overlay(base, said, wins)
            larger[said.cells[wins]] = each.author > new.author
    before, after = base, base
    if old is not None and old.kinds:
        before = _with(base, standing(old, now_ns), larger)
    if new.kinds:
        after = _with(base, standing(new, now_ns), larger)
    return changes(before, after)


def _small(of: MarkSet) -> bool:
    return len(of.kinds) <= 32 and not of.untils_ns


def _small_difference(old: MarkSet, new: MarkSet) -> Statements:
    """As `difference`, of two short sets that nobody disputes and nothing of which ends: the everyday case.

    Lists take a fifth of the time of arrays of 1024 here.
    """
    gone = _listed(old)
    changed: list[tuple[int, int, float, int]] = []
    for cell, (kind, pace, stamp_ns) in _listed(new).items():
        before = gone.pop(cell, _NOBODY)
        if kind != before[0] or pace != before[1]:
            changed.append((cell, kind, pace, stamp_ns))
    if gone:
        changed.extend((cell, *_NOBODY) for cell, said in gone.items() if said[0] != _CLEAR)
        changed.sort()
    if not changed:
        return NOTHING_SAID
    cells, kinds, paces, stamps_ns = zip(*changed, strict=True)
    return Statements(
        np.array(cells, np.uint16),
        np.array(kinds, np.uint8),
        np.array(paces, np.float32),
        np.array(stamps_ns, np.int64),
    )


def _listed(of: MarkSet) -> dict[int, tuple[int, float, int]]:
    """Cell -> (kind, pace, stamp)"""
    paces: list[float] = column(of.paces, "<f4").tolist()
    if max(of.kinds, default=_PACE) != _PACE:
        paces = [0.0 if kind else pace for kind, pace in zip(of.kinds, paces, strict=True)]
    said = zip(of.kinds, paces, memoryview(of.stamps_ns).cast("q").tolist(), strict=True)
    return dict(zip(memoryview(of.cells).cast("H").tolist(), said, strict=True))


def changes(before: Statements, after: Statements) -> Statements:
    """Of a tile's winners after something happened, those that differ in kind or pace from before."""
    return taken(after, np.flatnonzero((before.kinds != after.kinds) | (before.paces != after.paces)))


def dense(said: Statements) -> Statements:
    """Spread over all cells of a tile, the ends included, to be changed in place."""
    spread = _blank()._replace(untils_ns=np.full(TILE_AREA, FOREVER, np.int64))
    _overlay(spread, said, np.ones(len(said.cells), bool))
    return spread


def _with(base: Statements, said: Statements, larger: NDArray[np.bool_]) -> Statements:
    both = Statements(_TILE, base.kinds.copy(), base.paces.copy(), base.stamps_ns.copy())
    _overlay(both, said, said.stamps_ns >= base.stamps_ns[said.cells] + larger[said.cells])
    return both


def _blank() -> Statements:
    return Statements(
        _TILE,
        np.full(TILE_AREA, _CLEAR, np.uint8),
        np.zeros(TILE_AREA, np.float32),
        np.full(TILE_AREA, NO_STATEMENT, np.int64),
    )


def _overlay(under: Statements, said: Statements, wins: NDArray[np.bool_]) -> None:
    cells = said.cells
    if not wins.all():
        said, cells = taken(said, np.flatnonzero(wins)), cells[wins]
    under.kinds[cells] = said.kinds
    under.paces[cells] = said.paces
    under.stamps_ns[cells] = said.stamps_ns
    if under.untils_ns is not None:
        under.untils_ns[cells] = FOREVER if said.untils_ns is None else said.untils_ns


_CLEAR = int(MarkKind.CLEAR)
_PACE = int(MarkKind.PACE)
_NOBODY = (_CLEAR, 0.0, NO_STATEMENT)
_NO_PACE = np.float32(0)
_FEW_CELLS = 16
"""Up to so many, lists are faster than arrays."""
_TILE_BITS = np.uint32(TILE_CELLS.bit_length() - 1)
_TILE_MASK = np.uint32(TILE_CELLS - 1)
_TILE: NDArray[np.uint16] = np.arange(TILE_AREA, dtype=np.uint16)


def sparse(said: Statements) -> Statements:
    """Without the cells that nobody says anything about."""
    return taken(said, np.flatnonzero(said.stamps_ns != NO_STATEMENT))


def taken(said: Statements, where: NDArray[np.intp]) -> Statements:
    return Statements(
        said.cells[where],
        said.kinds[where],
        said.paces[where],
        said.stamps_ns[where],
        None if said.untils_ns is None else said.untils_ns[where],
    )


NOTHING_SAID = Statements(
    np.empty(0, np.uint16), np.empty(0, np.uint8), np.empty(0, np.float32), np.empty(0, np.int64)
)


def grid_cells(grid: GridSpec, tile: int, cells: NDArray[np.integer]) -> NDArray[np.uint32]:
    """Flat indices in the grid of cells inside a tile."""
    tile_row, tile_col = divmod(tile, grid.tile_cols)
    place = tile_row * TILE_CELLS * grid.cols + tile_col * TILE_CELLS
    if len(cells) <= _FEW_CELLS:
        few: list[int] = cells.tolist()
        return np.array([place + c // TILE_CELLS * grid.cols + c % TILE_CELLS for c in few], np.uint32)
    corner = np.uint32(place)
    inner = cells.astype(np.uint32)
    return (inner >> _TILE_BITS) * np.uint32(grid.cols) + (inner & _TILE_MASK) + corner


def tile_cells(grid: GridSpec, cells: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.uint16]]:
    """(tile, index inside it) of flat indices that are inside the grid."""
    rows, cols = np.divmod(cells.astype(np.int64), grid.cols)
    tiles = (rows // TILE_CELLS) * grid.tile_cols + cols // TILE_CELLS
    inner = (rows % TILE_CELLS) * TILE_CELLS + cols % TILE_CELLS
    return tiles, inner.astype(np.uint16)


def region_tiles(grid: GridSpec, region: int) -> list[int]:
    """The tiles of a region."""
    region_row, region_col = divmod(region, grid.region_cols)
    rows = range(region_row * REGION_TILES, min((region_row + 1) * REGION_TILES, grid.tile_rows))
    cols = range(region_col * REGION_TILES, min((region_col + 1) * REGION_TILES, grid.tile_cols))
    return [row * grid.tile_cols + col for row in rows for col in cols]


class HybridClock:
    """Stamps for an author's statements: its own clock, but always newer than what it knows about the very cell.

    So whoever has seen a statement can overrule it at once, however far ahead the clock of its author is; that is
    all of a hybrid logical clock that a per-cell rule needs, and one wrong clock does not drag the others along.
    The bound: of two statements made without knowledge of each other, that of an author whose clock is d ahead may
    beat a statement up to d younger, until the first author who has seen both speaks.
    """

    def __init__(self) -> None:
        self._last_ns = 0

    def stamps_ns(self, now_ns: int, known_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """One stamp per cell. `known_ns` is the newest stamp known about each, or NO_STATEMENT."""
        self._last_ns = max(self._last_ns, now_ns, 0)
        return np.minimum(np.maximum(self._last_ns, known_ns + 1), STAMP_LIMIT_NS - 1)
